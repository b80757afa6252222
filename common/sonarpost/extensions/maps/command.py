"""`sonarpost survey coverage`, `mosaic` and `waterfall`: covered seabed as polygons, images of it as GeoTIFF."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import add_survey_options, in_new_folder, make_output_folder, option, survey_options_of
from sonarpost.errors import ConfigError
from sonarpost.extensions.maps.coverage import (
    CoveragePolygon,
    survey_coverage,
    write_coverage_geojson,
    write_coverage_geopackage,
)
from sonarpost.extensions.maps.ground_canvas import MIN_RESOLUTION_M
from sonarpost.extensions.maps.ground_images import write_mosaic, write_waterfalls

WRITERS: Final[Mapping[str, Callable[[Path, Sequence[CoveragePolygon]], None]]] = {
    ".gpkg": write_coverage_geopackage,
    ".geojson": write_coverage_geojson,
}
"""Suffix -> function that writes the file."""


def add_coverage(parser: CommandParser) -> None:
    """Add the action."""
    parser.description = "Write the outline of the swath, a polygon for each part of a line without gap, in WGS 84."
    option(parser, "files FILE", "survey file", Path, nargs="+")
    option(parser, "--out FILE", "file to write, named *.gpkg or *.geojson", Path, required=True)
    add_survey_options(parser)
    parser.set_defaults(run=run_coverage)


def run_coverage(parsed: argparse.Namespace) -> int:
    """Write the polygons; return 0.

    Raises:
        ConfigError: The name of the file has another suffix.
        SurveyFileError: A recording cannot be read, or none can be positioned.
    """
    write = coverage_writer(parsed.out, "survey coverage", "--out")
    options = survey_options_of(parsed)
    in_new_folder(parsed.out)
    with ProgressDisplay(step="outlining the swath"):
        coverage = survey_coverage(parsed.files, options)
        write(parsed.out, coverage.polygons)
    area_m2 = sum(polygon.area_m2 for polygon in coverage.polygons)
    print(f"{parsed.out}: polygons {len(coverage.polygons)}, area {area_m2:.0f} m², pings {coverage.pings}")
    print_left_out(coverage.left_out)
    return 0


def coverage_writer(path: Path, command: str, option: str) -> Callable[[Path, Sequence[CoveragePolygon]], None]:
    """Return the function that writes a file of this name.

    Raises:
        ConfigError: The name has another suffix.
    """
    if (write := WRITERS.get(path.suffix.lower())) is None:
        raise ConfigError(command, option, str(path), "a file named *" + " or *".join(WRITERS))
    return write


def print_left_out(pings: int) -> None:
    """Print the number of pings that could not be placed, if there are any."""
    if pings:
        print(f"left out: {pings} pings without position, heading or altitude")


def add_mosaic(parser: CommandParser) -> None:
    """Add the action."""
    option(parser, "files FILE", "survey file", Path, nargs="+")
    option(parser, "--out FILE.tif", "the GeoTIFF to write", Path, required=True)
    option(parser, "--resolution-m M", "side of a pixel in metres", float, 0.1)
    option(parser, "--coverage FILE", "also write the covered area as polygons, *.gpkg or *.geojson", Path)
    add_survey_options(parser)
    parser.set_defaults(run=run_mosaic)


def run_mosaic(parsed: argparse.Namespace) -> int:
    """Write the mosaic; return 0.

    Raises:
        ConfigError: The resolution is out of range, or the name of the coverage has another suffix.
        SurveyFileError: A recording cannot be read or positioned.
    """
    check_resolution(parsed.resolution_m, "survey mosaic")
    write_coverage = None
    if parsed.coverage is not None:
        write_coverage = coverage_writer(parsed.coverage, "survey mosaic", "--coverage")
        in_new_folder(parsed.coverage)
    options = survey_options_of(parsed)
    in_new_folder(parsed.out)
    with ProgressDisplay(step="drawing the mosaic"):
        result = write_mosaic(parsed.files, parsed.out, parsed.resolution_m, options)
        if write_coverage is not None:
            write_coverage(parsed.coverage, result.coverage.polygons)
    height_px, width_px = result.size_px
    print(
        f"{parsed.out}: {width_px} x {height_px} px of {parsed.resolution_m:g} m, EPSG:{result.transform.epsg}, "
        f"{result.coverage.pings} pings"
    )
    print_left_out(result.coverage.left_out)
    return 0


def add_waterfall(parser: CommandParser) -> None:
    """Add the options of `survey waterfall`."""
    parser.description = (
        "Write LINE-waterfall-N.tif for each straight line of every survey file: over ground, along-track upwards, "
        "port on the left."
    )
    option(parser, "files FILE", "survey file", Path, nargs="+")
    option(parser, "--out DIR", "output folder", Path, Path())
    option(parser, "--resolution-m M", "side of a pixel in metres", float, 0.1)
    add_survey_options(parser)
    parser.set_defaults(run=run_waterfall)


def run_waterfall(parsed: argparse.Namespace) -> int:
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
