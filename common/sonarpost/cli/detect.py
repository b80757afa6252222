"""`sonarpost detect FILE…`: the contacts of survey files as a table, as JSON, or drawn into the waterfall."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from sonarpost.cli.shared import Subparsers
from sonarpost.detection.detector import MINE_LIKE, Detection
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.snippets import cut_snippet, ground_projected_image, to_grey
from sonarpost.detection.stream import StreamContact, StreamDetector
from sonarpost.errors import ConfigError
from sonarpost.files import write_atomically
from sonarpost.sonar.image_files import encode_png, write_png
from sonarpost.sonar.options import SurveyOptions, load_options
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import Side, Survey

_HEADER = (
    "  n  conf  class      side       ping  sample  range_m  length_m  width_m  shadow_m  height_m  position"
    "                sigma_m"
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
    parser.add_argument(
        "--options", type=Path, metavar="FILE.toml", help="mounting, errors, projection (see the page Surveys)"
    )
    parser.add_argument("--vehicle", default="uuv", metavar="ID", help="vehicle_id of the records (default: uuv)")
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Detect in every file and print the contacts."""
    try:
        settings = DetectorSettings(confidence_threshold=parsed.threshold, max_contacts=parsed.max_contacts)
    except ValueError as error:
        value = (parsed.threshold, parsed.max_contacts)
        raise ConfigError("detect", "--threshold, --max-contacts", value, str(error)) from error
    options = SurveyOptions() if parsed.options is None else load_options(parsed.options)
    files: list[Path] = parsed.files
    results = _detect_files(files, settings, options)
    for result in results:
        if not parsed.json:
            _print_table(result)
        if parsed.plot is not None:
            path = _plot_path(parsed.plot, result.survey.path, several=len(files) > 1)
            image = annotated_waterfall(result.survey, [contact.in_file() for contact in result.contacts])
            write_atomically(path, encode_png(image))
        if parsed.snippets is not None:
            _write_snippets(parsed.snippets, result)
    if parsed.json:
        print(json.dumps({"files": [_file_json(r, parsed.vehicle) for r in results]}, allow_nan=False))
    return 0


def _detect_files(files: Sequence[Path], settings: DetectorSettings, options: SurveyOptions) -> list[FileResult]:
    """Detect in the files in their order; a contact belongs to the file that contains its ping."""
    detector = StreamDetector(settings, options)
    results: list[FileResult] = []
    for path in files:
        survey = read_survey(path, options)
        started_s = time.perf_counter()
        contacts = detector.add_file(survey)
        results.append(FileResult(survey, []))
        results[-1].seconds += time.perf_counter() - started_s
        _assign(contacts, results)
    _assign(detector.finish(), results)
    for result in results:
        result.contacts.sort(key=lambda c: -c.detection.confidence)
        del result.contacts[settings.max_contacts or len(result.contacts) :]
    return results


def _assign(contacts: Sequence[StreamContact], results: Sequence[FileResult]) -> None:
    for contact in contacts:
        results[contact.file].contacts.append(contact)


def _print_table(result: FileResult) -> None:
    survey = result.survey
    print(f"{survey.path}: {len(survey.pings)} pings, {len(result.contacts)} contacts")
    for warning in survey.warnings:
        print(f"  note: {warning}")
    if result.contacts:
        print(_HEADER)
    for number, contact in enumerate(result.contacts, start=1):
        d = contact.detection
        place = f"{d.position.lat_deg:.6f} {d.position.lon_deg:.6f}" if d.position is not None else "-"
        print(
            f"{number:3d}  {d.confidence:4.2f}  {d.atd_class:9}  {d.side.value:9}  {d.ping_number:5d}  {d.sample:6d}"
            f"  {d.slant_range_m:7.1f}  {_metres(d.length_m):>8}  {d.width_m:7.2f}  {d.shadow_m:8.2f}"
            f"  {_metres(d.height_m):>8}  {place}  {_metres(d.position_sigma_m):>6}"
        )


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _file_json(result: FileResult, vehicle_id: str) -> dict[str, object]:
    return {
        "file": str(result.survey.path),
        "pings": len(result.survey.pings),
        "seconds": round(result.seconds, 3),
        "contacts": [contact_json(result.survey, contact, vehicle_id) for contact in result.contacts],
    }


def _plot_path(plot: Path, survey_path: Path, *, several: bool) -> Path:
    return plot.with_name(f"{plot.stem}-{survey_path.stem}{plot.suffix}") if several else plot


def _write_snippets(folder: Path, result: FileResult) -> None:
    """Write the snippet of each contact at the resolution of the recording and, if possible, at 10 cm a pixel."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, contact in enumerate(result.contacts, start=1):
        name = f"{result.survey.path.stem}-{number:03d}"
        write_png(folder / f"{name}.png", cut_snippet(contact.survey, contact.detection).image)
        ground = ground_projected_image(contact.survey, contact.detection, _GROUND_PX, _GROUND_PX, _GROUND_PIXEL_M)
        if ground is not None:
            write_png(folder / f"{name}-ground.png", ground)


@dataclass
class FileResult:
    """A file, its contacts, and the time of the detection."""

    survey: Survey
    contacts: list[StreamContact]
    seconds: float = 0.0


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


def annotated_waterfall(survey: Survey, detections: Sequence[Detection]) -> Image.Image:
    """Draw a survey with port on the left, the track of the vehicle in the middle, and the first ping at the top.

    A frame encloses highlight and shadow of each contact, red if mine-like, else yellow. Its text is the number in
    `detections` (from 1) and the confidence.

    Returns:
        RGB image, one row a ping, one column a sample; 1 x 1 for a survey without samples.
    """
    halves = {side: _grey(survey, side) for side in survey.sides()}
    if not halves or not survey.pings:
        return Image.new("RGB", (1, 1))
    track = halves[Side.PORT].shape[1] if Side.PORT in halves else 0
    columns = [image[:, ::-1] if side is Side.PORT else image for side, image in halves.items()]
    waterfall = Image.fromarray(np.hstack(columns)).convert("RGB")
    draw = ImageDraw.Draw(waterfall)
    for number, detection in enumerate(detections, start=1):
        near = detection.highlight_samples[0] - _MARGIN_PX
        far = detection.highlight_samples[1] + detection.shadow_samples + _MARGIN_PX
        left, right = (track - far, track - near) if detection.side is Side.PORT else (track + near, track + far)
        top, bottom = detection.highlight_pings[0] - _MARGIN_PX, detection.highlight_pings[1] + _MARGIN_PX
        colour = _COLOURS.get(detection.atd_class, _OTHER_COLOUR)
        draw.rectangle((left, top, right, bottom), outline=colour)
        draw.text((left, bottom + 1), f"{number}: {detection.confidence:.2f}", fill=colour)
    return waterfall


def _grey(survey: Survey, side: Side) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    image = survey.waterfall(side)
    known = np.isfinite(image)
    return to_grey(np.where(known, image, 0.0).astype(np.uint32), known)
