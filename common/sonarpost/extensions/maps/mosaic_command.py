"""`sonarpost survey mosaic FILE...`: a mosaic of the seabed as GeoTIFF, and its coverage as polygons."""

from __future__ import annotations

import argparse
from pathlib import Path

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import add_survey_options, in_new_folder, option, survey_options_of
from sonarpost.cli.survey.waterfall import check_resolution
from sonarpost.extensions.maps.coverage_command import coverage_writer, print_left_out
from sonarpost.extensions.maps.mosaic import write_mosaic


def add_options(parser: CommandParser) -> None:
    """Add the action."""
    option(parser, "files FILE", "survey file", Path, nargs="+")
    option(parser, "--out FILE.tif", "the GeoTIFF to write", Path, required=True)
    option(parser, "--resolution-m M", "side of a pixel in metres", float, 0.1)
    option(parser, "--coverage FILE", "also write the covered area as polygons, *.gpkg or *.geojson", Path)
    add_survey_options(parser)
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
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
