"""Heading of the sonar from the sources that a recording has, course over ground from its track, recorded layback.

The sources are, best first: the sensor's own heading, the heading of the ship or vehicle (its gyro), and the course
over ground, as recorded or from the positions. A current makes course and heading differ, so that each has its own
standard deviation. A towed body follows the track of the ship, so that a recorded layback is applied along the course.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Final

from sonarpost.sonar.geometry import Position, offset_between_m, offset_position
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.survey import Ping

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
