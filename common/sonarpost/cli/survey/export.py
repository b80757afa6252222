"""`sonarpost survey export FILE`: the track as CSV (a line a ping) or GeoJSON, written as it is read."""

from __future__ import annotations

import argparse
import csv
import json
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from sonarpost.cli.survey.common import add_option_flags, options_of, utc_text
from sonarpost.files import sync_folder
from sonarpost.sonar.readers import open_survey
from sonarpost.sonar.source import SurveySource
from sonarpost.sonar.survey import Ping

_GAP_S = 60.0
"""The line of the track is broken where there is no fix for longer."""
_FIELDS = (
    *("lat_deg", "lon_deg", "heading_deg", "altitude_m"),
    *("depth_m", "speed_mps", "pitch_deg", "roll_deg"),
)


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action."""
    parser = actions.add_parser("export", help="write a recording's track as CSV or GeoJSON")
    parser.add_argument("file", type=Path, metavar="FILE", help="survey file")
    parser.add_argument("--format", choices=("csv", "geojson"), default="csv", help="(default: %(default)s)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="where to (default: standard output)")
    add_option_flags(parser)
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Write the track; return 0.

    Raises:
        SurveyFileError: The file cannot be read; nothing is left at `--out` then.
        ConfigError: The options file is wrong.
        OSError: The track cannot be written.
    """
    write = write_csv if parsed.format == "csv" else write_geojson
    with open_survey(parsed.file, options_of(parsed)) as source:
        if parsed.out is None:
            write(source, sys.stdout)
        else:
            with _whole_or_absent(parsed.out) as out:
                write(source, out)
    return 0


@contextmanager
def _whole_or_absent(path: Path) -> Iterator[TextIO]:
    """Give a file to write to that takes `path`'s place once all is written."""
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8", newline="") as file:
            yield file
            file.flush()
            os.fchmod(file.fileno(), 0o644)
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def write_csv(source: SurveySource, out: TextIO) -> None:
    """Write one line a ping; an empty field is not known.

    Raises:
        SurveyFileError: The recording can no longer be read.
    """
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(("number", "time_utc", *_FIELDS, "slant_range_m"))
    for ping in source.pings():
        values = ["" if (value := getattr(ping, name)) is None else f"{value:.10g}" for name in _FIELDS]
        reach_m = ping.reach_m()
        writer.writerow((ping.number, utc_text(ping.time_utc_s), *values, "" if reach_m is None else f"{reach_m:.7g}"))


def write_geojson(source: SurveySource, out: TextIO) -> None:
    """Write a FeatureCollection (RFC 7946) of the track's unbroken pieces.

    A piece ends where there is no fix for a minute and at the antimeridian; one of a single fix is a Point.

    Raises:
        SurveyFileError: The recording can no longer be read.
    """
    out.write('{"type": "FeatureCollection", "features": [')
    between = "\n"
    for piece in _pieces(source.pings()):
        out.write(between)
        _write_piece(piece, source.info.line_name, out)
        between = ",\n"
    out.write("\n]}\n")


Fix = tuple[float, float, float, int]
"""Longitude and latitude in degrees, UTC seconds, ping number."""


def _pieces(pings: Iterator[Ping]) -> Iterator[list[Fix]]:
    """Yield the fixes of each piece, a fix that repeats the one before it left out but for the piece's last."""
    piece: list[Fix] = []
    for ping in pings:
        if ping.lat_deg is None or ping.lon_deg is None:
            continue
        fix = (ping.lon_deg, ping.lat_deg, ping.time_utc_s, ping.number)
        broken = piece and (fix[2] - piece[-1][2] > _GAP_S or abs(fix[0] - piece[-1][0]) > 180)
        if broken or len(piece) >= _MOST_FIXES:
            yield piece
            # A piece that is only cut for its length goes on where it ended.
            piece = [] if broken else [piece[-1]]
        if len(piece) > 1 and piece[-1][:2] == fix[:2] == piece[-2][:2]:
            piece[-1] = fix
        else:
            piece.append(fix)
    if piece:
        yield piece


_MOST_FIXES = 100_000
"""A piece is held in memory, so that it can be described; a longer one is cut."""


def _write_piece(piece: list[Fix], line_name: str, out: TextIO) -> None:
    places = [[round(lon_deg, 8), round(lat_deg, 8)] for lon_deg, lat_deg, _, _ in piece]
    several = len(places) > 1
    feature = {
        "type": "Feature",
        "geometry": {"type": "LineString", "coordinates": places}
        if several
        else {"type": "Point", "coordinates": places[0]},
        "properties": {
            "line": line_name,
            "start_utc": utc_text(piece[0][2]),
            "end_utc": utc_text(piece[-1][2]),
            "first_ping": piece[0][3],
            "last_ping": piece[-1][3],
        },
    }
    json.dump(feature, out)
