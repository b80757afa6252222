"""`sonarpost survey export FILE`: the track as CSV (a line a ping) or GeoJSON, in constant memory."""

import argparse
import csv
import io
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import (
    add_survey_options,
    in_new_folder,
    option,
    print_notes,
    survey_options_of,
    utc_text,
)
from sonarpost.errors import SurveyFileError
from sonarpost.extensions.maps.geometry import geojson_geometry
from sonarpost.files import atomic_file
from sonarpost.sonar.readers import open_survey
from sonarpost.sonar.source import SurveySource
from sonarpost.sonar.survey import Ping

_MAX_GAP_S = 60.0
"""A longer time without fix ends a segment of the track."""
_MAX_FIXES = 100_000
"""Maximum length of a segment, which is held in memory; a longer one is divided."""
_FIELDS = (
    *("lat_deg", "lon_deg", "heading_deg", "altitude_m"),
    *("depth_m", "speed_mps", "pitch_deg", "roll_deg"),
)


def add_options(parser: CommandParser) -> None:
    """Add the options of `survey export`."""
    option(parser, "file FILE", "survey file", Path)
    option(parser, "--format", "output format", default="csv", choices=("csv", "geojson"))
    option(parser, "--out FILE", "output file (default: standard output)", Path)
    add_survey_options(parser)
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Write the track; return 0.

    Raises:
        SurveyFileError: The recording has no positions, or cannot be read.
    """
    write = write_csv if parsed.format == "csv" else write_geojson
    options = survey_options_of(parsed)
    with ProgressDisplay(step=f"reading {parsed.file}"), open_survey(parsed.file, options) as source:
        if all(ping.lat_deg is None for ping in source.pings()):
            raise _no_positions(source)
        print_notes(source.info)
        if parsed.out is not None:
            in_new_folder(parsed.out)
        if parsed.out is None:
            write(source, sys.stdout)
        else:
            with atomic_file(parsed.out) as file:
                out = io.TextIOWrapper(file, encoding="utf-8", newline="")
                write(source, out)
                out.detach()  # flushes the text; `atomic_file` closes the file
    return 0


def _no_positions(source: SurveySource) -> SurveyFileError:
    """Return the error for a recording without fixes."""
    where, pings = str(source.info.path), f"none in {source.info.ping_count} pings"
    if source.info.grid is None:
        return SurveyFileError(where, "positions", pings, "a recording with positions")
    if source.options.projected_crs is None:
        return SurveyFileError(
            where, "positions", "projected coordinates", "their projection, --crs EPSG:N (see sonarpost survey info)"
        )
    return SurveyFileError(where, "positions", pings, f"coordinates of {source.options.projected_crs}")


def write_csv(source: SurveySource, out: TextIO) -> None:
    """Write one line a ping; an unknown value is an empty field.

    Raises:
        SurveyFileError: The recording cannot be read.
    """
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(("number", "time_utc", *_FIELDS, "slant_range_m"))
    for ping in source.pings():
        values = ["" if (value := getattr(ping, name)) is None else f"{value:.10g}" for name in _FIELDS]
        range_m = ping.max_slant_range_m()
        writer.writerow((ping.number, utc_text(ping.time_utc_s), *values, "" if range_m is None else f"{range_m:.7g}"))


def write_geojson(source: SurveySource, out: TextIO) -> None:
    """Write a FeatureCollection (RFC 7946) with the segments of the track.

    A gap of a minute without fix ends a segment. It is a MultiLineString across the 180th meridian, a Point if single.

    Raises:
        SurveyFileError: The recording cannot be read.
    """
    out.write('{"type": "FeatureCollection", "features": [')
    separator = "\n"
    for segment in _segments(source.pings()):
        out.write(separator)
        _write_segment(segment, source.info.line_name, out)
        separator = ",\n"
    out.write("\n]}\n")


Fix = tuple[float, float, float, int]
"""Longitude and latitude in degrees, UTC seconds, ping number."""


def _segments(pings: Iterator[Ping]) -> Iterator[list[Fix]]:
    """Yield the fixes of each segment. Of a repeated position the first and the last fix are kept."""
    segment: list[Fix] = []
    for ping in pings:
        if ping.lat_deg is None or ping.lon_deg is None:
            continue
        fix = (ping.lon_deg, ping.lat_deg, ping.time_utc_s, ping.number)
        ended = segment and fix[2] - segment[-1][2] > _MAX_GAP_S
        if ended or len(segment) >= _MAX_FIXES:
            yield segment
            # After a division by length the next segment begins at the last fix.
            segment = [] if ended else [segment[-1]]
        if len(segment) > 1 and segment[-1][:2] == fix[:2] == segment[-2][:2]:
            segment[-1] = fix
        else:
            segment.append(fix)
    if segment:
        yield segment


def _write_segment(segment: list[Fix], line_name: str, out: TextIO) -> None:
    feature = {
        "type": "Feature",
        "geometry": geojson_geometry("LineString", [fix[:2] for fix in segment]),
        "properties": {
            "line": line_name,
            "start_utc": utc_text(segment[0][2]),
            "end_utc": utc_text(segment[-1][2]),
            "first_ping": segment[0][3],
            "last_ping": segment[-1][3],
        },
    }
    json.dump(feature, out)
