"""Reader of EdgeTech JSF recordings: the side-scan messages (type 80), envelope or analytic.

The layout is that of published descriptions and open readers; no recording of a sonar was read. A file is a sequence of
messages, each with a header of 16 bytes that contains the size of the rest. Message 80 has a header of 240 bytes and
samples of one side, nearest first. Port and starboard have the same ping number. All values are little endian.

Conversions and assumptions:

* Subsystems 20, 21 and 22 are side-scan sonars of different frequencies. Messages of the same ping number and time are
  one ping: all sides and subsystems that transmit together. Subsystems that transmit in turn have pings of their own.
* The fields of 16 bits for the start and end frequency and the number of samples have four more bits elsewhere
  (protocol 0xA); sample interval (0xB), course and speed (0xC) have fractions there.
* Envelope samples count as unsigned. Analytic samples are converted to their magnitude, rounded. Echo strength is the
  sample times 2^-N with the weighting factor N of the message.
* Slant range is half the sound speed times the sample interval; 1500 m/s where no plausible sound speed is recorded.
  A recording that begins after the transmission (starting depth) is padded with zeros.
* A value without its validity bit is unknown. A position is that of the antenna at the last fix, unless the file marks
  it as interpolated. A recorded layback, the distance to the sonar, is applied to positions of the antenna.
"""

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Final

import numpy as np
from typing_extensions import override

from sonarpost.sonar.geometry import Position
from sonarpost.sonar.navigation import KNOT_MPS, plausible, plausible_angle, position_in_degrees
from sonarpost.sonar.projection import Projection, grid_coordinates
from sonarpost.sonar.readers.file_source import FileSource
from sonarpost.sonar.readers.joining import PingPart, joined
from sonarpost.sonar.readers.records import Notes, RecordFormat, records
from sonarpost.sonar.survey import MAX_SLANT_RANGE_M, ChannelPing, Ping, Samples, Side

MARKER: Final = 0x1601
MESSAGE_BYTES: Final = 16
SONAR_MESSAGE: Final = 80
SONAR_BYTES: Final = 240
MAX_MESSAGE_BYTES: Final = 1 << 24

_MAX_PROTOCOL, _MAX_KIND = 0x3F, 19_999
"""Above the protocol versions and message types in use (0x15, 17229)."""
_SIDE_SCAN: Final = (20, 21, 22)
_SIDES: Final = {0: Side.PORT, 1: Side.STARBOARD}
_ENVELOPE, _ANALYTIC = 0, 1
_SAMPLE_BYTES: Final = {_ENVELOPE: 2, _ANALYTIC: 4}
_SAME_PING_S: Final = 0.1
"""Maximum difference of the times of the messages of a ping; pings that are closer have different numbers."""
_HELD_PINGS: Final = 8
_PROTOCOL_TIME, _PROTOCOL_EXTENDED, _PROTOCOL_INTERVAL, _PROTOCOL_FRACTIONS = 8, 0xA, 0xB, 0xC
"""Protocol versions from which a message contains seconds since 1970, more bits, and fractions."""
_POSITION, _COURSE, _SPEED, _HEADING, _ATTITUDE, _ALTITUDE, _DEPTH, _INTERPOLATED = 0, 1, 2, 3, 5, 6, 9, 13
"""Validity bits."""
_METRES: Final = {1: 1e-3, 3: 0.1, 4: 0.01}
_ARC_MINUTES: Final = 2
_ARC_UNITS: Final = 600_000
_MAX_LAYBACK_M: Final = 10_000.0
_SOUND_SPEED_MPS: Final = 1500.0
_SOUND_SPEEDS_MPS: Final = (1300.0, 1700.0)
_MAX_WEIGHT: Final = 31
_MAX_LEAD: Final = 4
"""Maximum number of samples before the first recorded one, as a multiple of the recorded ones."""
_FIX_OF_ANTENNA: Final = "position of the antenna at the last fix, without layback (option mounting),"
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_START: Final = re.compile(rb"\x01\x16(?=[\x01-\x3f]..[\x00-\x4e].{9}[\x00\x01])", re.DOTALL)
"""Marker, and possible protocol, type and size."""

_Head = tuple[int, bytes]
"""Protocol and header of a sonar message."""


class _Message(RecordFormat):
    name = "message"
    magic = MARKER.to_bytes(2, "little")
    head_bytes = MESSAGE_BYTES

    @override
    def length(self, head: bytes, offset: int) -> int:
        marker, protocol, kind, size = struct.unpack("<HBxH6xi", head)
        least = SONAR_BYTES if kind == SONAR_MESSAGE else 0
        valid = marker == MARKER and 0 < protocol <= _MAX_PROTOCOL and 0 < kind <= _MAX_KIND
        return MESSAGE_BYTES + size if valid and least <= size <= MAX_MESSAGE_BYTES else 0

    @override
    def candidates(self, data: bytes, offset: int) -> Iterator[int]:
        return (found.start() for found in _START.finditer(data))

    @override
    def is_proved(self, raw: bytes) -> bool:
        """Return whether it is a sonar message with as many samples as its header states."""
        if _kind(raw) != SONAR_MESSAGE:
            return False
        body = raw[MESSAGE_BYTES:]
        return _sample_count(raw[2], body) * _SAMPLE_BYTES.get(_format(body), 0) == len(body) - SONAR_BYTES


_MESSAGE: Final = _Message()


class JsfSource(FileSource):
    """An open JSF recording.

    Raises:
        SurveyFileError: Not a JSF file, without a side-scan ping, or unreadable.
    """

    SONAR = "EdgeTech"

    @override
    def _prepare(self) -> None:
        crs = self.options.projected_crs
        self._projection = None if crs is None else Projection(crs)

    @override
    def _format_warnings(self) -> list[str]:
        return [*super()._format_warnings(), *self._notes.pings.lines(self._pings, [_FIX_OF_ANTENNA])]

    @override
    def _stored_pings(self, notes: Notes) -> Iterator[Ping]:
        for row, part in enumerate(joined(self._parts(notes), max_gap_s=_SAME_PING_S, held_pings=_HELD_PINGS)):
            ping = self._ping(part)
            is_antenna = ping.layback_m is None and not _is_valid(part.head[1], _INTERPOLATED)
            if is_antenna and ping.lat_deg is not None:
                notes.pings.add(_FIX_OF_ANTENNA, row)
            yield ping

    def _parts(self, notes: Notes) -> Iterator[PingPart[_Head]]:
        """Yield the side of each side-scan message.

        Raises:
            SurveyFileError: The file has messages, but none of a side-scan sonar.
        """
        kinds: Counter[int] = Counter()
        has_side_scan = False
        for place, _, raw in records(self._file, _MESSAGE, 0, notes):
            kinds[_kind(raw)] += 1
            if _kind(raw) != SONAR_MESSAGE:
                continue
            subsystem, side = raw[7], _SIDES.get(raw[8])
            has_side_scan |= subsystem in _SIDE_SCAN
            if subsystem not in _SIDE_SCAN or side is None:
                notes.add(f"skipped sonar message: subsystem {subsystem}, channel {raw[8]}, not side-scan")
                continue
            protocol, body = raw[2], raw[MESSAGE_BYTES:]
            with notes.leaving_out(place):
                channel = self._channel(place, protocol, subsystem, side, body, notes)
                if channel is not None:
                    (number,) = struct.unpack_from("<I", body, 8)
                    time_s = self._time(place, protocol, body)
                    yield PingPart(number, time_s, (protocol, body[:SONAR_BYTES]), (channel,))
        if kinds and not has_side_scan:
            found = ", ".join(f"type {kind} ({count} times)" for kind, count in kinds.most_common(6))
            raise self._file.error("messages", found, f"type {SONAR_MESSAGE} of a side-scan subsystem (20, 21, 22)")

    def _channel(
        self, place: str, protocol: int, subsystem: int, side: Side, body: bytes, notes: Notes
    ) -> ChannelPing | None:
        """Return the channel of a message; None if it is not an image of the seabed."""
        kind = _format(body)
        if kind not in _SAMPLE_BYTES:
            notes.add(f"skipped {side.value} message: data format {kind}, not envelope (0) or analytic (1)")
            return None
        count = _sample_count(protocol, body)
        limit = (len(body) - SONAR_BYTES) // _SAMPLE_BYTES[kind]
        if not count <= limit:
            raise self._file.error(f"{place}, number of samples", count, f"up to {limit}")
        (interval_ns,) = struct.unpack_from("<I", body, 116)
        if protocol >= _PROTOCOL_INTERVAL:
            interval_ns += body[18] / 256
        (sound_speed_mps,) = struct.unpack_from("<f", body, 148)
        if not _SOUND_SPEEDS_MPS[0] <= sound_speed_mps <= _SOUND_SPEEDS_MPS[1]:  # includes NaN
            notes.add(f"no plausible sound speed: {_SOUND_SPEED_MPS:g} m/s assumed")
            sound_speed_mps = _SOUND_SPEED_MPS
        (lead,) = struct.unpack_from("<I", body, 4)
        slant_range_m = (lead + count) * interval_ns * 1e-9 * sound_speed_mps / 2
        if lead > _MAX_LEAD * count or not 0 < slant_range_m <= MAX_SLANT_RANGE_M:
            notes.add(f"skipped {side.value} message: no samples, or impossible sample interval or starting depth")
            return None
        samples = _samples(body, kind, count)
        if lead:
            notes.add("recording began after the transmission (starting depth): zeros replace the missing samples")
            samples = np.concatenate([np.zeros(lead, samples.dtype), samples])
        (weight,) = struct.unpack_from("<h", body, 168)
        if abs(weight) > _MAX_WEIGHT:
            notes.add(f"weighting factor beyond ±{_MAX_WEIGHT} is not applied")
            weight = 0
        start, end = (_extended(protocol, body, offset, bits) for offset, bits in ((126, 0), (128, 4)))
        frequency_hz = 5.0 * (start + end)  # the middle of start and end, each in 10 Hz
        return ChannelPing(side, samples, slant_range_m, frequency_hz or None, math.ldexp(1.0, -weight), subsystem)

    def _ping(self, part: PingPart[_Head]) -> Ping:
        protocol, body = part.head
        position, grid_m = self._position(body) if _is_valid(body, _POSITION) else (None, None)

        def known(bit: int, name: str, value: float) -> float | None:
            return plausible(name, value) if _is_valid(body, bit) else None

        depth_mm, altitude_mm = struct.unpack_from("<i4xi", body, 136)
        heading, pitch, roll = struct.unpack_from("<Hhh", body, 172)
        course_deg, speed = struct.unpack_from("<hh", body, 192)
        if protocol >= _PROTOCOL_FRACTIONS:
            course_deg += min(body[19], 99) / 100
            speed += min(body[20] & 0xF, 9) / 10
        return Ping(
            number=part.number,
            time_utc_s=part.time_utc_s,
            channels=part.channels,
            lat_deg=position.lat_deg if position else None,
            lon_deg=position.lon_deg if position else None,
            heading_deg=plausible_angle(heading / 100) if _is_valid(body, _HEADING) else None,
            altitude_m=(known(_ALTITUDE, "altitude_m", altitude_mm / 1000) or None),
            depth_m=known(_DEPTH, "depth_m", depth_mm / 1000),
            speed_mps=known(_SPEED, "speed_mps", speed / 10 * KNOT_MPS),
            pitch_deg=known(_ATTITUDE, "pitch_deg", pitch * 180 / 32768),
            roll_deg=known(_ATTITUDE, "roll_deg", roll * 180 / 32768),
            grid_m=grid_m,
            course_deg=plausible_angle(course_deg) if _is_valid(body, _COURSE) else None,
            layback_m=self._layback_m(body),
        )

    def _layback_m(self, body: bytes) -> float | None:
        """Return the recorded layback, if it is to be applied to the position."""
        (layback_m,) = struct.unpack_from("<f", body, 228)
        choice = self.options.recorded_layback
        applies = choice == "apply" or (choice == "auto" and not _is_valid(body, _INTERPOLATED))
        return layback_m if applies and 0 < layback_m <= _MAX_LAYBACK_M else None

    def _position(self, body: bytes) -> tuple[Position | None, tuple[float, float] | None]:
        """Return the position in degrees, and the coordinates of a file in metres."""
        x, y = struct.unpack_from("<ii", body, 80)
        (unit,) = struct.unpack_from("<h", body, 88)
        if unit == _ARC_MINUTES:
            return position_in_degrees(y / _ARC_UNITS, x / _ARC_UNITS), None
        if unit not in _METRES:
            return None, None
        easting_m, northing_m = x * _METRES[unit], y * _METRES[unit]
        position = None if self._projection is None else self._projection.position(easting_m, northing_m)
        return position, grid_coordinates(easting_m, northing_m)

    def _time(self, place: str, protocol: int, body: bytes) -> float:
        """Return the time of a ping, UTC seconds since 1970.

        Raises:
            SurveyFileError: The message has no valid date.
        """
        (day_ms,) = struct.unpack_from("<I", body, 200)
        (seconds,) = struct.unpack_from("<i", body, 0)
        if protocol >= _PROTOCOL_TIME and seconds > 0:
            # Milliseconds of the day repeat the seconds; they are used if both agree.
            midnight = seconds - seconds % 86_400
            return float(midnight + day_ms / 1000 if abs(day_ms / 1000 - seconds % 86_400) < 2 else seconds)
        stamp = struct.unpack_from("<5h", body, 156)
        year, day, hour, minute, second = stamp
        if not (1970 <= year <= 9999 and 1 <= day <= 366 and 0 <= hour < 24 and 0 <= minute < 60 and 0 <= second < 60):
            expected = "seconds since 1970, or year, day of the year, hour, minute, second"
            raise self._file.error(f"{place}, date and time", (seconds, *stamp), expected)
        day_s = hour * 3600 + minute * 60 + second
        midnight_utc = datetime(year, 1, 1, tzinfo=UTC) - _EPOCH + timedelta(days=day - 1)
        return float(midnight_utc.total_seconds() + (day_ms / 1000 if abs(day_ms / 1000 - day_s) < 2 else day_s))


def _kind(raw: bytes) -> int:
    return int.from_bytes(raw[4:6], "little")


def _is_valid(body: bytes, bit: int) -> bool:
    return bool(int.from_bytes(body[30:32], "little") >> bit & 1)


def _format(body: bytes) -> int:
    return int.from_bytes(body[34:36], "little", signed=True)


def _extended(protocol: int, body: bytes, offset: int, bits: int) -> int:
    """Return a number of 16 bits at `offset`, with four upper bits from the field of upper bits."""
    upper = int.from_bytes(body[16:18], "little") >> bits & 0xF if protocol >= _PROTOCOL_EXTENDED else 0
    return int.from_bytes(body[offset : offset + 2], "little") | upper << 16


def _sample_count(protocol: int, body: bytes) -> int:
    return _extended(protocol, body, 114, 8)


def _samples(body: bytes, kind: int, count: int) -> Samples:
    if kind == _ENVELOPE:
        return np.frombuffer(body, "<u2", count, SONAR_BYTES).astype(np.uint16)
    parts = np.frombuffer(body, "<i2", 2 * count, SONAR_BYTES).astype(np.float32)
    return np.rint(np.hypot(parts[0::2], parts[1::2])).astype(np.uint16)
