"""`sonarpost detect FILE…`: the contacts of survey files, as a table, as JSON, or drawn into the waterfall."""

from __future__ import annotations

import argparse
import io
import json
import time
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from sonarpost.cli.detect_record import FoundIn, contact_json
from sonarpost.detection.ground_snippet import cut_ground_snippet
from sonarpost.detection.plot import annotated_waterfall
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.snippet import cut_snippet
from sonarpost.detection.stream import StreamContact, StreamDetector
from sonarpost.errors import ConfigError
from sonarpost.files import write_atomically
from sonarpost.sonar.options import SurveyOptions, load_options
from sonarpost.sonar.readers.registry import read_survey

_HEADER = (
    "  n  conf  class      side       ping  sample  range_m  length_m  width_m  shadow_m  height_m  position"
    "                sigma_m"
)


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "detect",
        help="find the contacts of survey files",
        description="Find highlights with shadows in side-scan surveys and list them, most confident first. Files "
        "that go on where the one before ended are one line: what lies on their seam is found once.",
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="survey file")
    parser.add_argument("--json", action="store_true", help="print one JSON object with every file's contacts")
    parser.add_argument(
        "--plot",
        type=Path,
        metavar="FILE.png",
        help="draw the contacts into the waterfall; with several survey files each one's name is put before the suffix",
    )
    parser.add_argument("--snippets", type=Path, metavar="DIR", help="write each contact's pictures into this folder")
    parser.add_argument(
        "--threshold",
        type=float,
        default=DetectorSettings().confidence_threshold,
        metavar="CONFIDENCE",
        help="least confidence, 0 to 2 (default: %(default)s)",
    )
    parser.add_argument(
        "--max-contacts", type=int, metavar="N", help="list no more than the N most confident of a file"
    )
    parser.add_argument(
        "--options", type=Path, metavar="FILE.toml", help="what the files do not say (docs/explanation/surveys.md)"
    )
    parser.add_argument("--vehicle", default="uuv", metavar="ID", help="vehicle_id of the records (default: uuv)")
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Detect in every file and print what was found.

    Raises:
        SurveyFileError: A file cannot be read.
        OSError: A picture cannot be written.
        ConfigError: An option's value is out of range.
    """
    try:
        settings = DetectorSettings(confidence_threshold=parsed.threshold, max_contacts=parsed.max_contacts)
    except ValueError as error:
        value = (parsed.threshold, parsed.max_contacts)
        raise ConfigError("detect", "--threshold, --max-contacts", value, str(error)) from error
    options = SurveyOptions() if parsed.options is None else load_options(parsed.options)
    files: list[Path] = parsed.files
    results = _detected(files, settings, options)
    for result in results:
        if not parsed.json:
            _print_table(result)
        if parsed.plot is not None:
            path = _plot_path(parsed.plot, result.survey.path, several=len(files) > 1)
            _write_png(path, annotated_waterfall(result.survey, [c.in_file() for c in result.contacts]))
        if parsed.snippets is not None:
            _write_snippets(parsed.snippets, result)
    if parsed.json:
        print(json.dumps({"files": [_file_json(r, parsed.vehicle) for r in results]}, allow_nan=False))
    return 0


def _detected(files: Sequence[Path], settings: DetectorSettings, options: SurveyOptions) -> list[FoundIn]:
    """Detect in the files as one line after another; a contact belongs to the file that holds its ping."""
    detector = StreamDetector(settings, options)
    results: list[FoundIn] = []
    for path in files:
        survey = read_survey(path, options)
        began = time.perf_counter()
        told = detector.feed(survey)
        results.append(FoundIn(survey, []))
        results[-1].seconds += time.perf_counter() - began
        _hand_out(told, results)
    _hand_out(detector.finish(), results)
    for result in results:
        result.contacts.sort(key=lambda c: -c.detection.confidence)
        del result.contacts[settings.max_contacts or len(result.contacts) :]
    return results


def _hand_out(told: Sequence[StreamContact], results: Sequence[FoundIn]) -> None:
    for contact in told:
        results[contact.file].contacts.append(contact)


def _print_table(result: FoundIn) -> None:
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


def _file_json(result: FoundIn, vehicle_id: str) -> dict[str, object]:
    return {
        "file": str(result.survey.path),
        "pings": len(result.survey.pings),
        "seconds": round(result.seconds, 3),
        "contacts": [contact_json(result.survey, contact, vehicle_id) for contact in result.contacts],
    }


def _plot_path(plot: Path, survey_path: Path, *, several: bool) -> Path:
    return plot.with_name(f"{plot.stem}-{survey_path.stem}{plot.suffix}") if several else plot


def _write_snippets(folder: Path, result: FoundIn) -> None:
    """Write each contact at the recording's own resolution and, where it is known, at 10 cm a pixel of seabed."""
    for number, contact in enumerate(result.contacts, start=1):
        name = f"{result.survey.path.stem}-{number:03d}"
        _write_png(folder / f"{name}.png", Image.fromarray(cut_snippet(contact.survey, contact.detection).image))
        ground = cut_ground_snippet(contact.survey, contact.detection)
        if ground is not None:
            _write_png(folder / f"{name}-ground.png", Image.fromarray(ground.image))


def _write_png(path: Path, picture: Image.Image) -> None:
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG")
    write_atomically(path, buffer.getvalue())
