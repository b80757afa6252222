"""Checks on navigation that hold for every format: jumps, time that goes back, the sonar's place on its carrier.

## sonarpost.sonar.navigation
Positions in projected metres, turned into WGS-84 degrees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from pyproj import Transformer
from pyproj.exceptions import ProjError

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.geometry import Position, offset_between_m, offset_position
from sonarpost.sonar.options import Mounting
from sonarpost.sonar.survey import Ping

_TOP_SPEED_MPS: Final = 30.0
"""No carrier of a side-scan sonar is faster."""
_JUMP_SLACK_M: Final = 100.0
"""A vehicle that surfaces corrects its dead reckoning by this much at once, and more is doubtful."""
_NEW_PLACE_PINGS: Final = 5
"""So many fixes in a row that agree with each other are believed, however far from the last ones."""


class PositionJumpFilter:
    """Takes away fixes that no carrier can have reached, one ping after the other.

    A fix is doubted when it lies farther from the last good one than 30 m/s and 100 m allow. Five doubted fixes in a
    row that agree with each other are a new place (a recording that was interrupted), and are believed from the
    fifth on. A wrong fix at the very beginning cannot be told from a right one.
    """

    def __init__(self) -> None:
        self._good: tuple[float, Position] | None = None
        self._doubted: tuple[float, Position] | None = None
        self._agreeing = 0

    def checked(self, ping: Ping) -> Ping:
        """Return the ping, without its position where that cannot be."""
        if ping.lat_deg is None or ping.lon_deg is None:
            return ping
        fix = (ping.time_utc_s, Position(ping.lat_deg, ping.lon_deg))
        if self._good is None or _reachable(self._good, fix):
            self._good, self._doubted, self._agreeing = fix, None, 0
            return ping
        agrees = self._doubted is not None and _reachable(self._doubted, fix)
        self._agreeing = self._agreeing + 1 if agrees else 1
        self._doubted = fix
        if self._agreeing >= _NEW_PLACE_PINGS:
            self._good, self._doubted, self._agreeing = fix, None, 0
            return ping
        return replace(ping, lat_deg=None, lon_deg=None)


def _reachable(start: tuple[float, Position], end: tuple[float, Position]) -> bool:
    reach_m = _JUMP_SLACK_M + _TOP_SPEED_MPS * max(end[0] - start[0], 0.0)
    if abs(start[1].lat_deg - end[1].lat_deg) * 110_000 > reach_m:
        return False
    return math.hypot(*offset_between_m(start[1], end[1])) <= reach_m


def mounted(ping: Ping, mounting: Mounting) -> Ping:
    """Return the ping with the sonar's own position and heading.

    Where the mounting moves the position and the heading is not known, the position is taken away: it would be
    another place's.
    """
    heading_deg = ping.heading_deg
    if heading_deg is not None and mounting.heading_offset_deg:
        heading_deg = (heading_deg + mounting.heading_offset_deg) % 360
        ping = replace(ping, heading_deg=heading_deg)
    if not mounting.moves or ping.lat_deg is None or ping.lon_deg is None:
        return ping
    if heading_deg is None:
        return replace(ping, lat_deg=None, lon_deg=None)
    distance_m = math.hypot(mounting.ahead_m, mounting.starboard_m)
    bearing_deg = heading_deg + math.degrees(math.atan2(mounting.starboard_m, mounting.ahead_m))
    place = offset_position(Position(ping.lat_deg, ping.lon_deg), bearing_deg, distance_m)
    return replace(ping, lat_deg=place.lat_deg, lon_deg=place.lon_deg)


@dataclass
class NavigationRows:
    """How often something was met, and where first."""

    count: int = 0
    first: int = -1

    def add(self, row: int) -> None:
        """Count one more."""
        if not self.count:
            self.first = row
        self.count += 1

    def of(self, total: int) -> str:
        """Return it in words."""
        return f"{self.count} of {total} pings, the first in row {self.first}"


@dataclass
class NavigationStatistics:
    """Collects, in constant memory, what a user of the survey should know of its navigation."""

    mounting: Mounting
    _gate: PositionJumpFilter = field(default_factory=PositionJumpFilter)
    _back: NavigationRows = field(default_factory=NavigationRows)
    _jumps: NavigationRows = field(default_factory=NavigationRows)
    _unmounted: NavigationRows = field(default_factory=NavigationRows)
    _last_s: float = -math.inf

    def observe(self, row: int, ping: Ping) -> None:
        """Take note of one ping, as the file has it."""
        if ping.time_utc_s < self._last_s:
            self._back.add(row)
        self._last_s = ping.time_utc_s
        checked = self._gate.checked(ping)
        if ping.lat_deg is not None and checked.lat_deg is None:
            self._jumps.add(row)
        if self.mounting.moves and checked.lat_deg is not None and checked.heading_deg is None:
            self._unmounted.add(row)

    def warnings(self, total: int) -> list[str]:
        """Return what was met, one line each."""
        texts = (
            (self._back, "time goes back in"),
            (self._jumps, "position left out, too far from the one before, in"),
            (self._unmounted, "position left out, no heading to apply the mounting with, in"),
        )
        return [f"{text} {rows.of(total)}" for rows, text in texts if rows.count]


_WGS84 = "EPSG:4326"


class Projection:
    """A projected coordinate system, from metres to degrees.

    Args:
        crs: As pyproj takes it: `EPSG:32619`, a PROJ string, WKT.
        path: The file whose positions are in it, for messages.

    Raises:
        SurveyFileError: Not a coordinate system, or not a projected one.
    """

    def __init__(self, crs: str, path: Path) -> None:
        try:
            self._transformer = Transformer.from_crs(crs, _WGS84, always_xy=True)
            source = self._transformer.source_crs
        except ProjError as error:
            raise SurveyFileError(str(path), "projected_crs", crs, "a coordinate system pyproj knows") from error
        if source is None or not source.is_projected:
            raise SurveyFileError(str(path), "projected_crs", crs, "a projected coordinate system")
        if any(axis.unit_conversion_factor != 1 for axis in source.axis_info):
            raise SurveyFileError(str(path), "projected_crs", crs, "a coordinate system in metres")

    def position(self, easting_m: float, northing_m: float) -> Position | None:
        """Return the position, or None where there is none (not finite, 0/0, outside the projection)."""
        if not (math.isfinite(easting_m) and math.isfinite(northing_m)) or (easting_m, northing_m) == (0.0, 0.0):
            return None
        try:
            lon_deg, lat_deg = self._transformer.transform(easting_m, northing_m, errcheck=True)
        except ProjError:
            return None  # outside the projection: no position, counted by the reader as one without a fix
        if not (math.isfinite(lon_deg) and math.isfinite(lat_deg) and abs(lat_deg) <= 90):
            return None
        return Position(float(lat_deg), (float(lon_deg) + 180) % 360 - 180)
