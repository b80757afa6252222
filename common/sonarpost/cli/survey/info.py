"""`sonarpost survey info FILE…`: what a recording holds, in constant memory."""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import dataclass, field
from pathlib import Path

from sonarpost.cli.survey.common import add_option_flags, options_of, utc_text
from sonarpost.sonar.geometry import Position, offset_between_m
from sonarpost.sonar.readers import open_survey
from sonarpost.sonar.source import SurveySource
from sonarpost.sonar.survey import Ping, Side

_MOST_VALUES = 16
"""Of the different sample counts and frequencies, so many are listed."""
_STEP_M = 5.0
"""The track is measured in steps of this length: fixes are often coarse and repeated over many pings."""


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action."""
    parser = actions.add_parser("info", help="list what recordings hold, and what was met in them")
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="survey file")
    parser.add_argument("--json", action="store_true", help="one JSON object a file and line")
    add_option_flags(parser)
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Describe every file; return 0.

    Raises:
        SurveyFileError: A file cannot be read.
        ConfigError: The options file is wrong.
    """
    options = options_of(parsed)
    for path in parsed.files:
        with open_survey(path, options) as source:
            facts = describe(source)
        if parsed.json:
            print(json.dumps(facts))
            continue
        print(path)
        notes = facts.pop("warnings")
        assert isinstance(notes, list)
        for name, value in facts.items():
            if name != "file":
                print(f"  {name:20} {_shown(value)}")
        for warning in notes:
            print(f"  note: {warning}")
    return 0


def _shown(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, list):
        return " to ".join(_shown(each) for each in value) if len(value) == 2 else ", ".join(map(_shown, value))
    return f"{value:.7g}" if isinstance(value, float) else str(value)


@dataclass
class _Span:
    low: float = math.inf
    high: float = -math.inf

    def add(self, value: float | None) -> None:
        if value is not None:
            self.low, self.high = min(self.low, value), max(self.high, value)

    def pair(self) -> list[float] | None:
        return [self.low, self.high] if self.low <= self.high else None


@dataclass
class _Facts:
    """What is gathered on the way, the same size however many pings there are."""

    spans: dict[str, _Span] = field(default_factory=dict)
    sample_counts: set[int] = field(default_factory=set)
    sample_types: set[str] = field(default_factory=set)
    frequencies_hz: set[float] = field(default_factory=set)
    fixes: int = 0
    track_m: float = 0.0
    several: int = 0
    """Pings with more than one channel on a side."""
    pictured_hz: set[float] = field(default_factory=set)
    _from: Position | None = None

    def add(self, ping: Ping) -> None:
        self._span("time", ping.time_utc_s)
        for name in ("lat_deg", "lon_deg", "altitude_m", "depth_m", "speed_mps"):
            self._span(name, getattr(ping, name))
        self._add_pictured(ping)
        for channel in ping.channels:
            self._span("slant_range_m", channel.slant_range_m)
            self.sample_types.add(channel.samples.dtype.name)
            if len(self.sample_counts) < _MOST_VALUES:
                self.sample_counts.add(len(channel.samples))
            if channel.frequency_hz is not None and len(self.frequencies_hz) < _MOST_VALUES:
                self.frequencies_hz.add(channel.frequency_hz)
        if ping.lat_deg is not None and ping.lon_deg is not None:
            self._move(Position(ping.lat_deg, ping.lon_deg))

    def _add_pictured(self, ping: Ping) -> None:
        """Note what pictures are made of: the first channel of each side."""
        pictured = [channel for side in Side if (channel := ping.channel(side)) is not None]
        self.several += len(pictured) < len(ping.channels)
        for channel in pictured:
            self._span("pictured_m", channel.slant_range_m)
            if channel.frequency_hz is not None and len(self.pictured_hz) < _MOST_VALUES:
                self.pictured_hz.add(channel.frequency_hz)

    def note(self, total: int) -> list[str]:
        """Return which of several channels a side is looked at, where there are several."""
        reach = self.spans.get("pictured_m", _Span()).pair()
        if not self.several or reach is None:
            return []
        frequencies = "".join(f", {hz / 1000:g} kHz" for hz in sorted(self.pictured_hz))
        ranges = " to ".join(dict.fromkeys(f"{range_m:g}" for range_m in reach))
        met = f"several channels a side in {self.several} of {total} pings"
        return [f"{met}: pictures and contacts are of the first{frequencies}, slant range {ranges} m"]

    def _span(self, name: str, value: float | None) -> None:
        self.spans.setdefault(name, _Span()).add(value)

    def _move(self, place: Position) -> None:
        self.fixes += 1
        if self._from is None:
            self._from = place
            return
        step_m = math.hypot(*offset_between_m(self._from, place))
        if step_m >= _STEP_M:
            self.track_m += step_m
            self._from = place


def describe(source: SurveySource) -> dict[str, object]:
    """Return what a recording holds, as JSON types.

    Raises:
        SurveyFileError: The file can no longer be read.
    """
    facts = _Facts()
    for ping in source.pings():
        facts.add(ping)
    times = facts.spans["time"]
    info = source.info
    ranges = {
        name: facts.spans.get(name, _Span()).pair()
        for name in ("lat_deg", "lon_deg", "altitude_m", "depth_m", "speed_mps", "slant_range_m")
    }
    return {
        "file": str(info.path),
        "sonar": info.sonar_id,
        "line": info.line_name,
        "pings": info.ping_count,
        "sides": [side.value for side in info.sides],
        "samples": sorted(facts.sample_counts),
        "sample_type": sorted(facts.sample_types),
        "frequency_hz": sorted(facts.frequencies_hz),
        "time_utc": [utc_text(times.low), utc_text(times.high)],
        "duration_s": round(times.high - times.low, 3),
        "fixes": facts.fixes,
        "track_m": round(facts.track_m, 1),
        **ranges,
        "warnings": [*info.warnings, *facts.note(info.ping_count)],
    }
