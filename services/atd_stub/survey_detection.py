"""Target detection in a survey file of any length, joined with the end of the previous file."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Final

from sonarpost import wire
from sonarpost.codec.interface import MIN_SIDE_PX
from sonarpost.detection.detector import Detection, search
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.snippets import cut_expanded, cut_snippet, ground_projected_image
from sonarpost.messages import Contact, Pixels, Snippet
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.file_boundary import BoundaryDetection, FileEnd, Origin, stored_ping_count
from sonarpost.services.atd_stub.input_folder import printable
from sonarpost.sonar.geometry import georeference
from sonarpost.sonar.readers import open_survey
from sonarpost.sonar.source import Strip, SurveySource, strips
from sonarpost.sonar.survey import Ping, Survey

STRIP_PINGS: Final = 1000
_ROW_TOLERANCE: Final = 15
"""Two detections of one object in overlapping strips may differ by this many rows."""
_MAX_COMPARED: Final = 2000


@dataclass(frozen=True, slots=True)
class DetectionResult:
    """The contacts of one input file.

    Attributes:
        snippets: Contacts that are ready for release, most confident first.
        contact_count: Number of new contacts, those that are held at the end of the file included.
        file_end: The end of the file with the held contacts; None where none is kept.
        joined: Whether the file continued the previous one.
        warnings: Warnings of the reader.
        weaker: What lower thresholds would have given: the number of contacts, by confidence. Approximate at the
            boundaries of files and of parts of 1000 pings.
        released: Held contacts of the previous file that are no longer held: identifier and reason.
    """

    snippets: tuple[Snippet, ...]
    contact_count: int
    file_end: FileEnd | None = None
    joined: bool = False
    warnings: tuple[str, ...] = ()
    weaker: Mapping[float, int] = field(default_factory=dict)
    released: tuple[tuple[str, str], ...] = ()


def detect_in_survey(
    path: Path,
    content: str,
    vehicle_id: str,
    config: AtdStubConfig,
    file_ends: Mapping[str, FileEnd] | None = None,
    now_utc_s: float = 0.0,
) -> DetectionResult:
    """Detect the contacts of a survey file.

    Args:
        path: The file.
        content: Hex SHA-256 of its content; part of the contact identifiers.
        vehicle_id: This vehicle.
        config: Threshold, limits, size of the snippets, and what the file does not contain.
        file_ends: Ends of earlier files, by sonar.
        now_utc_s: Current time, from which contacts at the end of the file are held for `join_timeout_s`.

    Raises:
        SurveyFileError: The file is not a readable survey.
    """
    with open_survey(path, config) as source:
        origin = Origin(content, printable(path.name), printable(source.info.line_name))
        search = _SurveySearch(source, origin, vehicle_id, config)
        return search.run((file_ends or {}).get(source.info.sonar_id), now_utc_s)


@dataclass(slots=True)
class _Candidate:
    position: BoundaryDetection
    snippet: Snippet
    is_new: bool


class _SurveySearch:
    """One search of one file; `run` is called once.

    The file is read in overlapping strips, so that memory does not depend on its length. Where it continues the
    previous file, the last pings of that file are searched together with its first pings.
    """

    def __init__(self, source: SurveySource, origin: Origin, vehicle_id: str, config: AtdStubConfig) -> None:
        self._source = source
        self._origin = origin
        self._vehicle_id = vehicle_id
        self._config = config
        self._overlap = config.join_overlap_pings
        self._settings = DetectorSettings(confidence_threshold=config.confidence_threshold)
        self._previous: FileEnd | None = None
        self._first_row = 0
        self._held: list[BoundaryDetection] = []
        self._known: list[BoundaryDetection] = []
        self._candidates: list[_Candidate] = []
        self._weaker: Counter[float] = Counter()
        self._released: list[tuple[str, str]] = []

    def run(self, file_end: FileEnd | None, now_utc_s: float) -> DetectionResult:
        pings = self._joined_pings(self._source.pings(), file_end)
        last: Strip | None = None
        for last in strips(pings, max(STRIP_PINGS, 2 * self._overlap), self._overlap):
            self._search_strip(last)
            self._apply_limits()
        assert last is not None, "an open survey has pings"
        return self._result(last, now_utc_s)

    def _joined_pings(self, pings: Iterator[Ping], file_end: FileEnd | None) -> Iterator[Ping]:
        first = next(pings)
        self._previous = file_end.continued_by(first) if file_end is not None else None
        if file_end is not None and self._previous is not None:
            self._first_row = max(0, len(file_end.pings) - self._overlap // 2)
            self._known = list(file_end.detections)
            self._held = [detection for detection in file_end.detections if detection.held is not None]
            return chain(self._previous.pings, (first,), pings)
        return chain((first,), pings)

    def _search_strip(self, strip: Strip) -> None:
        info = self._source.info
        survey = Survey(info.path, info.sonar_id, info.line_name, strip.pings, info.warnings)
        half = self._overlap // 2
        # Rows before the middle of an overlap belong to the previous strip or file, which shows more around them.
        lower = strip.first_row + self._overlap - half if strip.first_row else self._first_row
        upper = math.inf if strip.is_last else strip.first_row + len(strip.pings) - half
        result = search(survey, self._settings)
        for confidence, rows in result.weaker.items():
            self._weaker[confidence] += sum(lower <= strip.first_row + row < upper for row in rows)
        for detection in result.detections:
            position = BoundaryDetection.of_detection(detection, strip.first_row)
            if lower - _ROW_TOLERANCE <= position.row < upper + _ROW_TOLERANCE:
                self._add(survey, detection, position)

    def _add(self, survey: Survey, detection: Detection, position: BoundaryDetection) -> None:
        is_new = True
        for known in [known for known in self._known if known.is_same_object(position)]:
            if known not in self._held:
                return
            # This strip shows the whole object: its snippet replaces the held one.
            self._held.remove(known)
            self._known.remove(known)
            self._released.append((known.held_contact_id, f"seen whole in {self._origin.source}"))
            is_new = False
        self._known.append(position)
        snippet = snippet_of(survey, detection, self._origin_of(position.row), self._vehicle_id, self._config)
        self._candidates.append(_Candidate(position, snippet, is_new))

    def _origin_of(self, row: int) -> Origin:
        previous = self._previous.origins if self._previous is not None else ()
        return previous[row] if row < len(previous) else self._origin

    def _apply_limits(self) -> None:
        """Sort by confidence, and bound the new contacts and the detections that later ones are compared with."""
        max_contacts = self._config.max_contacts
        self._candidates.sort(key=_descending_confidence)
        if max_contacts:
            kept = [candidate for candidate in self._candidates if candidate.is_new][:max_contacts]
            self._candidates = [candidate for candidate in self._candidates if not candidate.is_new] + kept
            self._candidates.sort(key=_descending_confidence)
        del self._known[:-_MAX_COMPARED]

    def _result(self, last: Strip, now_utc_s: float) -> DetectionResult:
        info, config = self._source.info, self._config
        end = last.first_row + len(last.pings)
        stored = stored_ping_count(last.pings, self._overlap)
        held_from = max(end - self._overlap // 2, end - stored) if config.join_timeout_s > 0 and stored else math.inf
        held = [candidate for candidate in self._candidates if candidate.position.row >= held_from]
        # Held contacts of the previous file that were not detected again are released with their first snippet.
        not_repeated = tuple(wire.decode(Snippet, known.held, "file end") for known in self._held if known.held)
        self._released += [(s.contact.contact_id, f"not detected again in {self._origin.source}") for s in not_repeated]
        file_end = None
        if stored:
            start = end - stored
            held_ids = {id(candidate.position) for candidate in held}
            others = (known for known in self._known if id(known) not in held_ids and known.end_row > start)
            detections = (
                *(replace(known, held=None).shifted(-start) for known in others),
                *(replace(each.position, held=wire.encode(each.snippet)).shifted(-start) for each in held),
            )
            origins = tuple(self._origin_of(row) for row in range(start, end))
            pings = last.pings[len(last.pings) - stored :]
            file_end = FileEnd(info.sonar_id, pings, origins, detections, now_utc_s + config.join_timeout_s)
        ready = (candidate.snippet for candidate in self._candidates if candidate.position.row < held_from)
        return DetectionResult(
            snippets=(*not_repeated, *ready),
            contact_count=sum(candidate.is_new for candidate in self._candidates),
            file_end=file_end,
            joined=self._previous is not None,
            warnings=info.warnings,
            weaker=dict(self._weaker),
            released=tuple(self._released),
        )


def _descending_confidence(candidate: _Candidate) -> float:
    return -(candidate.snippet.contact.atd_confidence or 0.0)


def snippet_of(survey: Survey, detection: Detection, origin: Origin, vehicle_id: str, config: AtdStubConfig) -> Snippet:
    """Return the record of a detection, with an expanded image where the survey shows more seabed.

    A position is set only with its standard deviation, and a height only where the shadow was recorded to its end.

    Args:
        survey: The pings in which it was detected.
        detection: The detection.
        origin: The file of its ping.
        vehicle_id: This vehicle.
        config: Size of the image, and the error budget of positions.
    """
    size = (config.snippet_height_px, config.snippet_width_px)
    cut = cut_snippet(survey, detection, *size)
    image, along_m, across_m = cut.image, detection.pixel_along_m, detection.pixel_across_m
    expanded = None
    if config.snippet_pixel_m > 0:
        ground = ground_projected_image(survey, detection, *size, config.snippet_pixel_m)
        if ground is not None:
            image, along_m, across_m = ground, config.snippet_pixel_m, config.snippet_pixel_m
            expanded = ground_projected_image(survey, detection, *size, 2 * config.snippet_pixel_m)
    if image is cut.image:
        expanded = cut_expanded(survey, detection, *size)
    place = georeference(
        survey.pings[detection.ping_index],
        detection.side,
        detection.sample,
        config,
        tracked_altitude_m=detection.altitude_m,
    )
    position = detection.position if place is not None else None
    side, line_name = detection.side, origin.line_name
    contact = Contact(
        contact_id=f"{line_name[:60]}-{origin.content[:8]}-{detection.ping_number}-{side.value}-{detection.sample}",
        vehicle_id=vehicle_id,
        sonar_id=survey.sonar_id,
        line_name=line_name,
        ping_number=detection.ping_number,
        channel=side.value,
        time_utc_s=detection.time_utc_s,
        lat_deg=position.lat_deg if position else None,
        lon_deg=position.lon_deg if position else None,
        position_sigma_m=place.drms_m if place is not None and position else None,
        depth_m=detection.depth_m,
        altitude_m=detection.altitude_m,
        heading_deg=detection.heading_deg,
        speed_mps=detection.speed_mps,
        slant_range_m=detection.slant_range_m,
        ground_range_m=detection.ground_range_m,
        atd_class=detection.atd_class,
        atd_confidence=detection.confidence,
        length_m=detection.length_m,
        width_m=detection.width_m,
        shadow_m=detection.shadow_m,
        height_m=None if detection.shadow_is_cut else detection.height_m,
        pixel_along_m=along_m,
        pixel_across_m=across_m,
    )
    return Snippet(
        contact=contact,
        picture=Pixels.from_array(image),
        source=origin.source,
        wide=None if expanded is None or min(expanded.shape) < MIN_SIDE_PX else Pixels.from_array(expanded),
    )
