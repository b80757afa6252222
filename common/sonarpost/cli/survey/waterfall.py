"""`sonarpost survey waterfall FILE...`: the waterfall of each straight line as georeferenced GeoTIFF."""

from __future__ import annotations

import argparse
from pathlib import Path

from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import Subparsers, add_survey_options, make_output_folder, survey_options_of
from sonarpost.errors import ConfigError
from sonarpost.sonar.maps.ground_canvas import MIN_RESOLUTION_M
from sonarpost.sonar.maps.waterfall import write_waterfalls


def add_action(actions: Subparsers) -> None:
    """Add the action."""
    parser = actions.add_parser(
        "waterfall",
        help="write the waterfall of each straight line as cloud-optimised GeoTIFF",
        description="Write LINE-waterfall-N.tif for each straight line of every survey file: over ground, along-track "
        "upwards, port on the left.",
    )
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE", help="survey file")
    parser.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="output folder (default: .)")
    parser.add_argument(
        "--resolution-m", type=float, default=0.1, metavar="M", help="side of a pixel in metres (default: %(default)s)"
    )
    add_survey_options(parser)
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Write the waterfalls of every file and print their names; return 0.

    Raises:
        ConfigError: The resolution is out of range.
        SurveyFileError: A recording cannot be read or positioned, or has no straight line.
    """
    check_resolution(parsed.resolution_m, "survey waterfall")
    options = survey_options_of(parsed)
    make_output_folder(parsed.out)
    for path in parsed.files:
        with ProgressDisplay(step=f"drawing {path}"):
            waterfalls = write_waterfalls(path, parsed.out, parsed.resolution_m, options)
        for waterfall in waterfalls:
            height_px, width_px = waterfall.size_px
            print(
                f"{waterfall.path}: {width_px} x {height_px} px of {parsed.resolution_m:g} m, "
                f"EPSG:{waterfall.transform.epsg}, pings {waterfall.first_ping} to {waterfall.last_ping}"
            )
    return 0


def check_resolution(resolution_m: float, command: str) -> None:
    """Check --resolution-m.

    Raises:
        ConfigError: It is out of range.
    """
    if not MIN_RESOLUTION_M <= resolution_m <= 1000:  # includes NaN
        raise ConfigError(command, "--resolution-m", resolution_m, f"{MIN_RESOLUTION_M} to 1000 metres")
