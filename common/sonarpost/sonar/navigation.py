"""Navigation of all formats: limits, jumps, time, mounting of the sonar, its heading, recorded layback.

Sources of the heading are, best first: the sensor's own heading, the heading of the ship or vehicle (its gyro), and the
course over ground, as recorded or from the positions. A current makes course and heading differ, so that each has its
own standard deviation. A towed body follows the track of the ship, so that a recorded layback is applied along the
course.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Final, TypeAlias

from sonarpost.sonar.geometry import Position, offset_between_m, offset_position
from sonarpost.sonar.options import Mounting, SurveyOptions
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

_COURSE_S: Final = 8.0
"""Time before and after a ping whose positions give its course: some ten lengths of a small vehicle."""
_COURSE_PINGS: Final = 256
"""Maximum number of pings before, and after, for the course."""
_COURSE_FIXES: Final = 16
"""About the number of positions that the course is calculated from."""
_MIN_TRACK_M: Final = 3.0
"""Shorter tracks have no course: positions are often rounded to a metre."""
_MIN_COURSE_MPS: Final = 0.3
_NAMES: Final = {"sensor": "the sensor", "gyro": "the ship's gyro", "course": "the course over ground"}

_Place: TypeAlias = Position | tuple[float, float]
"""A position, or easting and northing in metres."""


def is_plausible(name: str, value: float) -> bool:
    """Return whether a navigation value is finite and within `NAVIGATION_LIMITS`."""
    low, high = NAVIGATION_LIMITS[name]
    return math.isfinite(value) and low <= value <= high


def plausible(name: str, value: float) -> float | None:
    """Return a recorded value; None if it is not finite or outside `NAVIGATION_LIMITS`."""
    return value if is_plausible(name, value) else None


def plausible_angle(angle_deg: float) -> float | None:
    """Return a recorded heading or course, from 0 to below 360 degrees; None if it is implausible."""
    return angle_deg % 360 if is_plausible("heading_deg", angle_deg) else None


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


def out_of_range(name: str) -> str:
    """Return the note about an implausible value."""
    return f"{name} out of range"


class PingNotes:
    """Irregularities of pings: of each the number of pings and the row of the first, by its text."""

    def __init__(self) -> None:
        self._counts: dict[str, tuple[int, int]] = {}

    def add(self, text: str, row: int) -> None:
        """Count a ping."""
        count, first = self._counts.get(text, (0, row))
        self._counts[text] = (count + 1, first)

    def lines(self, total: int, texts: Iterable[str]) -> list[str]:
        """Return a warning for each of these irregularities that one of `total` pings has."""
        found = ((text, *self._counts[text]) for text in texts if text in self._counts)
        return [f"{text} in {count} of {total} pings, the first in row {first}" for text, count, first in found]


class NavigationChecks:
    """Counts irregularities of the navigation, in constant memory."""

    _TIME = "time goes back"
    _JUMP = "position left out, too far from the one before,"
    _NO_HEADING = "position left out, no heading to apply the mounting with,"

    def __init__(self, mounting: Mounting) -> None:
        self._mounting = mounting
        self._filter = PositionJumpFilter()
        self._notes = PingNotes()
        self._last_s = -math.inf

    def observe(self, row: int, ping: Ping) -> None:
        """Check one ping as stored in the file."""
        if ping.time_utc_s < self._last_s:
            self._notes.add(self._TIME, row)
        self._last_s = ping.time_utc_s
        checked = self._filter.filter(ping)
        if ping.lat_deg is not None and checked.lat_deg is None:
            self._notes.add(self._JUMP, row)
        if self._mounting.is_offset and checked.lat_deg is not None and checked.heading_deg is None:
            self._notes.add(self._NO_HEADING, row)

    def warnings(self, total: int) -> list[str]:
        """Return one line for each kind of irregularity."""
        return self._notes.lines(total, (self._TIME, self._JUMP, self._NO_HEADING))


class HeadingChoice:
    """Selects the heading of all pings of a recording, and applies a recorded layback."""

    def __init__(self, options: SurveyOptions) -> None:
        self._options = options
        self._counts: Counter[str] = Counter()
        self._layback_m = 0.0

    def observe(self, ping: Ping) -> None:
        """Count the sources of a ping in the first pass."""
        self._counts["sensor"] += ping.heading_deg is not None
        self._counts["gyro"] += ping.gyro_deg is not None
        self._counts["recorded course"] += ping.course_deg is not None
        self._counts["position"] += ping.lat_deg is not None
        self._layback_m = max(self._layback_m, ping.layback_m or 0.0)

    @property
    def source(self) -> str:
        """The source in use: `sensor`, `gyro` or `course`."""
        if self._options.heading_source != "auto":
            return self._options.heading_source
        available = (name for name in ("sensor", "gyro") if self._counts[name])
        return next(available, "course" if self._counts["recorded course"] or self._counts["position"] else "sensor")

    def warnings(self) -> list[str]:
        """Return notes on a heading that is not the sensor's, and on an applied layback."""
        lines = []
        if self.source != "sensor":
            sigma_deg = self._sigma_deg(self.source)
            reason = "" if self._options.heading_source != "auto" else ": the file has no heading of the sensor"
            detail = ", from the positions" if self.source == "course" and not self._counts["recorded course"] else ""
            lines.append(
                f"heading is that of {_NAMES[self.source]}{detail}, with a standard deviation of {sigma_deg:g} degrees"
                f"{reason} (option heading_source)"
            )
        if self._layback_m:
            lines.append(f"recorded layback of up to {self._layback_m:.4g} m is applied along the track")
        return lines

    def apply(self, pings: Iterable[Ping]) -> Iterator[Ping]:
        """Yield the pings with the selected heading, and with positions behind the ship by the recorded layback."""
        source = self.source
        if source == "sensor" and not self._layback_m:
            yield from pings
            return
        for ping, track_deg in _with_course(pings):
            course_deg = track_deg if ping.course_deg is None or _is_stationary(ping) else ping.course_deg
            heading_deg = ping.gyro_deg if source == "gyro" else course_deg
            headed = ping
            if source != "sensor":
                headed = replace(ping, heading_deg=heading_deg, heading_sigma_deg=self._sigma_deg(source))
            yield _behind(headed, course_deg if track_deg is None else track_deg) if ping.layback_m else headed

    def _sigma_deg(self, source: str) -> float:
        errors = self._options.errors
        return errors.gyro_heading_deg if source == "gyro" else errors.course_heading_deg


def _is_stationary(ping: Ping) -> bool:
    """Return whether a recorded course is that of a vehicle which hardly moves: noise of its receiver."""
    return ping.speed_mps is not None and ping.speed_mps < _MIN_COURSE_MPS


def _behind(ping: Ping, course_deg: float | None) -> Ping:
    """Return the ping with its position moved back along the course by its layback; without one if no course."""
    if ping.lat_deg is None or ping.lon_deg is None or ping.layback_m is None:
        return ping
    if course_deg is None:
        return replace(ping, lat_deg=None, lon_deg=None)
    position = offset_position(Position(ping.lat_deg, ping.lon_deg), course_deg + 180, ping.layback_m)
    return replace(ping, lat_deg=position.lat_deg, lon_deg=position.lon_deg)


def _with_course(pings: Iterable[Ping]) -> Iterator[tuple[Ping, float | None]]:
    """Yield each ping with the course of the track around it; the last one where the track is too short."""
    before: deque[Ping] = deque(maxlen=_COURSE_PINGS)
    after: deque[Ping] = deque()
    last_deg: float | None = None

    def first() -> tuple[Ping, float | None]:
        nonlocal last_deg
        ping = after.popleft()
        near = [each for each in (*before, ping, *after) if abs(each.time_utc_s - ping.time_utc_s) <= _COURSE_S]
        course_deg = _course_deg(near[:: max(1, len(near) // _COURSE_FIXES)])
        last_deg = last_deg if course_deg is None else course_deg
        before.append(ping)
        return ping, last_deg

    for ping in pings:
        after.append(ping)
        while len(after) > _COURSE_PINGS or after[-1].time_utc_s - after[0].time_utc_s > _COURSE_S:
            yield first()
    while after:
        yield first()


def _course_deg(pings: list[Ping]) -> float | None:
    """Return the bearing of the straight track, by least squares over time, through the positions of the pings."""
    fixes = [
        (ping.time_utc_s, Position(ping.lat_deg, ping.lon_deg))
        for ping in pings
        if ping.lat_deg is not None and ping.lon_deg is not None
    ]
    if len(fixes) < 2:
        return None
    first_s, origin = fixes[0]
    offsets = [offset_between_m(origin, position) for _, position in fixes]
    times_s = [time_s - first_s for time_s, _ in fixes]
    mean_s = math.fsum(times_s) / len(times_s)
    weights = [time_s - mean_s for time_s in times_s]
    north, east = (math.fsum(w * each[axis] for w, each in zip(weights, offsets, strict=True)) for axis in (0, 1))
    spread = math.fsum(w * w for w in weights)
    span_s = max(times_s) - min(times_s)
    if spread <= 0 or math.hypot(north, east) / spread * span_s < _MIN_TRACK_M:
        return None
    return math.degrees(math.atan2(east, north)) % 360
