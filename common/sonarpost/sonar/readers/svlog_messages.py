"""Navigation messages of SVLOG recordings: NMEA sentences, and MAVLink messages as JSON.

Read are GLOBAL_POSITION_INT, ATTITUDE and SYSTEM_TIME of MAVLink, and the NMEA sentences GGA, GLL, RMC, VTG, HDT, THS
and ZDA of any talker. Several sentences may be in one packet. The checksum of a sentence is optional.
"""

from __future__ import annotations

import json
import math
import re
from datetime import UTC, datetime
from typing import Final, NamedTuple

from sonarpost.sonar.navigation import KNOT_MPS, plausible, plausible_angle, position_in_degrees
from sonarpost.sonar.readers.records import Notes

_UNKNOWN_HEADING: Final = 65_535
_MIN_COURSE_MPS: Final = 0.2
"""A slower vehicle drifts, and the course of its fixes is one of their errors."""
_FIRST_UTC_S: Final = 946_684_800.0
"""2000-01-01: an earlier time is that of a receiver without a date."""
_MAX_STEP_S: Final = 60.0
"""Greatest time between two messages of one clock; a greater one is that of two clocks."""


class Received(NamedTuple):
    """What the messages before a profile contain.

    Attributes:
        values: Value of each field of a ping, with the number of profiles before its message.
        utc_s: UTC of a message since the profile before; None if none.
        elapsed_s: Time since the start of the session, by the clock of the autopilot; 0 without its messages.
    """

    values: dict[str, tuple[int, float]]
    utc_s: float | None
    elapsed_s: float


class NavigationMessages:
    """Collects the values of the navigation messages."""

    def __init__(self, notes: Notes) -> None:
        self._notes = notes
        self._profiles = 0
        self._values: dict[str, tuple[int, float]] = {}
        self._utc_s: float | None = None
        self.start_session()

    def start_session(self) -> None:
        """Count the elapsed time from here."""
        self._boot_s, self._elapsed_s = math.nan, 0.0

    def before_profile(self) -> Received:
        """Return what the messages before the next profile contain, and count the profile."""
        received = Received(self._values, self._utc_s, self._elapsed_s)
        self._profiles += 1
        self._utc_s = None
        return received

    def mavlink(self, payload: bytes) -> None:
        """Take the values of a MAVLink message; messages of other types are ignored."""
        message = json_object(payload).get("message")
        if not isinstance(message, dict):
            self._notes.add("ignored MAVLink packet: not JSON with a message")
            return
        fields = {name: found for name, value in message.items() if (found := number(value)) is not None}
        match message.get("type"):
            case "GLOBAL_POSITION_INT":
                self._global_position(fields)
            case "ATTITUDE":
                names = ("yaw", "pitch", "roll")
                yaw_deg, pitch_deg, roll_deg = (math.degrees(fields.get(name, math.nan)) for name in names)
                self._set_heading(yaw_deg + 360 * (yaw_deg < 0))
                self._set(pitch_deg=plausible("pitch_deg", pitch_deg), roll_deg=plausible("roll_deg", roll_deg))
            case "SYSTEM_TIME":
                self._set_utc(fields.get("time_unix_usec", 0.0) / 1e6)

    def nmea(self, payload: bytes) -> None:
        """Take the values of NMEA sentences; sentences of other types, or with a wrong checksum, are ignored."""
        for line in re.split(rb"[\r\n$]+", payload):
            body, star, checksum = line.strip(b" \t\0").partition(b"*")
            total = 0
            for byte in body:
                total ^= byte
            if star and checksum.upper() != f"{total:02X}".encode():
                self._notes.add("ignored NMEA sentence: checksum")
            elif self._sentence(body.decode("latin-1").split(",")) and not star:
                self._notes.add("accepted NMEA sentence without checksum")

    def _set(self, **values: float | None) -> None:
        kept = {name: value for name, value in self._values.items() if name not in values}
        new = {name: (self._profiles, value) for name, value in values.items() if value is not None}
        self._values = kept | new

    def _set_heading(self, heading_deg: float) -> None:
        """Take a heading; an implausible one leaves that of an earlier message."""
        if (plausible_deg := plausible_angle(heading_deg)) is not None:
            self._set(heading_deg=plausible_deg)

    def _set_position(self, lat_deg: float, lon_deg: float) -> None:
        position = position_in_degrees(lat_deg, lon_deg)
        lat_lon_deg = (position.lat_deg, position.lon_deg) if position else (None, None)
        self._set(lat_deg=lat_lon_deg[0], lon_deg=lat_lon_deg[1])

    def _set_motion(self, speed_mps: float, course_deg: float) -> None:
        course = plausible_angle(course_deg) if speed_mps >= _MIN_COURSE_MPS else None
        self._set(speed_mps=plausible("speed_mps", speed_mps), course_deg=course)

    def _set_utc(self, utc_s: float) -> None:
        self._utc_s = utc_s if utc_s >= _FIRST_UTC_S else self._utc_s

    def _global_position(self, fields: dict[str, float]) -> None:
        lat, lon, north, east, hdg, boot_ms = (
            fields.get(name, math.nan) for name in ("lat", "lon", "vx", "vy", "hdg", "time_boot_ms")
        )
        self._set_position(lat * 1e-7, lon * 1e-7)
        self._set_motion(math.hypot(north, east) / 100, math.degrees(math.atan2(east, north)) % 360)
        self._set_heading(math.nan if hdg == _UNKNOWN_HEADING else hdg / 100)
        step_s = boot_ms / 1000 - self._boot_s
        self._elapsed_s += step_s if 0 < step_s <= _MAX_STEP_S else 0.0
        self._boot_s = boot_ms / 1000

    def _sentence(self, fields: list[str]) -> bool:
        """Take the values of a sentence, and return whether it has any."""
        match fields[0][2:], fields:
            case "GGA", [_, _, lat, north, lon, east, quality, *_] if quality not in ("", "0"):
                self._set_position(*_nmea_position(lat, north, lon, east))
            case "GLL", [_, lat, north, lon, east, _, "A", *_]:
                self._set_position(*_nmea_position(lat, north, lon, east))
            case "RMC", [_, clock, "A", lat, north, lon, east, knots, course, date, *_]:
                self._set_position(*_nmea_position(lat, north, lon, east))
                self._set_motion(_float(knots) * KNOT_MPS, _float(course))
                self._set_utc(_nmea_utc_s(clock, date, "%d%m%y"))
            case "VTG", [_, course, "T", _, _, knots, "N", *_]:
                self._set_motion(_float(knots) * KNOT_MPS, _float(course))
            case ("HDT", [_, heading, "T", *_]) | ("THS", [_, heading, "A" | "E", *_]):
                self._set_heading(_float(heading))
            case "ZDA", [_, clock, day, month, year, *_]:
                self._set_utc(_nmea_utc_s(clock, day + month + year, "%d%m%Y"))
            case _:
                return False
        return True


def json_object(payload: bytes) -> dict[str, object]:
    """Return a JSON object; empty if the payload is none."""
    try:
        found = json.loads(payload)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def number(value: object) -> float | None:
    """Return a finite number; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        found = float(value)
    except OverflowError:
        return None
    return found if math.isfinite(found) else None


def _nmea_position(lat: str, north: str, lon: str, east: str) -> tuple[float, float]:
    """Return latitude and longitude of degrees and minutes (ddmm.mmm, dddmm.mmm); NaN for an invalid value."""
    lat_deg, lon_deg = (_float(text[:digits]) + _float(text[digits:]) / 60 for text, digits in ((lat, 2), (lon, 3)))
    signs = {"N": 1.0, "E": 1.0, "S": -1.0, "W": -1.0}
    return lat_deg * signs.get(north, math.nan), lon_deg * signs.get(east, math.nan)


def _nmea_utc_s(clock: str, date: str, date_format: str) -> float:
    """Return the time of hhmmss.ss and a date, UTC seconds since 1970; NaN for an invalid value."""
    try:
        when = datetime.strptime(date + clock[:6], date_format + "%H%M%S").replace(tzinfo=UTC)
    except ValueError:
        return math.nan
    return when.timestamp() + (_float("0" + clock[6:]) if clock[6:] else 0.0)


def _float(text: str) -> float:
    """Return the number; NaN for another value."""
    try:
        return float(text)
    except ValueError:
        return math.nan
