"""`sonarpost detect FILE…`: the contacts of survey files, as a table, as JSON lines, or drawn into the waterfall."""

from __future__ import annotations

import argparse
import io
import json
from collections.abc import Sequence
from pathlib import Path

from sonarpost.detect.contacts import Detection, detect
from sonarpost.detect.plot import annotated_waterfall
from sonarpost.detect.settings import DetectorSettings
from sonarpost.errors import ConfigError
from sonarpost.files import write_atomically
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import Survey

_HEADER = "  n  conf  class      side       ping  sample  range_m  length_m  width_m  shadow_m  height_m  position"


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "detect",
        help="find the contacts of survey files",
        description="Find highlights with shadows in side-scan surveys and list them, most confident first.",
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="survey file")
    parser.add_argument("--json", action="store_true", help="one JSON object a contact and line instead of a table")
    parser.add_argument(
        "--plot",
        type=Path,
        metavar="FILE.png",
        help="draw the contacts into the waterfall; with several survey files each one's name is put before the suffix",
    )
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
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Detect in every file and print what was found.

    Raises:
        SurveyFileError: A file cannot be read.
        OSError: The plot cannot be written.
        ConfigError: An option's value is out of range.
    """
    try:
        settings = DetectorSettings(confidence_threshold=parsed.threshold, max_contacts=parsed.max_contacts)
    except ValueError as error:
        value = (parsed.threshold, parsed.max_contacts)
        raise ConfigError("detect", "--threshold, --max-contacts", value, str(error)) from error
    files: list[Path] = parsed.files
    for path in files:
        survey = read_survey(path)
        detections = detect(survey, settings)
        if parsed.json:
            for detection in detections:
                print(json.dumps(_plain(path, detection)))
        else:
            _print_table(path, survey, detections)
        if parsed.plot is not None:
            _plot(_plot_path(parsed.plot, path, several=len(files) > 1), survey, detections)
    return 0


def _print_table(path: Path, survey: Survey, detections: Sequence[Detection]) -> None:
    print(f"{path}: {len(survey.pings)} pings, {len(detections)} contacts")
    for warning in survey.warnings:
        print(f"  note: {warning}")
    if detections:
        print(_HEADER)
    for number, d in enumerate(detections, start=1):
        place = f"{d.position.lat_deg:.6f} {d.position.lon_deg:.6f}" if d.position is not None else "-"
        print(
            f"{number:3d}  {d.confidence:4.2f}  {d.atd_class:9}  {d.side.value:9}  {d.ping_number:5d}  {d.sample:6d}"
            f"  {d.slant_range_m:7.1f}  {_metres(d.length_m):>8}  {d.width_m:7.2f}  {d.shadow_m:8.2f}"
            f"  {_metres(d.height_m):>8}  {place}"
        )


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _plain(path: Path, d: Detection) -> dict[str, object]:
    """One contact as JSON types, with the field names of the contact record where they are the same thing."""
    return {
        "file": str(path),
        "ping_number": d.ping_number,
        "channel": d.side.value,
        "sample": d.sample,
        "time_utc_s": d.time_utc_s,
        "lat_deg": None if d.position is None else d.position.lat_deg,
        "lon_deg": None if d.position is None else d.position.lon_deg,
        "heading_deg": d.heading_deg,
        "altitude_m": d.altitude_m,
        "depth_m": d.depth_m,
        "speed_mps": d.speed_mps,
        "slant_range_m": d.slant_range_m,
        "ground_range_m": d.ground_range_m,
        "length_m": d.length_m,
        "width_m": d.width_m,
        "shadow_m": d.shadow_m,
        "shadow_is_cut": d.shadow_is_cut,
        "height_m": d.height_m,
        "atd_class": d.atd_class,
        "atd_confidence": d.confidence,
        "scores": {"matched": d.scores.matched, "cfar": d.scores.cfar, "shadow": d.scores.shadow},
        "pixel_along_m": d.pixel_along_m,
        "pixel_across_m": d.pixel_across_m,
    }


def _plot_path(plot: Path, survey_path: Path, *, several: bool) -> Path:
    return plot.with_name(f"{plot.stem}-{survey_path.stem}{plot.suffix}") if several else plot


def _plot(path: Path, survey: Survey, detections: Sequence[Detection]) -> None:
    buffer = io.BytesIO()
    annotated_waterfall(survey, detections).save(buffer, format="PNG")
    write_atomically(path, buffer.getvalue())
