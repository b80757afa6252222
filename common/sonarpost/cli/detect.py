"""`sonarpost detect FILE…`: the contacts of survey files as a table, as JSON, or drawn into the waterfall."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

from PIL import Image, ImageDraw

from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import (
    Subparsers,
    add_survey_options,
    in_new_folder,
    make_output_folder,
    survey_options_of,
)
from sonarpost.cli.survey.plot import draw_waterfall, reduce_survey
from sonarpost.detection.detector import MINE_LIKE, Detection, counts_text
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.snippets import cut_snippet, ground_projected_image
from sonarpost.detection.stream import StreamContact, StreamDetector
from sonarpost.errors import ConfigError
from sonarpost.files import write_atomically
from sonarpost.messages import Contact
from sonarpost.sonar.image_files import encode_png, write_png
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.side_car import write_side_car
from sonarpost.sonar.source import InMemorySource
from sonarpost.sonar.survey import Survey

_HEADER = (
    "  n  conf  class      side       ping  sample  range_m  length_m  width_m  shadow_m  height_m"
    "     lat_deg      lon_deg  sigma_m"
)

# Size of the snippets that are projected to the bottom: 10 m x 10 m.
_GROUND_PX = 100
_GROUND_PIXEL_M = 0.1


def add_parser(subparsers: Subparsers) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "detect",
        help="detect contacts in survey files",
        description="Detect highlights with shadows in side-scan surveys and list them, most confident first. Files "
        "that continue each other are one line: an object at a file boundary is listed once.",
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="survey file")
    parser.add_argument("--json", action="store_true", help="print one JSON object with every file's contacts")
    parser.add_argument(
        "--plot",
        type=Path,
        metavar="FILE.png",
        help="draw the contacts into the waterfall; with several survey files, the name of each precedes the suffix",
    )
    parser.add_argument(
        "--snippets", type=Path, metavar="DIR", help="write the snippets of each contact into this folder"
    )
    parser.add_argument(
        "--threshold",
        type=float,
        default=DetectorSettings().confidence_threshold,
        metavar="CONFIDENCE",
        help="minimum confidence, 0 to 2 (default: %(default)s)",
    )
    parser.add_argument(
        "--max-contacts", type=int, metavar="N", help="list at most the N most confident contacts of a file"
    )
    add_survey_options(parser)
    parser.add_argument("--vehicle", default="uuv", metavar="ID", help="vehicle_id of the records (default: uuv)")
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Detect in every file and print the contacts."""
    try:
        settings = DetectorSettings(confidence_threshold=parsed.threshold, max_contacts=parsed.max_contacts)
    except ValueError as error:
        value = (parsed.threshold, parsed.max_contacts)
        raise ConfigError("detect", "--threshold, --max-contacts", value, str(error)) from error
    options = survey_options_of(parsed)
    files: list[Path] = parsed.files
    if parsed.plot is not None:
        in_new_folder(parsed.plot)
    if parsed.snippets is not None:
        make_output_folder(parsed.snippets)
    with ProgressDisplay() as display:
        results = _detect_files(files, settings, options, display)
    for result in results:
        if not parsed.json:
            _print_table(result, settings.confidence_threshold)
        if parsed.plot is not None:
            path = _plot_path(parsed.plot, result.survey.path, several=len(files) > 1)
            image = annotated_waterfall(result.survey, [contact.in_file() for contact in result.contacts])
            write_atomically(path, encode_png(image))
        if parsed.snippets is not None:
            _write_snippets(parsed.snippets, result, parsed.vehicle)
    if parsed.json:
        found = [_file_json(r, parsed.vehicle, settings.confidence_threshold) for r in results]
        print(json.dumps({"files": found}, allow_nan=False))
    return 0


def _detect_files(
    files: Sequence[Path], settings: DetectorSettings, options: SurveyOptions, display: ProgressDisplay
) -> list[FileResult]:
    """Detect in the files in their order; a contact belongs to the file that contains its ping."""
    detector = StreamDetector(settings, options)
    results: list[FileResult] = []
    for number, path in enumerate(files):
        display.show(f"reading {path}", number, len(files))
        survey = read_survey(path, options)
        display.show(f"detecting in {path}", number, len(files))
        started_s = time.perf_counter()
        contacts = detector.add_file(survey)
        results.append(FileResult(survey, []))
        results[-1].seconds += time.perf_counter() - started_s
        _assign(contacts, results)
    _assign(detector.finish(), results)
    for result, weaker in zip(results, detector.weaker, strict=True):
        result.count, result.weaker = len(result.contacts), weaker
        result.contacts.sort(key=lambda c: -c.detection.confidence)
        del result.contacts[settings.max_contacts or len(result.contacts) :]
    return results


def _assign(contacts: Sequence[StreamContact], results: Sequence[FileResult]) -> None:
    for contact in contacts:
        results[contact.file].contacts.append(contact)


def _print_table(result: FileResult, threshold: float) -> None:
    survey = result.survey
    print(f"{survey.path}: {len(survey.pings)} pings, {len(result.contacts)} contacts")
    for warning in survey.warnings:
        print(f"  note: {warning}")
    print(_HEADER if result.contacts else f"{counts_text(threshold, 0, result.weaker)}; see --threshold")
    for number, contact in enumerate(result.contacts, start=1):
        d = contact.detection
        lat, lon = ("-", "-") if d.position is None else (f"{d.position.lat_deg:.6f}", f"{d.position.lon_deg:.6f}")
        print(
            f"{number:3d}  {d.confidence:4.2f}  {d.atd_class:9}  {d.side.value:9}  {d.ping_number:5d}  {d.sample:6d}"
            f"  {d.slant_range_m:7.1f}  {_metres(d.length_m):>8}  {d.width_m:7.2f}  {d.shadow_m:8.2f}"
            f"  {_metres(d.height_m):>8}  {lat:>10}  {lon:>11}  {_metres(d.position_sigma_m):>7}"
        )


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _file_json(result: FileResult, vehicle_id: str, threshold: float) -> dict[str, object]:
    return {
        "file": str(result.survey.path),
        "pings": len(result.survey.pings),
        "warnings": list(result.survey.warnings),
        "seconds": round(result.seconds, 3),
        "contacts_above": {str(confidence): n for confidence, n in ((threshold, result.count), *result.weaker.items())},
        "contacts": [contact_json(result.survey, contact, vehicle_id) for contact in result.contacts],
    }


def _plot_path(plot: Path, survey_path: Path, *, several: bool) -> Path:
    return plot.with_name(f"{plot.stem}-{survey_path.stem}{plot.suffix}") if several else plot


def _write_snippets(folder: Path, result: FileResult, vehicle_id: str) -> None:
    """Write the snippet of each contact at the resolution of the recording and, if possible, at 10 cm a pixel.

    Each has a side-car with the fields of the contact.
    """
    for number, contact in enumerate(result.contacts, start=1):
        name = f"{result.survey.path.stem}-{number:03d}"
        fields = contact_json(result.survey, contact, vehicle_id) | {"time_utc_s": contact.detection.time_utc_s}
        record = Contact.model_validate({key: value for key, value in fields.items() if key in Contact.model_fields})
        write_png(folder / f"{name}.png", cut_snippet(contact.survey, contact.detection).image)
        write_side_car(folder / f"{name}.txt", record)
        ground = ground_projected_image(contact.survey, contact.detection, _GROUND_PX, _GROUND_PX, _GROUND_PIXEL_M)
        if ground is not None:
            write_png(folder / f"{name}-ground.png", ground)
            changes = {
                "contact_id": f"{record.contact_id}-ground",
                "pixel_along_m": _GROUND_PIXEL_M,
                "pixel_across_m": _GROUND_PIXEL_M,
            }
            write_side_car(folder / f"{name}-ground.txt", record.model_copy(update=changes))


@dataclass
class FileResult:
    """A file, its contacts, their number at the threshold and at lower ones, and the time of the detection."""

    survey: Survey
    contacts: list[StreamContact]
    seconds: float = 0.0
    count: int = 0
    weaker: dict[float, int] = field(default_factory=dict)


def contact_json(survey: Survey, contact: StreamContact, vehicle_id: str) -> dict[str, object]:
    """Return one contact as JSON types: the fields of the contact record and its place in the survey.

    Args:
        survey: The file that contains the ping of the contact.
        contact: The contact.
        vehicle_id: Vehicle of the record.
    """
    d = contact.detection
    line_name = survey.line_name.encode("utf-8", "backslashreplace").decode()
    return {
        "contact_id": f"{line_name[:60]}-{_content_hash(survey.path)[:8]}-{d.ping_number}-{d.side.value}-{d.sample}",
        "vehicle_id": vehicle_id,
        "sonar_id": survey.sonar_id,
        "line_name": line_name,
        "ping_number": d.ping_number,
        "channel": d.side.value,
        "ping": contact.ping,
        "sample": d.sample,
        "time_utc": datetime.fromtimestamp(d.time_utc_s, UTC).isoformat(timespec="milliseconds"),
        "lat_deg": None if d.position is None else d.position.lat_deg,
        "lon_deg": None if d.position is None else d.position.lon_deg,
        "position_sigma_m": d.position_sigma_m,
        "depth_m": d.depth_m,
        "altitude_m": d.altitude_m,
        "heading_deg": d.heading_deg,
        "speed_mps": d.speed_mps,
        "slant_range_m": d.slant_range_m,
        "ground_range_m": d.ground_range_m,
        "atd_class": d.atd_class,
        "atd_confidence": d.confidence,
        "length_m": d.length_m,
        "width_m": d.width_m,
        "shadow_m": d.shadow_m,
        "shadow_is_cut": d.shadow_is_cut,
        "height_m": d.height_m,
        "pixel_along_m": d.pixel_along_m,
        "pixel_across_m": d.pixel_across_m,
        "scores": dataclasses.asdict(d.scores),
    }


@cache
def _content_hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


_COLOURS = {MINE_LIKE: (255, 80, 60)}
_OTHER_COLOUR = (255, 210, 60)
_MARGIN_PX = 6
_MAX_SIDE_PX = 1000


def annotated_waterfall(survey: Survey, detections: Sequence[Detection]) -> Image.Image:
    """Draw the waterfall of `sonarpost survey plot` with a frame around highlight and shadow of each contact.

    A frame is red if the contact is mine-like, else yellow. Its text is the number in `detections` (from 1) and the
    confidence.

    Returns:
        RGB image with scales of slant range, time and ping number.
    """
    side_px = min(max(survey.sample_count(side) for side in survey.sides()), _MAX_SIDE_PX)
    reduced = reduce_survey(InMemorySource(survey, SurveyOptions()), over_ground=False, side_px=side_px)
    image = draw_waterfall(reduced, f"{survey.line_name}   {len(detections)} contacts", over_ground=False)
    draw = ImageDraw.Draw(image)
    for number, detection in enumerate(detections, start=1):
        far_sample = detection.highlight_samples[1] + detection.shadow_samples
        near_m, far_m = (sample * detection.pixel_across_m for sample in (detection.highlight_samples[0], far_sample))
        left, right = sorted(reduced.x(detection.side, range_m) for range_m in (near_m, far_m))
        top, bottom = map(reduced.y, detection.highlight_pings)
        frame = (left - _MARGIN_PX, top - _MARGIN_PX, right + _MARGIN_PX, bottom + _MARGIN_PX)
        colour = _COLOURS.get(detection.atd_class, _OTHER_COLOUR)
        draw.rectangle(frame, outline=colour)
        draw.text((frame[0], frame[3] + 1), f"{number}: {detection.confidence:.2f}", fill=colour)
    return image
