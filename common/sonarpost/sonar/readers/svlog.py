"""Reader of Cerulean SVLOG recordings of two Omniscan side-scan sonars, port (channel 0) and starboard (channel 1).

The layout is that of the published Ping protocol and of open readers; no recording of a sonar was read. A file is a
sequence of packets: B R, u16 payload length, u16 identifier, source, destination, payload, u16 sum of all bytes before
it. All values are little endian. These are read: 10 (JSON, the session with its date), 150 (JSON, a MAVLink message),
109 (an NMEA sentence) and 2198 (the profile of one transducer).

Conversions and assumptions:

* The date of the session is that of its uptime; profiles count milliseconds of the same clock. If they do not fit, the
  first profile is at the date of the session.
* Profiles of both sides within three quarters of a ping interval, consecutive in the file, are one ping.
* Profiles are scaled in decibels of power. The samples are amplitudes, 10^(dB/20), so that echo strength is linear.
* The range extends from the start of a profile over its length; a start above 0 is padded with zeros.
* Positions, speed and heading are those of the last message before the profile, up to five seconds old. Without one
  the heading is that of the profile. The altitude comes from bottom tracking.
"""

from __future__ import annotations

import json
import math
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.sonar.geometry import Position
from sonarpost.sonar.navigation import KNOT_MPS, PingCounter, is_plausible, position_in_degrees
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers.open_file import CheckedFile, SequentialReader
from sonarpost.sonar.source import StreamedSource
from sonarpost.sonar.survey import MAX_SLANT_RANGE_M, ChannelPing, Ping, Side

MAGIC: Final = b"BR"
SESSION, NMEA, MAVLINK, PROFILE = 10, 109, 150, 2198

_HEADER: Final = struct.Struct("<2sHHBB")
_CHECKSUM_BYTES: Final = 2
_PROFILE: Final = struct.Struct("<5I3HBx6f")
_SIDES: Final = {0: Side.PORT, 1: Side.STARBOARD}
_MAX_DECIBEL: Final = 300.0
_FULL_SCALE: Final = 65_535
_MAX_LEAD: Final = 4
"""Maximum number of samples before the first recorded one, as a multiple of the recorded ones."""
_VALID_S: Final = 5.0
"""Maximum age of a navigation message."""
_FIRST_PAIR_S: Final = 0.25
_PAIR_INTERVALS: Final = 0.75
_SESSION_S: Final = (-60.0, 86_400.0)
"""Time of the first profile after the date of the session; other values are those of another clock."""
_FREQUENCIES_HZ: Final = (1e4, 1e7)
_UNKNOWN_HEADING: Final = 65_535


_NEXT_PROFILE: Final = math.inf
"""Time of a value whose next profile has not been read."""


@dataclass(frozen=True, slots=True)
class _Navigation:
    """Values of the navigation messages so far, and the times of the profiles after them."""

    position: Position | None = None
    position_s: float = -math.inf
    speed_mps: float | None = None
    heading_deg: float | None = None
    heading_s: float = -math.inf

    def before(self, clock_s: float) -> _Navigation:
        """Return the navigation with the time of the next profile for new values."""
        position_s, heading_s = (
            clock_s if time_s == _NEXT_PROFILE else time_s for time_s in (self.position_s, self.heading_s)
        )
        return replace(self, position_s=position_s, heading_s=heading_s)


@dataclass(frozen=True, slots=True)
class _Profile:
    number: int
    clock_s: float
    heading_deg: float | None
    channel: ChannelPing
    navigation: _Navigation


class SvlogSource(StreamedSource):
    """An open SVLOG recording.

    A file that ends inside its last packet, as after a power failure, is read up to there with a warning.

    Raises:
        SurveyFileError: Not an SVLOG file, damaged, without a date or a profile, or unreadable.
    """

    def __init__(self, path: Path, options: SurveyOptions) -> None:
        super().__init__(path, options)
        self._file = CheckedFile(path)
        self._notes: Counter[str] = Counter()
        self._without_fix, self._without_heading = PingCounter(), PingCounter()
        self._unpaired = self._pings = 0
        self._cut = ""
        try:
            self._validate("Omniscan", path.stem)
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _format_warnings(self) -> list[str]:
        warnings = [self._cut] if self._cut else []
        warnings += [f"{text} ({count} times)" for text, count in sorted(self._notes.items())]
        if self._unpaired:
            warnings.append(f"only one side in {self._unpaired} of {self._pings} pings")
        texts = ((self._without_fix, "no position fix in"), (self._without_heading, "no heading in"))
        return warnings + [f"{text} {counter.summary(self._pings)}" for counter, text in texts if counter.count]

    def _read_pings(self, *, first_pass: bool) -> Iterator[Ping]:
        notes = self._notes if first_pass else Counter[str]()
        row = unpaired = 0
        for ping in self._paired(notes):
            if first_pass:
                if ping.lat_deg is None:
                    self._without_fix.add(row)
                if ping.heading_deg is None:
                    self._without_heading.add(row)
            unpaired += len(ping.channels) == 1
            row += 1
            yield ping
        self._pings, self._unpaired = row, unpaired
        self._file.check_unchanged()

    def _packets(self) -> Iterator[tuple[str, int, bytes]]:
        """Yield place, identifier and payload of every complete packet.

        Raises:
            SurveyFileError: The file is damaged.
        """
        reader = SequentialReader(self._file)
        longest = 0
        while remaining := reader.remaining:
            place = f"packet at byte {reader.offset}"
            head = reader.read(min(_HEADER.size, remaining), place)
            if head[:2] != MAGIC[: len(head)]:
                raise self._file.error(f"{place}, start", head[:2], repr(MAGIC))
            _, length, kind, *_ = _HEADER.unpack(head.ljust(_HEADER.size, b"\0"))
            if remaining < _HEADER.size + length + _CHECKSUM_BYTES and length <= longest:
                self._cut = (
                    f"the file ends inside its last packet, as after a power failure: {remaining} bytes are left out"
                )
                return
            longest = max(longest, length)
            payload = reader.read(length, place)
            want = int.from_bytes(reader.read(_CHECKSUM_BYTES, place), "little")
            got = (sum(head) + sum(payload)) & 0xFFFF
            if got != want:
                raise self._file.error(f"{place}, checksum", want, str(got))
            yield place, kind, payload

    def _paired(self, notes: Counter[str]) -> Iterator[Ping]:
        """Yield pings of one side or both."""
        waiting: _Profile | None = None
        last_s: dict[Side, float] = {}
        intervals_s: dict[Side, float] = {}
        clock = _Clock(self._file)
        for profile in self._profiles(clock, notes):
            side = profile.channel.side
            if (gap_s := profile.clock_s - last_s.get(side, math.inf)) > 0:
                intervals_s[side] = gap_s
            # The lesser one: a side whose profiles are missing has a longer interval.
            limit_s = _PAIR_INTERVALS * min(intervals_s.values()) if intervals_s else _FIRST_PAIR_S
            last_s[side] = profile.clock_s
            if waiting is None:
                waiting = profile
            elif waiting.channel.side is not side and abs(profile.clock_s - waiting.clock_s) <= limit_s:
                yield _ping(clock, waiting, profile)
                waiting = None
            else:
                yield _ping(clock, waiting)
                waiting = profile
        if waiting is not None:
            yield _ping(clock, waiting)

    def _profiles(self, clock: _Clock, notes: Counter[str]) -> Iterator[_Profile]:
        navigation = _Navigation()
        for place, kind, payload in self._packets():
            if kind == SESSION:
                clock.start(payload, place)
            elif kind == MAVLINK:
                navigation = _with_mavlink(navigation, payload, notes)
            elif kind == NMEA:
                navigation = _with_nmea(navigation, payload, notes)
            elif kind == PROFILE:
                if len(payload) < _PROFILE.size:
                    raise self._file.error(f"{place}, length", len(payload), f"at least {_PROFILE.size} for a profile")
                clock_s = _PROFILE.unpack_from(payload)[3] / 1000
                clock.observe(clock_s, place, notes)
                navigation = navigation.before(clock_s)
                if (profile := self._profile(place, payload, navigation, notes)) is not None:
                    yield profile

    def _profile(self, place: str, raw: bytes, navigation: _Navigation, notes: Counter[str]) -> _Profile | None:
        """Return a profile; None if it is not of a side, or its range or scale is impossible."""
        number, start_mm, length_mm, clock_ms, frequency_hz, _, count, _, number_of_channel, *floats = (
            _PROFILE.unpack_from(raw)
        )
        _, _, max_db, min_db, _, vehicle_heading_deg = floats
        if count * 2 > len(raw) - _PROFILE.size:
            limit = (len(raw) - _PROFILE.size) // 2
            raise self._file.error(f"{place}, number of results", count, f"up to {limit}")
        side = _SIDES.get(number_of_channel)
        if side is None:
            notes[f"skipped profile: channel {number_of_channel}, not port (0) or starboard (1)"] += 1
            return None
        lead = round(start_mm / length_mm * count) if length_mm else 0
        if not count or not 0 < start_mm + length_mm <= MAX_SLANT_RANGE_M * 1000 or lead > _MAX_LEAD * count:
            notes[f"skipped {side.value} profile: no samples, or impossible range"] += 1
            return None
        if not -_MAX_DECIBEL <= min_db <= max_db <= _MAX_DECIBEL:  # includes NaN
            notes[f"skipped {side.value} profile: impossible scale in decibels"] += 1
            return None
        values = np.frombuffer(raw, "<u2", count, _PROFILE.size)
        samples = np.concatenate([np.zeros(lead, np.float32), _amplitudes(values, min_db, max_db)])
        low_hz, high_hz = _FREQUENCIES_HZ
        channel = ChannelPing(
            side=side,
            samples=samples,
            slant_range_m=length_mm / 1000 * (lead + count) / count,
            frequency_hz=float(frequency_hz) if low_hz <= frequency_hz <= high_hz else None,
        )
        # Exactly 0 is the value of a sonar without a vehicle's heading.
        heading_known = vehicle_heading_deg != 0 and is_plausible("heading_deg", vehicle_heading_deg)
        heading_deg = vehicle_heading_deg % 360 if heading_known else None
        return _Profile(number, clock_ms / 1000, heading_deg, channel, navigation)


class _Clock:
    """Converts the clock of the profiles to UTC."""

    def __init__(self, file: CheckedFile) -> None:
        self._file = file
        self._session: tuple[float, float] | None = None
        self._offset_s: float | None = None

    def start(self, payload: bytes, place: str) -> None:
        """Set date and uptime of the session; later sessions are ignored.

        Raises:
            SurveyFileError: The packet has no date.
        """
        if self._session is not None:
            return
        session = _json_object(payload)
        stamp = session.get("timestamp")
        utc_s = _utc_s(stamp) if isinstance(stamp, str) else None
        if utc_s is None or utc_s < 0:
            expected = "an ISO 8601 date and time from 1970 on"
            raise self._file.error(f"{place}, timestamp", str(stamp)[:80], expected)
        uptime_s = _number(session.get("os_uptime", session.get("session_uptime")))
        self._session = (utc_s, math.nan if uptime_s is None else uptime_s)

    def observe(self, clock_s: float, place: str, notes: Counter[str]) -> None:
        """Determine the offset with the first profile.

        Raises:
            SurveyFileError: There was no session before it.
        """
        if self._offset_s is not None:
            return
        if self._session is None:
            raise self._file.error(f"{place}, date", "no session packet (10) before it", "a recording with its date")
        utc_s, uptime_s = self._session
        since_s = clock_s - uptime_s
        if not _SESSION_S[0] <= since_s <= _SESSION_S[1]:  # includes NaN
            notes["profiles have another clock than the session: the first one is at the date of the session"] += 1
            since_s = 0.0
        self._offset_s = utc_s + since_s - clock_s

    def utc_s(self, clock_s: float) -> float:
        """Return the time of a profile, UTC seconds since 1970."""
        assert self._offset_s is not None
        return self._offset_s + clock_s


def _utc_s(stamp: str) -> float | None:
    """Return the time of an ISO 8601 text, UTC without a zone, seconds since 1970; None for another value."""
    try:
        when = datetime.fromisoformat(stamp)
        return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        return None


def _ping(clock: _Clock, *profiles: _Profile) -> Ping:
    first = profiles[0]
    navigation, heading_deg = first.navigation, first.heading_deg
    position = navigation.position if abs(first.clock_s - navigation.position_s) <= _VALID_S else None
    if navigation.heading_deg is not None and abs(first.clock_s - navigation.heading_s) <= _VALID_S:
        heading_deg = navigation.heading_deg
    ordered = sorted(profiles, key=lambda profile: list(Side).index(profile.channel.side))
    return Ping(
        number=ordered[0].number,
        time_utc_s=clock.utc_s(first.clock_s),
        channels=tuple(profile.channel for profile in ordered),
        lat_deg=position.lat_deg if position else None,
        lon_deg=position.lon_deg if position else None,
        heading_deg=heading_deg,
        speed_mps=navigation.speed_mps if position else None,
    )


def _amplitudes(values: npt.NDArray[np.uint16], min_db: float, max_db: float) -> npt.NDArray[np.float32]:
    decibel = min_db + values.astype(np.float64) * ((max_db - min_db) / _FULL_SCALE)
    return (10 ** (decibel / 20)).astype(np.float32)


def _with_mavlink(navigation: _Navigation, payload: bytes, notes: Counter[str]) -> _Navigation:
    """Return the navigation with the values of a GLOBAL_POSITION_INT message; others are ignored."""
    message = _json_object(payload).get("message")
    if not isinstance(message, dict):
        notes["ignored MAVLink packet: not JSON with a message"] += 1
        return navigation
    if message.get("type") != "GLOBAL_POSITION_INT":
        return navigation
    lat, lon, vx, vy, hdg = (_number(message.get(name)) for name in ("lat", "lon", "vx", "vy", "hdg"))
    position = None if lat is None or lon is None else position_in_degrees(lat * 1e-7, lon * 1e-7)
    speed_mps = None if vx is None or vy is None else math.hypot(vx, vy) / 100
    navigation = replace(
        navigation,
        position=position,
        position_s=_NEXT_PROFILE,
        speed_mps=speed_mps if speed_mps is not None and is_plausible("speed_mps", speed_mps) else None,
    )
    if hdg is None or hdg == _UNKNOWN_HEADING or not is_plausible("heading_deg", hdg / 100):
        return navigation
    return replace(navigation, heading_deg=hdg / 100 % 360, heading_s=_NEXT_PROFILE)


def _with_nmea(navigation: _Navigation, payload: bytes, notes: Counter[str]) -> _Navigation:
    """Return the navigation with the values of an NMEA sentence GGA, RMC or HDT; others are ignored."""
    body, _, checksum = payload.strip(b"\r\n\0 ").removeprefix(b"$").partition(b"*")
    total = 0
    for byte in body:
        total ^= byte
    if checksum.upper() != f"{total:02X}".encode():
        notes["ignored NMEA sentence: checksum"] += 1
        return navigation
    fields = body.decode("latin-1").split(",")
    match fields[0][2:], fields:
        case "GGA", [_, _, lat, north, lon, east, quality, *_] if quality not in ("", "0"):
            return replace(navigation, position=_nmea_position(lat, north, lon, east), position_s=_NEXT_PROFILE)
        case "RMC", [_, _, "A", lat, north, lon, east, speed_knots, *_]:
            speed_mps = _float(speed_knots) * KNOT_MPS
            return replace(
                navigation,
                position=_nmea_position(lat, north, lon, east),
                position_s=_NEXT_PROFILE,
                speed_mps=speed_mps if is_plausible("speed_mps", speed_mps) else None,
            )
        case "HDT", [_, heading, *_] if is_plausible("heading_deg", _float(heading)):
            return replace(navigation, heading_deg=_float(heading) % 360, heading_s=_NEXT_PROFILE)
    return navigation


def _nmea_position(lat: str, north: str, lon: str, east: str) -> Position | None:
    """Return a position of degrees and minutes (ddmm.mmm, dddmm.mmm); None if it is invalid."""
    lat_deg, lon_deg = (_float(text[:digits]) + _float(text[digits:]) / 60 for text, digits in ((lat, 2), (lon, 3)))
    return position_in_degrees(-lat_deg if north == "S" else lat_deg, -lon_deg if east == "W" else lon_deg)


def _float(text: str) -> float:
    """Return the number; NaN for another value."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _json_object(payload: bytes) -> dict[str, object]:
    """Return a JSON object; empty if the payload is none."""
    try:
        found = json.loads(payload)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _number(value: object) -> float | None:
    """Return a finite number; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None
