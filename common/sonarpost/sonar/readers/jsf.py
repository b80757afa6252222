"""Reader of EdgeTech JSF recordings: the side-scan messages (type 80), envelope or analytic.

The layout is that of published descriptions and open readers; no recording of a sonar was read. A file is a sequence of
messages, each with a header of 16 bytes that contains the size of the rest. Message 80 has a header of 240 bytes and
samples of one side, nearest first. Port and starboard have the same ping number. All values are little endian.

Conversions and assumptions:

* Subsystems 20, 21 and 22 are side-scan sonars of different frequencies. Pings are those of the subsystem with the most
  messages, of equal ones the lowest. Channels of the others with the same ping number follow its own in the ping.
* Envelope samples count as unsigned. Analytic samples are converted to their magnitude, rounded. Echo strength is the
  sample times 2^-N with the weighting factor N of the message.
* Slant range is half the sound speed times the sample interval; 1500 m/s where no plausible sound speed is recorded.
  A recording that begins after the transmission (starting depth) is padded with zeros.
* A value without its validity bit is unknown. Positions are those of the last fix, without layback, unless the file
  marks them as interpolated.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

import numpy as np

from sonarpost.sonar.geometry import Position
from sonarpost.sonar.navigation import KNOT_MPS, PingCounter, is_plausible, position_in_degrees
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.projection import GridExtent, Projection, extended, grid_coordinates
from sonarpost.sonar.readers.open_file import CheckedFile, SequentialReader
from sonarpost.sonar.source import StreamedSource
from sonarpost.sonar.survey import MAX_SLANT_RANGE_M, ChannelPing, Ping, Samples, Side

MARKER: Final = 0x1601
MESSAGE_BYTES: Final = 16
SONAR_MESSAGE: Final = 80
SONAR_BYTES: Final = 240
MAX_MESSAGE_BYTES: Final = 1 << 24

_SIDE_SCAN: Final = (20, 21, 22)
_SIDES: Final = {0: Side.PORT, 1: Side.STARBOARD}
_ENVELOPE, _ANALYTIC = 0, 1
_PROTOCOL_TIME, _PROTOCOL_EXTENDED, _PROTOCOL_FRACTIONS = 8, 0xA, 0xB
"""Protocol versions from which a message contains seconds since 1970, more bits of a count, and fractions."""
_POSITION, _SPEED, _HEADING, _ATTITUDE, _ALTITUDE, _DEPTH, _INTERPOLATED = 0, 2, 3, 5, 6, 9, 13
"""Validity bits."""
_METRES: Final = {1: 1e-3, 3: 0.1, 4: 0.01}
_ARC_MINUTES: Final = 2
_ARC_UNITS: Final = 600_000
_SOUND_SPEED_MPS: Final = 1500.0
_SOUND_SPEEDS_MPS: Final = (1300.0, 1700.0)
_MAX_WEIGHT: Final = 31
_MAX_LEAD: Final = 4
"""Maximum number of samples before the first recorded one, as a multiple of the recorded ones."""
_HELD_GROUPS: Final = 8
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(slots=True)
class _Group:
    """Messages of one ping of one subsystem: header and protocol of the first, and the channels."""

    number: int
    protocol: int
    place: str
    head: bytes
    channels: dict[Side, ChannelPing]


class JsfSource(StreamedSource):
    """An open JSF recording.

    A file that ends inside its last message, as after a power failure, is read up to there with a warning. The cut
    message may not be longer than the longest one before it.

    Raises:
        SurveyFileError: Not a JSF file, damaged, without a side-scan ping, or unreadable.
    """

    def __init__(self, path: Path, options: SurveyOptions) -> None:
        super().__init__(path, options)
        self._file = CheckedFile(path)
        self._projection = None if options.projected_crs is None else Projection(options.projected_crs)
        self._notes: Counter[str] = Counter()
        self._without_fix, self._fix_of_antenna = PingCounter(), PingCounter()
        self._extent: GridExtent | None = None
        self._pings = 0
        self._cut = ""
        try:
            self._subsystem = self._main_subsystem()
            self._validate("EdgeTech", path.stem)
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _format_warnings(self) -> list[str]:
        warnings = [self._cut] if self._cut else []
        warnings += [f"{text} ({count} times)" for text, count in sorted(self._notes.items())]
        if self._extent is not None and self._projection is None:
            warnings.append("no positions: the file has projected metres; set the option projected_crs (--crs)")
        elif self._without_fix.count:
            warnings.append(f"no position fix in {self._without_fix.summary(self._pings)}")
        if self._fix_of_antenna.count:
            warnings.append(
                "position of the antenna at the last fix, without layback (option mounting), in "
                + self._fix_of_antenna.summary(self._pings)
            )
        return warnings

    def _grid(self) -> GridExtent | None:
        return self._extent

    def _main_subsystem(self) -> int:
        """Return the side-scan subsystem with the most messages.

        Raises:
            SurveyFileError: The file is damaged, or contains none.
        """
        counts: Counter[int] = Counter()
        kinds: Counter[int] = Counter()
        for _, head, _ in self._messages(with_content=False):
            kinds[_kind(head)] += 1
            if _kind(head) == SONAR_MESSAGE:
                counts[head[7]] += 1
        side_scan = {subsystem: counts[subsystem] for subsystem in _SIDE_SCAN if counts[subsystem]}
        if not side_scan:
            found = ", ".join(f"type {kind} ({count} times)" for kind, count in kinds.most_common(6)) or "none"
            raise self._file.error("messages", found, f"type {SONAR_MESSAGE} of a side-scan subsystem (20, 21, 22)")
        return max(side_scan, key=lambda subsystem: (side_scan[subsystem], -subsystem))

    def _messages(self, *, with_content: bool) -> Iterator[tuple[str, bytes, bytes]]:
        """Yield place, header and content of every complete message; the content only of type 80.

        Raises:
            SurveyFileError: The file is damaged.
        """
        reader = SequentialReader(self._file)
        longest = 0
        while remaining := reader.remaining:
            place = f"message at byte {reader.offset}"
            head = reader.read(min(MESSAGE_BYTES, remaining), place)
            marker = MARKER.to_bytes(2, "little")
            if head[:2] != marker[: len(head)]:
                raise self._file.error(f"{place}, marker", head[:2].hex(), marker.hex())
            size = struct.unpack_from("<i", head, 12)[0] if len(head) == MESSAGE_BYTES else 0
            if not 0 <= size <= MAX_MESSAGE_BYTES:
                raise self._file.error(f"{place}, size", size, f"0 to {MAX_MESSAGE_BYTES} bytes")
            if remaining < MESSAGE_BYTES + size:
                if size <= longest:
                    self._cut = (
                        "the file ends inside its last message, as after a power failure: "
                        f"{remaining} bytes are left out"
                    )
                    return
                reader.read(size, place)  # raises the error of a truncated file
            longest = max(longest, size)
            if with_content and _kind(head) == SONAR_MESSAGE:
                yield place, head, reader.read(size, place)
            else:
                reader.offset += size
                yield place, head, b""

    def _read_pings(self, *, first_pass: bool) -> Iterator[Ping]:
        notes = self._notes if first_pass else Counter[str]()
        row = 0
        for group, others in self._groups(notes):
            ping = self._ping(group, others)
            if first_pass:
                self._observe(row, ping, group)
            row += 1
            yield ping
        self._pings = row
        self._file.check_unchanged()

    def _observe(self, row: int, ping: Ping, group: _Group) -> None:
        if ping.grid_m is not None:
            self._extent = extended(self._extent, *ping.grid_m)
        if ping.lat_deg is None:
            self._without_fix.add(row)
        elif not _valid(group.head) >> _INTERPOLATED & 1:
            self._fix_of_antenna.add(row)

    def _groups(self, notes: Counter[str]) -> Iterator[tuple[_Group, list[_Group]]]:
        """Yield the pings of the main subsystem, each with those of other subsystems of the same number."""
        current: _Group | None = None
        others: dict[tuple[int, int], _Group] = {}

        def complete(group: _Group) -> tuple[_Group, list[_Group]]:
            keys = sorted(key for key in others if key[1] == group.number)
            return group, [others.pop(key) for key in keys]

        for subsystem, group in self._side_scan_messages(notes):
            (side,) = group.channels
            if subsystem == self._subsystem:
                if current is None or current.number != group.number or side in current.channels:
                    if current is not None:
                        yield complete(current)
                    current = group
                current.channels |= group.channels
                continue
            others.setdefault((subsystem, group.number), group).channels.update(group.channels)
            if len(others) > _HELD_GROUPS:
                oldest = next(iter(others))
                del others[oldest]
                notes[self._left_out(oldest[0])] += 1
        if current is not None:
            yield complete(current)
        for subsystem, _ in others:
            notes[self._left_out(subsystem)] += 1

    def _left_out(self, subsystem: int) -> str:
        return f"left out ping of subsystem {subsystem}: none of this number in subsystem {self._subsystem}"

    def _side_scan_messages(self, notes: Counter[str]) -> Iterator[tuple[int, _Group]]:
        """Yield subsystem and content of every message of a side, as a group of one channel."""
        for place, head, raw in self._messages(with_content=True):
            if _kind(head) != SONAR_MESSAGE:
                continue
            protocol, subsystem, side = head[2], head[7], _SIDES.get(head[8])
            if subsystem not in _SIDE_SCAN or side is None:
                notes[f"skipped sonar message: subsystem {subsystem}, channel {head[8]}, not side-scan"] += 1
                continue
            if len(raw) < SONAR_BYTES:
                raise self._file.error(f"{place}, size", len(raw), f"at least {SONAR_BYTES} bytes of a sonar message")
            channel = self._channel(place, protocol, side, raw, notes)
            if channel is not None:
                (number,) = struct.unpack_from("<I", raw, 8)
                yield subsystem, _Group(number, protocol, place, raw[:SONAR_BYTES], {side: channel})

    def _channel(self, place: str, protocol: int, side: Side, raw: bytes, notes: Counter[str]) -> ChannelPing | None:
        """Return the channel of a message; None if it is not an image of the seabed."""
        (kind,) = struct.unpack_from("<h", raw, 34)
        if kind not in (_ENVELOPE, _ANALYTIC):
            notes[f"skipped {side.value} message: data format {kind}, not envelope (0) or analytic (1)"] += 1
            return None
        (count,) = struct.unpack_from("<H", raw, 114)
        if protocol >= _PROTOCOL_EXTENDED:
            count |= (struct.unpack_from("<H", raw, 16)[0] >> 8 & 0xF) << 16
        limit = (len(raw) - SONAR_BYTES) // (4 if kind == _ANALYTIC else 2)
        if not count <= limit:
            raise self._file.error(f"{place}, number of samples", count, f"up to {limit}")
        (interval_ns,) = struct.unpack_from("<I", raw, 116)
        if protocol >= _PROTOCOL_FRACTIONS:
            interval_ns += raw[18] / 256
        (sound_speed_mps,) = struct.unpack_from("<f", raw, 148)
        if not _SOUND_SPEEDS_MPS[0] <= sound_speed_mps <= _SOUND_SPEEDS_MPS[1]:  # includes NaN
            notes[f"no plausible sound speed: {_SOUND_SPEED_MPS:g} m/s assumed"] += 1
            sound_speed_mps = _SOUND_SPEED_MPS
        (lead,) = struct.unpack_from("<I", raw, 4)
        slant_range_m = (lead + count) * interval_ns * 1e-9 * sound_speed_mps / 2
        if lead > _MAX_LEAD * count or not 0 < slant_range_m <= MAX_SLANT_RANGE_M:
            notes[f"skipped {side.value} message: no samples, or impossible sample interval or starting depth"] += 1
            return None
        samples = _samples(raw, kind, count)
        if lead:
            notes["recording began after the transmission (starting depth): zeros replace the missing samples"] += 1
            samples = np.concatenate([np.zeros(lead, samples.dtype), samples])
        (weight,) = struct.unpack_from("<h", raw, 168)
        if abs(weight) > _MAX_WEIGHT:
            notes[f"weighting factor beyond ±{_MAX_WEIGHT} is not applied"] += 1
            weight = 0
        frequency_hz = 5.0 * sum(struct.unpack_from("<HH", raw, 126))  # the middle of start and end, each in 10 Hz
        return ChannelPing(side, samples, slant_range_m, frequency_hz or None, math.ldexp(1.0, -weight))

    def _ping(self, group: _Group, others: list[_Group]) -> Ping:
        head, valid = group.head, _valid(group.head)
        position, grid_m = self._position(head) if valid >> _POSITION & 1 else (None, None)
        ordered = [each.channels[side] for each in (group, *others) for side in Side if side in each.channels]

        def known(bit: int, name: str, value: float) -> float | None:
            return value if valid >> bit & 1 and is_plausible(name, value) else None

        heading_deg = struct.unpack_from("<H", head, 172)[0] / 100
        depth_mm, altitude_mm = struct.unpack_from("<i4xi", head, 136)
        pitch, roll = struct.unpack_from("<hh", head, 174)
        (speed_knots_10,) = struct.unpack_from("<h", head, 194)
        return Ping(
            number=group.number,
            time_utc_s=self._time(group),
            channels=tuple(ordered),
            lat_deg=position.lat_deg if position else None,
            lon_deg=position.lon_deg if position else None,
            heading_deg=None if known(_HEADING, "heading_deg", heading_deg) is None else heading_deg % 360,
            altitude_m=(known(_ALTITUDE, "altitude_m", altitude_mm / 1000) or None),
            depth_m=known(_DEPTH, "depth_m", depth_mm / 1000),
            speed_mps=known(_SPEED, "speed_mps", speed_knots_10 / 10 * KNOT_MPS),
            pitch_deg=known(_ATTITUDE, "pitch_deg", pitch * 180 / 32768),
            roll_deg=known(_ATTITUDE, "roll_deg", roll * 180 / 32768),
            grid_m=grid_m,
        )

    def _position(self, head: bytes) -> tuple[Position | None, tuple[float, float] | None]:
        """Return the position in degrees, and the coordinates of a file in metres."""
        x, y = struct.unpack_from("<ii", head, 80)
        (unit,) = struct.unpack_from("<h", head, 88)
        if unit == _ARC_MINUTES:
            return position_in_degrees(y / _ARC_UNITS, x / _ARC_UNITS), None
        if unit not in _METRES:
            return None, None
        easting_m, northing_m = x * _METRES[unit], y * _METRES[unit]
        position = None if self._projection is None else self._projection.position(easting_m, northing_m)
        return position, grid_coordinates(easting_m, northing_m)

    def _time(self, group: _Group) -> float:
        """Return the time of a ping, UTC seconds since 1970.

        Raises:
            SurveyFileError: The message has no valid date.
        """
        head = group.head
        (day_ms,) = struct.unpack_from("<I", head, 200)
        (seconds,) = struct.unpack_from("<i", head, 0)
        if group.protocol >= _PROTOCOL_TIME and seconds > 0:
            # Milliseconds of the day repeat the seconds; they are used if both agree.
            midnight = seconds - seconds % 86_400
            return float(midnight + day_ms / 1000 if abs(day_ms / 1000 - seconds % 86_400) < 2 else seconds)
        stamp = struct.unpack_from("<5h", head, 156)
        year, day, hour, minute, second = stamp
        if not (1970 <= year <= 9999 and 1 <= day <= 366 and 0 <= hour < 24 and 0 <= minute < 60 and 0 <= second < 60):
            expected = "seconds since 1970, or year, day of the year, hour, minute, second"
            raise self._file.error(f"{group.place}, date and time", (seconds, *stamp), expected)
        day_s = hour * 3600 + minute * 60 + second
        midnight_utc = datetime(year, 1, 1, tzinfo=UTC) - _EPOCH + timedelta(days=day - 1)
        return float(midnight_utc.total_seconds() + (day_ms / 1000 if abs(day_ms / 1000 - day_s) < 2 else day_s))


def _kind(head: bytes) -> int:
    return int.from_bytes(head[4:6], "little")


def _valid(head: bytes) -> int:
    return int.from_bytes(head[30:32], "little")


def _samples(raw: bytes, kind: int, count: int) -> Samples:
    if kind == _ENVELOPE:
        return np.frombuffer(raw, "<u2", count, SONAR_BYTES).astype(np.uint16)
    parts = np.frombuffer(raw, "<i2", 2 * count, SONAR_BYTES).astype(np.float32)
    return np.rint(np.hypot(parts[0::2], parts[1::2])).astype(np.uint16)
