"""Target detection in a survey file of any length, joined with the end of the previous file."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from pydantic import ValidationError
from typing_extensions import override

from sonarpost.codec.interface import MIN_SIDE_PX
from sonarpost.detection.detector import Detection
from sonarpost.detection.difficulty import Difficulty
from sonarpost.detection.snippets import cut_expanded, cut_snippet, ground_projected_image
from sonarpost.detection.stream import FileOrigin, PingOrigin, StreamContact, StreamDetector, StreamEnd, contact_record
from sonarpost.detection.transmissions import MaskedSource, TransmitIntervals
from sonarpost.errors import SurveyFileError
from sonarpost.limits import limit
from sonarpost.logs import kv
from sonarpost.messages import Contact, Pixels, Snippet, VehicleStatus
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.sonar.readers import open_survey, recording_parts
from sonarpost.sonar.survey import Ping, Survey

log = logging.getLogger(__name__)

MAX_CONTACTS: Final = limit(
    5000, "contacts", "claims", "input folder", "recording", "contacts", "the least confident ones are not sent"
)
MAX_SAMPLE_M: Final = limit(
    1.0, "m for each sample", "claims", "input folder", "recording", "slant range of a ping", "the ping is not searched"
)
MAX_SEARCH_S: Final = limit(
    600.0, "s of processor time", "deadlines", "input folder", "recording", "search, beside that by size", "quarantine"
)
MAX_SEARCH_S_PER_MB: Final = limit(
    100.0, "s of processor time a MB", "deadlines", "input folder", "recording", "search, by its size", "quarantine"
)
SurveyEnd = StreamEnd[Snippet]
"""The end of a recording."""


@dataclass(frozen=True, slots=True)
class DetectionResult:
    """The contacts of one input file.

    Attributes:
        snippets: Contacts that are ready for release, most confident first.
        contact_count: Number of contacts that were detected with this file, those held at its end included.
        ends: The end of the latest recording of each sonar after this file.
        held: Contacts held at the end of this file.
        joined: Whether the file continued the previous one.
        not_continued: Contacts held at the end of an earlier recording, which this file does not continue; ready for
            release too.
        replaced: Contacts held at the end of the previous file and detected again with this one.
        dropped: Contacts held there and not detected in the joined pings.
        warnings: Warnings of the reader.
        weaker: What lower thresholds would have given: the number of contacts, by confidence. Approximate at the
            boundaries of files and of strips.
        masked_pings: Number of pings that were recorded during a transmission of the own modem.
        masked_share: The same as a share of the pings of the file, 0 to 1.
        difficulty: Difficulty of the file's seabed; None if too little of it is known.
        status: Position and swath of the vehicle at the newest ping with a position; None without one.
    """

    snippets: tuple[Snippet, ...]
    contact_count: int
    ends: Mapping[str, SurveyEnd] | None = None
    held: tuple[Snippet, ...] = ()
    joined: bool = False
    not_continued: tuple[Snippet, ...] = ()
    replaced: tuple[Snippet, ...] = ()
    dropped: tuple[Snippet, ...] = ()
    warnings: tuple[str, ...] = ()
    weaker: Mapping[float, int] = field(default_factory=dict)
    masked_pings: int = 0
    masked_share: float = 0.0
    difficulty: Difficulty | None = None
    status: VehicleStatus | None = None
    position_note: str | None = None


def detect_in_survey(
    path: Path,
    content: str,
    vehicle_id: str,
    config: AtdStubConfig,
    ends: Mapping[str, SurveyEnd] | None = None,
    transmissions: TransmitIntervals | None = None,
) -> DetectionResult:
    """Detect the contacts of a survey file.

    A file that cannot be searched together with the end of an earlier one is searched alone: the fault may be in the
    earlier one, whose held contacts are released.

    Args:
        path: The file.
        content: Hex SHA-256 of its content; part of the contact identifiers.
        vehicle_id: This vehicle.
        config: Settings of the detector, size of the snippets, and what the file does not contain.
        ends: Ends of earlier recordings, by sonar.
        transmissions: Times whose pings are masked; None for none.

    Raises:
        SurveyFileError: The file is not a readable survey, or its search takes longer than `MAX_SEARCH_S` and
            `MAX_SEARCH_S_PER_MB`.
    """
    size_bytes = sum(part.stat().st_size for part in recording_parts(path) if part.exists())
    deadline_s = time.thread_time() + MAX_SEARCH_S + MAX_SEARCH_S_PER_MB * size_bytes / 1e6
    transmissions = transmissions or TransmitIntervals()
    try:
        return _detect(path, content, vehicle_id, config, ends or {}, transmissions, deadline_s)
    except OSError:
        raise
    except Exception as error:
        if not ends:
            raise
        alone = _detect(path, content, vehicle_id, config, {}, transmissions, deadline_s)
        assert alone.ends is not None
        log.warning(
            "File searched alone, without the end of an earlier one", extra=kv(file=path.name, reason=str(error))
        )
        left = [end for sonar_id, end in ends.items() if sonar_id in alone.ends]
        return replace(
            alone,
            ends={**ends, **alone.ends},
            not_continued=tuple(snippet for end in left for snippet in snippets_of(end.held)),
        )


class _LimitedSource(MaskedSource):
    """A source whose iteration ends with an error after a processor time. Coarse pings have no samples."""

    deadline_s: float
    coarse_count = 0

    @override
    def pings(self) -> Iterator[Ping]:
        for ping in super().pings():
            if time.thread_time() > self.deadline_s:
                expected = f"at most {MAX_SEARCH_S:g} s and {MAX_SEARCH_S_PER_MB:g} s for each megabyte"
                raise SurveyFileError(str(self.info.path), "search", "unfinished", expected)
            is_coarse = any(channel.sample_spacing_m > MAX_SAMPLE_M for channel in ping.channels)
            self.coarse_count += is_coarse
            yield replace(ping, channels=()) if is_coarse else ping


def _detect(
    path: Path,
    content: str,
    vehicle_id: str,
    config: AtdStubConfig,
    ends: Mapping[str, SurveyEnd],
    transmissions: TransmitIntervals,
    deadline_s: float,
) -> DetectionResult:
    """As `detect_in_survey`."""

    def describe(survey: Survey, detection: Detection, origin: PingOrigin) -> Snippet:
        contact = contact_record(detection, origin.file, vehicle_id, survey.sonar_id)
        return snippet_of(survey, detection, origin.file, contact, config)

    settings = config.detector_settings()
    settings = settings.model_copy(update={"max_contacts": min(settings.max_contacts or MAX_CONTACTS, MAX_CONTACTS)})
    detector = StreamDetector(describe, settings, ends)
    with open_survey(path, config) as source:
        info = source.info
        masked = _LimitedSource(source, transmissions)
        masked.deadline_s = deadline_s
        found = detector.add_file(masked, FileOrigin.of(source, content))
    # Contacts are held only while they wait for a continuation.
    at_once = detector.release(info.sonar_id) if config.join_timeout_s == 0 else ()
    ready = sorted(snippets_of((*found.contacts, *at_once)), key=_descending_confidence)
    coarse = f"{masked.coarse_count} pings have over {MAX_SAMPLE_M:g} m of slant range for each sample: not searched"
    return DetectionResult(
        snippets=tuple(ready),
        contact_count=len(found.contacts) + len(found.held),
        ends=detector.ends,
        held=() if at_once else snippets_of(found.held),
        joined=found.joined,
        not_continued=snippets_of(found.released),
        replaced=snippets_of(found.replaced),
        dropped=snippets_of(found.dropped),
        warnings=(*info.warnings, coarse) if masked.coarse_count else info.warnings,
        weaker=found.weaker,
        masked_pings=masked.masked_count,
        masked_share=masked.masked_share,
        difficulty=found.difficulty,
        status=None if masked.newest is None else status_of(masked.newest, vehicle_id),
        position_note=None if masked.newest is None else masked.newest.position_note,
    )


def status_of(ping: Ping, vehicle_id: str) -> VehicleStatus | None:
    """Return the status of the vehicle at a ping; None if a value of the ping is out of range."""
    swath_m = ping.max_slant_range_m()
    if swath_m is not None and ping.altitude_m is not None:
        swath_m = math.sqrt(max(0.0, swath_m**2 - ping.altitude_m**2))
    try:
        return VehicleStatus(
            vehicle_id=vehicle_id,
            time_utc_s=ping.time_utc_s,
            lat_deg=ping.lat_deg,
            lon_deg=ping.lon_deg,
            heading_deg=None if ping.heading_deg is None else ping.heading_deg % 360,
            speed_mps=ping.speed_mps,
            depth_m=ping.depth_m,
            altitude_m=ping.altitude_m,
            swath_m=swath_m,
        )
    except ValidationError as error:
        log.warning("No vehicle status: ping out of range", extra=kv(ping=ping.number, reason=error.errors()[0]["msg"]))
        return None


def _descending_confidence(snippet: Snippet) -> float:
    return -(snippet.contact.atd_confidence or 0.0)


def snippets_of(contacts: Iterable[StreamContact[Snippet]]) -> tuple[Snippet, ...]:
    """Return the snippets of contacts."""
    return tuple(contact.content for contact in contacts)


def snippet_of(
    survey: Survey, detection: Detection, origin: FileOrigin, contact: Contact, config: AtdStubConfig
) -> Snippet:
    """Return the snippet of a detection, with an expanded image where the survey shows more seabed.

    Args:
        survey: The pings in which it was detected.
        detection: The detection.
        origin: The file of its ping.
        contact: Its contact record; the size of a pixel is added.
        config: Size of the image.
    """
    size = (config.snippet_height_px, config.snippet_width_px)
    cut = cut_snippet(survey, detection, *size)
    image, pixel_sizes = cut.image, {}
    expanded = None
    if config.snippet_pixel_m > 0:
        ground = ground_projected_image(survey, detection, *size, config.snippet_pixel_m)
        if ground is not None:
            image = ground
            pixel_sizes = {"pixel_along_m": config.snippet_pixel_m, "pixel_across_m": config.snippet_pixel_m}
            expanded = ground_projected_image(survey, detection, *size, 2 * config.snippet_pixel_m)
    if image is cut.image:
        expanded = cut_expanded(survey, detection, *size)
    return Snippet(
        contact=contact.model_copy(update=pixel_sizes),
        pixels=Pixels.from_array(image),
        source=origin.source,
        wide=None if expanded is None or min(expanded.shape) < MIN_SIDE_PX else Pixels.from_array(expanded),
    )
