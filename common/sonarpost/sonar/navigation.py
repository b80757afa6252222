"""Navigation checks of all formats: limits, jumps, time, mounting of the sonar."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final, TypeAlias

from sonarpost.sonar.geometry import Position, offset_between_m, offset_position
from sonarpost.sonar.options import Mounting
from sonarpost.sonar.survey import Ping

KNOT_MPS: Final = 1852 / 3600
NAVIGATION_LIMITS: Final = {
    "heading_deg": (0.0, 360.0),
    "altitude_m": (0.0, 11_000.0),
    "depth_m": (-100.0, 11_000.0),
    "speed_mps": (0.0, 50.0),
    "pitch_deg": (-90.0, 90.0),
    "roll_deg": (-180.0, 180.0),
}
"""Plausible range of each value."""

_MAX_SPEED_MPS: Final = 30.0
"""Maximum speed of a carrier of a side-scan sonar."""
_MAX_CORRECTION_M: Final = 100.0
"""Maximum correction of the dead reckoning at once, when a vehicle surfaces."""
_MAX_GAP_S: Final = 600.0
"""Longest time between fixes that counts: a longer one may be a damaged time."""
_NEW_PLACE_PINGS: Final = 5
"""Number of consecutive fixes that agree with each other and are then accepted at any distance."""

_Place: TypeAlias = Position | tuple[float, float]
"""A position, or easting and northing in metres."""


def is_plausible(name: str, value: float) -> bool:
    """Return whether a navigation value is finite and within `NAVIGATION_LIMITS`."""
    low, high = NAVIGATION_LIMITS[name]
    return math.isfinite(value) and low <= value <= high


def position_in_degrees(lat_deg: float, lon_deg: float) -> Position | None:
    """Return a position as stored in a file, with a longitude of -180 to 360; None if it is 0/0 or out of range."""
    valid = abs(lat_deg) <= 90 and -180 <= lon_deg <= 360 and (lat_deg, lon_deg) != (0.0, 0.0)  # excludes NaN
    return Position(lat_deg, lon_deg - 360 if lon_deg > 180 else lon_deg) if valid else None


class PositionJumpFilter:
    """Removes fixes that no carrier can have reached.

    A fix is doubtful if it is farther from the last accepted one than 100 m plus 30 m/s. After five consecutive
    doubtful fixes that agree with each other, the fifth and later ones are accepted: the recording was interrupted. A
    wrong fix at the beginning is not detected.
    """

    def __init__(self) -> None:
        self._accepted: tuple[float, _Place] | None = None
        self._doubtful: tuple[float, _Place] | None = None
        self._agreeing = 0

    def filter(self, ping: Ping) -> Ping:
        """Return the ping, without its position if that is doubtful. Call it once for each ping, in order."""
        place = _place(ping)
        if place is None:
            return ping
        fix = (ping.time_utc_s, place)
        if self._accepted is None or _reachable(self._accepted, fix):
            self._accepted, self._doubtful, self._agreeing = fix, None, 0
            return ping
        agrees = self._doubtful is not None and _reachable(self._doubtful, fix)
        self._agreeing = self._agreeing + 1 if agrees else 1
        self._doubtful = fix
        if self._agreeing >= _NEW_PLACE_PINGS:
            self._accepted, self._doubtful, self._agreeing = fix, None, 0
            return ping
        return replace(ping, lat_deg=None, lon_deg=None, grid_m=None)


def _place(ping: Ping) -> _Place | None:
    """Return the recorded place of a ping: coordinates in metres, else its position."""
    if ping.grid_m is not None:
        return ping.grid_m
    return None if ping.lat_deg is None or ping.lon_deg is None else Position(ping.lat_deg, ping.lon_deg)


def _reachable(start: tuple[float, _Place], end: tuple[float, _Place]) -> bool:
    limit_m = _MAX_CORRECTION_M + _MAX_SPEED_MPS * min(max(end[0] - start[0], 0.0), _MAX_GAP_S)
    if isinstance(start[1], tuple) or isinstance(end[1], tuple):
        # A file has one kind of coordinates: two kinds are not comparable.
        return isinstance(start[1], tuple) and isinstance(end[1], tuple) and math.dist(start[1], end[1]) <= limit_m
    if abs(start[1].lat_deg - end[1].lat_deg) * 110_000 > limit_m:
        return False
    return math.hypot(*offset_between_m(start[1], end[1])) <= limit_m


def apply_mounting(ping: Ping, mounting: Mounting) -> Ping:
    """Return the ping with position and heading of the sonar in place of the recorded ones.

    If the sonar is offset and the heading is unknown, the position is removed.
    """
    heading_deg = ping.heading_deg
    if heading_deg is not None and mounting.heading_offset_deg:
        heading_deg = (heading_deg + mounting.heading_offset_deg) % 360
        ping = replace(ping, heading_deg=heading_deg)
    if not mounting.is_offset or ping.lat_deg is None or ping.lon_deg is None:
        return ping
    if heading_deg is None:
        return replace(ping, lat_deg=None, lon_deg=None)
    distance_m = math.hypot(mounting.ahead_m, mounting.starboard_m)
    bearing_deg = heading_deg + math.degrees(math.atan2(mounting.starboard_m, mounting.ahead_m))
    position = offset_position(Position(ping.lat_deg, ping.lon_deg), bearing_deg, distance_m)
    return replace(ping, lat_deg=position.lat_deg, lon_deg=position.lon_deg)


@dataclass
class PingCounter:
    """Number of pings with an irregularity, and the row of the first."""

    count: int = 0
    first: int = -1

    def add(self, row: int) -> None:
        """Count a ping."""
        if not self.count:
            self.first = row
        self.count += 1

    def summary(self, total: int) -> str:
        """Return the count as text for a warning."""
        return f"{self.count} of {total} pings, the first in row {self.first}"


@dataclass
class NavigationChecks:
    """Counts irregularities of the navigation, in constant memory."""

    mounting: Mounting
    _filter: PositionJumpFilter = field(default_factory=PositionJumpFilter)
    _time_reversals: PingCounter = field(default_factory=PingCounter)
    _jumps: PingCounter = field(default_factory=PingCounter)
    _without_heading: PingCounter = field(default_factory=PingCounter)
    _last_s: float = -math.inf

    def observe(self, row: int, ping: Ping) -> None:
        """Check one ping as stored in the file."""
        if ping.time_utc_s < self._last_s:
            self._time_reversals.add(row)
        self._last_s = ping.time_utc_s
        checked = self._filter.filter(ping)
        if ping.lat_deg is not None and checked.lat_deg is None:
            self._jumps.add(row)
        if self.mounting.is_offset and checked.lat_deg is not None and checked.heading_deg is None:
            self._without_heading.add(row)

    def warnings(self, total: int) -> list[str]:
        """Return one line for each kind of irregularity."""
        texts = (
            (self._time_reversals, "time goes back in"),
            (self._jumps, "position left out, too far from the one before, in"),
            (self._without_heading, "position left out, no heading to apply the mounting with, in"),
        )
        return [f"{text} {counter.summary(total)}" for counter, text in texts if counter.count]
