"""`sonarpost survey waterfall FILE...`: the waterfall of each straight line as georeferenced GeoTIFF."""

from __future__ import annotations

import argparse
from pathlib import Path

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import add_survey_options, make_output_folder, option, survey_options_of
from sonarpost.errors import ConfigError
from sonarpost.sonar.maps.ground_canvas import MIN_RESOLUTION_M
from sonarpost.sonar.maps.waterfall import write_waterfalls


def add_actions(parser: CommandParser) -> None:
    """Add the action."""
    parser = parser.add_action(
        "waterfall",
        "write the waterfall of each straight line as cloud-optimised GeoTIFF",
        run,
        "line.xtf --out waterfalls",
        "Write LINE-waterfall-N.tif for each straight line of every survey file: over ground, along-track "
        "upwards, port on the left.",
    )
    option(parser, "files FILE", "survey file", Path, nargs="+")
    option(parser, "--out DIR", "output folder", Path, Path())
    option(parser, "--resolution-m M", "side of a pixel in metres", float, 0.1)
    add_survey_options(parser)


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
