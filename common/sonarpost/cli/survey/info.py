"""`sonarpost survey info FILE…`: contents of recordings, read in constant memory."""

import argparse
import json
import math
from dataclasses import dataclass, field
from pathlib import Path

from typing_extensions import override

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import add_survey_options, flag, option, survey_options_of, utc_text
from sonarpost.sonar.geometry import Position, offset_between_m
from sonarpost.sonar.projection import GridExtent, Projection
from sonarpost.sonar.readers import open_survey
from sonarpost.sonar.source import SurveySource
from sonarpost.sonar.survey import Ping

_MAX_VALUES = 16
"""Maximum number of sample counts and frequencies in the list."""
_NAVIGATION = ("lat_deg", "lon_deg", "heading_deg", "altitude_m", "depth_m", "speed_mps")
_GRID = ("easting_m", "northing_m", "first_m", "last_m")
"""Coordinates that only files with projected positions have."""
_STEP_M = 5.0
"""Step of the track length: fixes are often coarse and repeated over many pings."""


def add_actions(parser: CommandParser) -> None:
    """Add the action."""
    parser = parser.add_action("info", "list contents and irregularities of recordings", run, "line.xtf --json")
    option(parser, "files FILE", "survey file", Path, nargs="+")
    flag(parser, "--json", "print one JSON object for each file, one per line")
    add_survey_options(parser)


def run(parsed: argparse.Namespace) -> int:
    """Describe every file; return 0."""
    options = survey_options_of(parsed)
    for path in parsed.files:
        with ProgressDisplay(step=f"reading {path}"), open_survey(path, options) as source:
            contents = describe(source)
        if parsed.json:
            print(json.dumps(contents))
            continue
        print(path)
        notes = [(kind, contents.pop(f"{kind}s")) for kind in ("warning", "hint")]
        sets = source.info.channel_sets
        contents["channel_sets"] = "; ".join(f"{each} in {each.ping_count} pings" for each in sets)
        for name, value in contents.items():
            if name != "file" and not (name in _GRID and value is None):
                print(f"  {name:20} {_text(value)}")
        for kind, lines in notes:
            assert isinstance(lines, list)
            for line in lines:
                print(f"  {'note' if kind == 'warning' else kind}: {line}")
    return 0


def _text(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, list):
        return " to ".join(_text(each) for each in value) if len(value) == 2 else ", ".join(map(_text, value))
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(each)}" for name, each in value.items())
    if isinstance(value, float):
        return f"{round(value, 1):.10g}" if abs(value) >= 10_000 else f"{value:.7g}"
    return str(value)


@dataclass
class _Range:
    low: float = math.inf
    high: float = -math.inf
    count: int = 0

    def add(self, value: float | None) -> None:
        if value is not None:
            self.count += 1
            self.low, self.high = min(self.low, value), max(self.high, value)

    def pair(self) -> list[float] | None:
        return [self.low, self.high] if self.low <= self.high else None


@dataclass
class _LongitudeRange(_Range):
    """Range from west to east; across the 180th meridian, as 179.99 to -179.99, if that is shorter."""

    least_east: float = 180.0
    greatest_west: float = -180.0

    @override
    def add(self, value: float | None) -> None:
        super().add(value)
        if value is not None:
            self.least_east = min(self.least_east, value if value >= 0 else 180.0)
            self.greatest_west = max(self.greatest_west, value if value < 0 else -180.0)

    @override
    def pair(self) -> list[float] | None:
        is_across = self.greatest_west - self.least_east + 360 < self.high - self.low
        return [self.least_east, self.greatest_west] if is_across else super().pair()


@dataclass
class _Statistics:
    """Statistics over the pings of a recording, of constant size."""

    ranges: dict[str, _Range] = field(default_factory=dict)
    sample_counts: set[int] = field(default_factory=set)
    sample_types: set[str] = field(default_factory=set)
    frequencies_hz: set[float] = field(default_factory=set)
    fixes: int = 0
    track_m: float = 0.0
    _last_position: Position | None = None

    def add(self, ping: Ping) -> None:
        self._extend("time", ping.time_utc_s)
        for name in _NAVIGATION:
            self._extend(name, getattr(ping, name))
        for channel in ping.channels:
            self._extend("slant_range_m", channel.slant_range_m)
            self.sample_types.add(channel.samples.dtype.name)
            if len(self.sample_counts) < _MAX_VALUES:
                self.sample_counts.add(len(channel.samples))
            if channel.frequency_hz is not None and len(self.frequencies_hz) < _MAX_VALUES:
                self.frequencies_hz.add(channel.frequency_hz)
        if ping.lat_deg is not None and ping.lon_deg is not None:
            self._add_fix(Position(ping.lat_deg, ping.lon_deg))

    def hints(self, total: int) -> list[str]:
        """Return what is missing in the navigation, and its effect."""
        effects = {
            "heading_deg": "contacts without a heading have no position",
            "altitude_m": "it is taken from the first bottom return",
        }
        hints = [
            f"{name} {f'only in {count} of' if count else 'in none of'} {total} pings: {effect}"
            for name, effect in effects.items()
            if (count := self.ranges[name].count) < total / 2
        ]
        if not self.fixes:
            hints.append("no positions: contacts have no position")
        elif self.fixes > 1 and all(self.ranges[name].low == self.ranges[name].high for name in ("lat_deg", "lon_deg")):
            hints.append("the position is the same in every ping")
        return hints

    def _extend(self, name: str, value: float | None) -> None:
        self.ranges.setdefault(name, _LongitudeRange() if name == "lon_deg" else _Range()).add(value)

    def _add_fix(self, position: Position) -> None:
        self.fixes += 1
        if self._last_position is None:
            self._last_position = position
            return
        step_m = math.hypot(*offset_between_m(self._last_position, position))
        if step_m >= _STEP_M:
            self.track_m += step_m
            self._last_position = position


def describe(source: SurveySource) -> dict[str, object]:
    """Return the contents of a recording as JSON types.

    Raises:
        SurveyFileError: The file cannot be read.
    """
    statistics = _Statistics()
    for ping in source.pings():
        statistics.add(ping)
    times = statistics.ranges["time"]
    info = source.info
    ranges = {name: statistics.ranges.get(name, _Range()).pair() for name in (*_NAVIGATION, "slant_range_m")}
    return {
        "file": str(info.path),
        "sonar": info.sonar_id,
        "line": info.line_name,
        "pings": info.ping_count,
        "sides": [side.value for side in info.sides],
        "samples": sorted(statistics.sample_counts),
        "sample_type": sorted(statistics.sample_types),
        "frequency_hz": sorted(statistics.frequencies_hz),
        "time_utc": [utc_text(times.low), utc_text(times.high)],
        "duration_s": round(times.high - times.low, 3),
        "fixes": statistics.fixes,
        "track_m": round(statistics.track_m, 1),
        **_stored_coordinates(info.grid),
        **ranges,
        "channel_sets": [
            {"frequency_hz": each.frequency_hz, "range_m": each.range_m, "pings": each.ping_count}
            for each in info.channel_sets
        ],
        "warnings": list(info.warnings),
        "hints": [*projection_hints(source, statistics.fixes), *statistics.hints(info.ping_count)],
    }


def _stored_coordinates(grid: GridExtent | None) -> dict[str, object]:
    """Return the projected coordinates of a file, in metres."""
    if grid is None:
        return dict.fromkeys(_GRID)
    axes = ("easting", "northing")
    ranges = {f"{axis}_m": [grid.min_m[n], grid.max_m[n]] for n, axis in enumerate(axes)}
    return ranges | {
        "first_m": dict(zip(axes, grid.first_m, strict=True)),
        "last_m": dict(zip(axes, grid.last_m, strict=True)),
    }


def projection_hints(source: SurveySource, fixes: int) -> list[str]:
    """Return which projection a file with projected positions can have, if it has no positions in degrees."""
    grid, crs = source.info.grid, source.options.projected_crs
    if grid is None or fixes:
        return []
    (west_m, south_m), (east_m, north_m) = grid.min_m, grid.max_m
    if crs is not None:
        return [f"{crs} has no position for these eastings and northings: it is not the projection of this file"]
    if max(abs(west_m), abs(east_m)) <= 180 and max(abs(south_m), abs(north_m)) <= 90:
        return ["the positions look like degrees, but NavUnits (byte 164 of the file) is 0 for metres: write 3 there"]
    settings = "(see the recorder's settings; it may be in feet)"
    name = f"positions are projected, shown as if in metres: name their projection with --crs EPSG:N {settings}"
    utm = [
        f"EPSG:{code}ZZ at latitude {abs(position.lat_deg):.1f} {letter}"
        for code, letter in (("326", "N"), ("327", "S"))
        if 100_000 <= west_m <= east_m <= 900_000
        and 0 < south_m <= north_m < 10_000_000
        # The latitude is nearly the same in every zone.
        and (position := Projection(f"EPSG:{code}31").position(500_000, grid.first_m[1])) is not None
    ]
    if not utm:
        return [f"{name}; they are not UTM coordinates"]
    zone = "zone ZZ = (longitude + 180) / 6, rounded up: 16 at 87 W"
    return [f"{name}; if it is UTM, {' or '.join(utm)}; {zone}"]
