"""`sonarpost detect FILE…`: the contacts of survey files as a table, as JSON, or drawn into the waterfall.

`sonarpost.cli.detection.images` has the option --images, which scores images instead.
"""

import argparse
import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw
from pydantic import ValidationError

from sonarpost.cli.detection.images import add_image_options, check_image_options, run_images
from sonarpost.cli.detection.options import (
    add_pick_option,
    add_transmission_options,
    located_picks,
    transmissions_of,
)
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import (
    add_survey_options,
    flag,
    in_new_folder,
    make_output_folder,
    option,
    survey_options_of,
)
from sonarpost.cli.survey.plot import draw_waterfall, reduce_survey
from sonarpost.detection.detector import MINE_LIKE, Detection, counts_text
from sonarpost.detection.difficulty import Difficulty, combined
from sonarpost.detection.picks import PICKED, LocatedPick, PickedDetection, is_at_detection, measure_picks
from sonarpost.detection.settings import DetectorSettings, checked_settings, load_settings
from sonarpost.detection.snippets import cut_snippet, ground_projected_image
from sonarpost.detection.stream import (
    FileOrigin,
    PingOrigin,
    StreamContact,
    StreamDetector,
    StripDifficulty,
    contact_record,
)
from sonarpost.detection.transmissions import MaskedSource, TransmitIntervals
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.files import write_atomically
from sonarpost.messages import Contact
from sonarpost.registry import Registry
from sonarpost.sonar.image_files import encode_png, write_png
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import open_survey
from sonarpost.sonar.side_car import write_side_car
from sonarpost.sonar.source import SurveyInfo, SurveySource
from sonarpost.sonar.survey import Side, Survey
from sonarpost.wire import first_error

_HEADER = (
    "  n  conf  class      p_mine  p_other  side       ping  sample  range_m  length_m  width_m  shadow_m  height_m"
    "     lat_deg      lon_deg  sigma_m"
)

# Size of the snippets that are projected to the bottom: 10 m x 10 m.
_GROUND_PX = 100
_GROUND_PIXEL_M = 0.1
_MAP_SIDE_M = 20


class WritableMap(Protocol):
    """Georeferenced image of the seabed around a contact."""

    def write(self, path: Path) -> None:
        """Write it as GeoTIFF."""


DrawSeabed = Callable[[Survey, Detection, float, float], WritableMap | None]
"""Draws the seabed around a contact: pings, contact, side and pixel in metres. None if its place is not known."""


def contact_maps() -> Registry[DrawSeabed]:
    """Return what draws the seabed around a contact, by the option of `sonarpost detect` that asks for it."""
    return Registry("sonarpost.contact_maps", "a function", lambda found, _: callable(found), {})


def add_options(parser: CommandParser) -> None:
    """Add the subcommand."""
    parser.description = (
        "Detect highlights with shadows in side-scan surveys and list them, most confident first. Files "
        "that continue each other are one line: an object at a file boundary is listed once. With --images, "
        "score every image of a folder."
    )
    option(parser, "files FILE", "survey file", Path, nargs="*")
    add_image_options(parser)
    flag(parser, "--json", "print one JSON object with all contacts or scores")
    option(
        parser,
        "--plot FILE.png",
        "draw the contacts into the waterfall; with several survey files, the name of each precedes the suffix",
        Path,
    )
    option(parser, "--snippets DIR", "write the snippets of each contact into this folder", Path)
    flag(
        parser,
        "--geotiff",
        f"with --snippets: also write the seabed around each contact as GeoTIFF, {_MAP_SIDE_M} m a side, north up",
    )
    option(
        parser, "--threshold CONFIDENCE", "minimum confidence, 0 to 2 (default: that of --settings, else 0.3)", float
    )
    option(parser, "--max-contacts N", "list at most the N most confident contacts of a file", int)
    option(parser, "--settings FILE.toml", "settings of the detector, as in [atd_stub.detector]", Path)
    add_pick_option(parser)
    add_transmission_options(parser)
    add_survey_options(parser)
    option(parser, "--vehicle ID", "vehicle_id of the records", default="uuv")
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Detect in every file and print the contacts, or the scores of images."""
    check_image_options(parsed)
    settings = _settings(parsed)
    if parsed.images is not None:
        return run_images(parsed.images, parsed.pixel_m, settings, as_json=parsed.json)
    _check_vehicle_id(parsed.vehicle)
    if parsed.geotiff and parsed.snippets is None:
        raise ConfigError("detect", "--geotiff", "without --snippets", "--geotiff together with --snippets DIR")
    options = survey_options_of(parsed)
    transmissions = transmissions_of(parsed)
    files: list[Path] = parsed.files
    picks = located_picks(parsed.pick, files, options)
    if parsed.plot is not None:
        in_new_folder(parsed.plot)
    if parsed.snippets is not None:
        make_output_folder(parsed.snippets)
    with ProgressDisplay() as display:
        detection = _Detection(
            settings,
            options,
            parsed.vehicle,
            transmissions,
            contact_maps().get("geotiff") if parsed.geotiff else None,
            with_images=parsed.snippets is not None,
        )
        results = detection.run(files, display)
        if picks:
            detection.add_picks(picks)
    for result in results:
        if not parsed.json:
            _print_table(result, settings.confidence_threshold)
        if parsed.plot is not None:
            path = _plot_path(parsed.plot, result.info.path, several=len(files) > 1)
            with open_survey(result.info.path, options) as source:
                image = annotated_waterfall(source, [contact.detection for contact in result.contacts])
            write_atomically(path, encode_png(image))
        if parsed.snippets is not None:
            _write_snippets(parsed.snippets, result)
    if parsed.json:
        found = [_file_json(r, settings.confidence_threshold) for r in results]
        print(json.dumps({"files": found}, allow_nan=False))
    return 0


def _settings(parsed: argparse.Namespace) -> DetectorSettings:
    """Return the settings of --settings with --threshold and --max-contacts.

    Raises:
        ConfigError: The file or an option is invalid.
    """
    settings = DetectorSettings() if parsed.settings is None else load_settings(parsed.settings)
    given = {"confidence_threshold": parsed.threshold, "max_contacts": parsed.max_contacts}
    changes = {name: value for name, value in given.items() if value is not None}
    return checked_settings(settings.model_dump() | changes, "detect")


def _check_vehicle_id(vehicle_id: str) -> None:
    try:
        Contact(contact_id="checked", vehicle_id=vehicle_id)
    except ValidationError as error:
        _, value, expected = first_error(error)
        raise ConfigError("detect", "--vehicle", value, expected) from error


@dataclass(frozen=True, slots=True)
class ListedContact:
    """A contact with what the command prints and writes of it.

    Attributes:
        detection: The detection; its ping indices are those of its file. The highlight may begin before its first ping.
        record: Its contact record.
        image: Its snippet at the resolution of the recording; None without --snippets.
        ground: Its snippet projected to the bottom; None without --snippets, and where it is not known.
        seabed: Georeferenced image of the seabed around it; None without --geotiff, and where its place is not known.
        is_picked: Whether it is at a place of --pick.
    """

    detection: Detection
    record: Contact
    image: npt.NDArray[np.uint8] | None = None
    ground: npt.NDArray[np.uint8] | None = None
    seabed: WritableMap | None = None
    is_picked: bool = False


@dataclass
class FileListing:
    """A file, its contacts, their number at lower thresholds, seabed, time of the detection, and masked pings."""

    info: SurveyInfo
    origin: FileOrigin
    weaker: Mapping[float, int]
    seabed: tuple[StripDifficulty, ...]
    seconds: float
    masked_pings: int
    contacts: list[ListedContact] = field(default_factory=list)

    def sort(self) -> None:
        """Sort the contacts: most confident first, those without confidence last."""
        self.contacts.sort(key=lambda contact: -contact.detection.confidence)


class _Detection:
    """The detection in the files of one call."""

    def __init__(
        self,
        settings: DetectorSettings,
        options: SurveyOptions,
        vehicle_id: str,
        transmissions: TransmitIntervals,
        draw_seabed: DrawSeabed | None,
        *,
        with_images: bool,
    ) -> None:
        self._settings = settings
        self._options = options
        self._transmissions = transmissions
        self._vehicle_id = vehicle_id
        self._draw_seabed, self._with_images = draw_seabed, with_images
        self._detector = StreamDetector(self._describe, settings)
        self._results: list[FileListing] = []

    def run(self, files: Sequence[Path], display: ProgressDisplay) -> list[FileListing]:
        """Detect in the files in their order; a contact belongs to the file that contains its ping."""
        for number, path in enumerate(files):
            display.show(f"detecting in {path}", number, len(files))
            content = _content_hash(path)
            with open_survey(path, self._options) as source:
                info = source.info
                origin = FileOrigin.of(source, content)
                started_s = time.perf_counter()
                masked = MaskedSource(source, self._transmissions)
                found = self._detector.add_file(masked, origin)
            self._assign(found.released)
            seconds = time.perf_counter() - started_s
            listing = FileListing(info, origin, found.weaker, found.difficulties, seconds, masked.masked_count)
            self._results.append(listing)
            self._assign(found.contacts)
        self._assign(self._detector.finish())
        for result in self._results:
            result.sort()
        return self._results

    def add_picks(self, picks: Sequence[LocatedPick]) -> None:
        """Add the contacts of picks to the only file, and mark those that the detector has listed."""
        (result,) = self._results
        others = []
        for pick in picks:
            at_pick = (
                number
                for number, contact in enumerate(result.contacts)
                if is_at_detection(contact.detection, pick.row, pick.pick, self._settings)
            )
            if (number := next(at_pick, None)) is None:
                others.append(pick)
            else:
                result.contacts[number] = replace(result.contacts[number], is_picked=True)
        if others:
            with open_survey(result.info.path, self._options) as source:
                found = measure_picks(source, result.origin, others, self._describe_pick, self._settings)
            # Two picks may be on one object.
            result.contacts += {contact.record.contact_id: contact for contact in found}.values()
        result.sort()

    def _assign(self, contacts: Sequence[StreamContact[ListedContact]]) -> None:
        for contact in contacts:
            latest = next(result for result in reversed(self._results) if result.origin == contact.origin.file)
            latest.contacts.append(contact.content)

    def _describe(self, survey: Survey, detection: Detection, origin: PingOrigin) -> ListedContact:
        record = contact_record(detection, origin.file, self._vehicle_id, survey.sonar_id)
        return self._listed(survey, detection, origin, record)

    def _describe_pick(self, survey: Survey, picked: PickedDetection, origin: PingOrigin) -> ListedContact:
        record = picked.record(origin.file, self._vehicle_id, survey.sonar_id)
        return replace(self._listed(survey, picked.detection, origin, record), is_picked=True)

    def _listed(self, survey: Survey, detection: Detection, origin: PingOrigin, record: Contact) -> ListedContact:
        first, end = (row + origin.row - detection.ping_index for row in detection.highlight_pings)
        in_file = replace(detection, ping_index=origin.row, highlight_pings=(first, end))
        if not self._with_images:
            return ListedContact(in_file, record)
        image = cut_snippet(survey, detection).image
        ground = ground_projected_image(survey, detection, _GROUND_PX, _GROUND_PX, _GROUND_PIXEL_M)
        seabed = None
        if self._draw_seabed is not None:
            seabed = self._draw_seabed(survey, detection, _MAP_SIDE_M, _GROUND_PIXEL_M)
        return ListedContact(in_file, record, image, ground, seabed)


def _print_table(result: FileListing, threshold: float) -> None:
    info = result.info
    print(f"{info.path}: {info.ping_count} pings, {len(result.contacts)} contacts")
    for warning in info.warnings:
        print(f"  note: {warning}")
    if result.masked_pings:
        print(f"  note: {result.masked_pings} of {info.ping_count} pings masked: the modem transmitted")
    print(f"  {seabed_text(result.seabed, threshold)}")
    print(_HEADER if result.contacts else f"{counts_text(threshold, 0, result.weaker)}; see --threshold")
    for number, contact in enumerate(result.contacts, start=1):
        d, record = contact.detection, contact.record
        lat, lon = ("-", "-") if d.position is None else (f"{d.position.lat_deg:.6f}", f"{d.position.lon_deg:.6f}")
        print(
            f"{number:3d}  {_decimals(record.atd_confidence):>4}  {d.atd_class:9}  {_decimals(d.p_mine_like):>6}"
            f"  {_decimals(d.p_other_object):>7}  {d.side.value:9}  {d.ping_number:5d}  {d.sample:6d}"
            f"  {d.slant_range_m:7.1f}  {_decimals(record.length_m):>8}  {_decimals(record.width_m):>7}"
            f"  {_decimals(record.shadow_m):>8}"
            f"  {_decimals(d.height_m if record.shadow_m is not None else None):>8}"
            f"  {lat:>10}  {lon:>11}  {_decimals(d.position_sigma_m):>7}"
        )
    if picked := [str(number) for number, contact in enumerate(result.contacts, start=1) if contact.is_picked]:
        print(f"picked: {', '.join(picked)}")


def _decimals(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _file_json(result: FileListing, threshold: float) -> dict[str, object]:
    detected = sum(not c.is_picked or c.detection.confidence >= threshold for c in result.contacts)
    counts = ((threshold, detected), *result.weaker.items())
    return {
        "file": str(result.info.path),
        "pings": result.info.ping_count,
        "masked_pings": result.masked_pings,
        "warnings": list(result.info.warnings),
        "seconds": round(result.seconds, 3),
        "seabed": seabed_json(result.seabed, threshold),
        "contacts_above": {str(confidence): n for confidence, n in counts},
        "contacts": [contact_json(contact) for contact in result.contacts],
    }


def _plot_path(plot: Path, survey_path: Path, *, several: bool) -> Path:
    return plot.with_name(f"{plot.stem}-{survey_path.stem}{plot.suffix}") if several else plot


def _write_snippets(folder: Path, result: FileListing) -> None:
    """Write the snippet of each contact at the resolution of the recording and, if possible, at 10 cm a pixel.

    Each has a side-car with the fields of the contact. A georeferenced image has the suffix .tif and no side-car. The
    names of picked contacts contain "-pick".
    """
    for number, contact in enumerate(result.contacts, start=1):
        name = f"{result.info.path.stem}-{number:03d}{'-pick' if contact.is_picked else ''}"
        if contact.image is not None:
            write_png(folder / f"{name}.png", contact.image)
            write_side_car(folder / f"{name}.txt", contact.record)
        if contact.seabed is not None:
            contact.seabed.write(folder / f"{name}.tif")
        if contact.ground is not None:
            write_png(folder / f"{name}-ground.png", contact.ground)
            changes = {
                "contact_id": f"{contact.record.contact_id}-ground",
                "pixel_along_m": _GROUND_PIXEL_M,
                "pixel_across_m": _GROUND_PIXEL_M,
            }
            write_side_car(folder / f"{name}-ground.txt", contact.record.model_copy(update=changes))


def contact_json(contact: ListedContact) -> dict[str, object]:
    """Return one contact as JSON types: the fields of the contact record and its place in the survey."""
    d = contact.detection
    fields = contact.record.model_dump(mode="json", exclude={"type", "v", "schema_version", "time_utc_s"})
    return fields | {
        "ping": d.ping_index,
        "sample": d.sample,
        "time_utc": datetime.fromtimestamp(d.time_utc_s, UTC).isoformat(timespec="milliseconds"),
        "shadow_is_cut": d.shadow_is_cut,
        "scores": dataclasses.asdict(d.scores),
        "picked": contact.is_picked,
    }


def _content_hash(path: Path) -> str:
    """Return the hex SHA-256 of a file.

    Raises:
        SurveyFileError: It cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise SurveyFileError(str(path), "", error.strerror or str(error), "a readable survey file") from error


_COLOURS = {MINE_LIKE: (255, 80, 60), PICKED: (90, 200, 255)}
_OTHER_COLOUR = (255, 210, 60)
_MARGIN_PX = 6
_MAX_SIDE_PX = 1000


def annotated_waterfall(source: SurveySource, detections: Sequence[Detection]) -> Image.Image:
    """Draw the waterfall of `sonarpost survey plot` with a frame around highlight and shadow of each contact.

    A frame is red if the contact is mine-like, blue if only a person has picked it, else yellow. Its text is the number
    in `detections` (from 1) and the confidence.

    Returns:
        RGB image with scales of slant range, time and ping number.
    """
    samples = (len(channel.samples) for ping in source.pings() for side in Side if (channel := ping.channel(side)))
    reduced = reduce_survey(source, over_ground=False, side_px=min(max(samples), _MAX_SIDE_PX))
    image = draw_waterfall(reduced, f"{source.info.line_name}   {len(detections)} contacts", over_ground=False)
    draw = ImageDraw.Draw(image)
    for number, detection in enumerate(detections, start=1):
        far_sample = detection.highlight_samples[1] + detection.shadow_samples
        near_m, far_m = (sample * detection.pixel_across_m for sample in (detection.highlight_samples[0], far_sample))
        left, right = sorted(reduced.x(detection.side, range_m) for range_m in (near_m, far_m))
        top, bottom = map(reduced.y, detection.highlight_pings)
        frame = (left - _MARGIN_PX, top - _MARGIN_PX, right + _MARGIN_PX, bottom + _MARGIN_PX)
        colour = _COLOURS.get(detection.atd_class, _OTHER_COLOUR)
        draw.rectangle(frame, outline=colour)
        confidence = PICKED if detection.atd_class == PICKED else f"{detection.confidence:.2f}"
        draw.text((frame[0], frame[3] + 1), f"{number}: {confidence}", fill=colour)
    return image


def seabed_text(strips: Sequence[StripDifficulty], threshold: float) -> str:
    """Return the difficulty of a file as one line."""
    difficulty = combined(strip.difficulty for strip in strips)
    if difficulty is None:
        return "seabed: too little of it is known to state its difficulty"
    return (
        f"seabed: {difficulty.clutter_per_1000_m2:.0f} clutter echoes per 1000 m², "
        f"ripples {difficulty.ripple_strength:.1f}, expected Pd {difficulty.expected_pd:.2f} at threshold {threshold:g}"
    )


def seabed_json(strips: Sequence[StripDifficulty], threshold: float) -> dict[str, object]:
    """Return the difficulty of a file and of each side of its strips as JSON types; unknown values are None."""
    return {
        "threshold": threshold,
        **_fields(combined(strip.difficulty for strip in strips)),
        "strips": [
            {
                "first_ping": strip.first_row,
                "end_ping": strip.end_row,
                "channel": strip.side.value,
                **_fields(strip.difficulty),
            }
            for strip in strips
        ],
    }


def _fields(difficulty: Difficulty | None) -> dict[str, float | None]:
    values = {} if difficulty is None else dataclasses.asdict(difficulty)
    return {name: round(values[name], 3) if name in values else None for name in Difficulty.__dataclass_fields__}
