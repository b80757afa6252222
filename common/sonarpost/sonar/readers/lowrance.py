"""Reader of Lowrance recordings, SL2 and SL3: the composite side-scan channel.

The layout is that of published descriptions and open readers, checked for SL3 with two recordings. After a header of
8 bytes, frames follow: a header of 144 (SL2) or 168 bytes (SL3) and samples of 8 bits, little endian. A frame of
channel 5 contains both sides: the left half farthest first, then the right half. Frames of other channels are skipped.

Conversions and assumptions where the format is incomplete:

* Ranges are in feet. SL3 stores the left range as a negative minimum; a minimum of 0 gives both sides the maximum.
* The date is that of the first frame; the time of a ping is that date plus its signed milliseconds. It counts as UTC.
* Positions are metres of a spherical Mercator map with the polar radius of WGS 84. A position of 0, 0 is no fix.
* The heading is in radians. A heading of exactly 0, as in both recordings, was not recorded.
* The depth of the echo sounder is not in the frames of channel 5: the altitude comes from bottom tracking.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from sonarpost.sonar.geometry import Position
from sonarpost.sonar.navigation import KNOT_MPS, PingCounter, is_plausible, position_in_degrees
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers.open_file import CheckedFile, SequentialReader
from sonarpost.sonar.source import StreamedSource
from sonarpost.sonar.survey import MAX_SLANT_RANGE_M, ChannelPing, Ping, Side

FILE_HEADER_BYTES: Final = 8
COMPOSITE: Final = 5

_FOOT_M: Final = 0.3048
_RADIUS_M: Final = 6_356_752.3142
_CHANNEL_NAMES: Final = {3: "left side-scan", 4: "right side-scan"}
_FIRST_DATE_S: Final = 946_684_800
"""2000-01-01: an earlier date is that of a unit without a clock."""
_MAX_HEADING_RAD: Final = 1e4


@dataclass(frozen=True, slots=True)
class _Layout:
    """Offsets of the fields of a frame header, bytes."""

    header_bytes: int
    frame_bytes: int
    channel: int
    samples: int
    samples_type: str
    index: int
    min_range: int
    max_range: int
    time_s: int
    speed: int
    east: int
    heading: int
    time_ms: int


_LAYOUTS: Final = {
    2: _Layout(144, 28, 32, 34, "<H", 36, 40, 44, 60, 100, 108, 128, 140),
    3: _Layout(168, 8, 12, 44, "<I", 16, 20, 24, 40, 84, 92, 112, 124),
}
"""Layout by the format number of the file header."""


class LowranceSource(StreamedSource):
    """An open SL2 or SL3 recording; the file header, not the suffix, selects the layout.

    Raises:
        SurveyFileError: Not an SL2 or SL3 file, damaged, truncated, without a composite side-scan ping, or unreadable.
    """

    def __init__(self, path: Path, options: SurveyOptions) -> None:
        super().__init__(path, options)
        self._file = CheckedFile(path)
        self._without_fix, self._without_heading = PingCounter(), PingCounter()
        self._skipped: Counter[int] = Counter()
        self._pings = 0
        try:
            self._layout = self._file_layout()
            self._validate("Lowrance", path.stem)
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _file_layout(self) -> _Layout:
        raw = self._file.read_at(0, FILE_HEADER_BYTES, "file header")
        (number,) = struct.unpack_from("<H", raw)
        if number not in _LAYOUTS:
            raise self._file.error("format", number, "2 (SL2) or 3 (SL3)")
        return _LAYOUTS[number]

    def _format_warnings(self) -> list[str]:
        warnings = [
            f"skipped channel: {_CHANNEL_NAMES[channel]}, not composite ({count} times)"
            for channel, count in sorted(self._skipped.items())
        ]
        texts = ((self._without_fix, "no position fix in"), (self._without_heading, "no heading in"))
        return warnings + [f"{text} {counter.summary(self._pings)}" for counter, text in texts if counter.count]

    def _read_pings(self, *, first_pass: bool) -> Iterator[Ping]:
        row = 0
        started_s = None
        for place, head, samples in self._frames():
            if started_s is None:
                started_s = self._start_time(head, place)
            (channel,) = struct.unpack_from("<H", head, self._layout.channel)
            if channel != COMPOSITE:
                self._skipped[channel] += first_pass and channel in _CHANNEL_NAMES
                continue
            ping = self._ping(place, head, samples, started_s)
            if first_pass:
                if ping.lat_deg is None:
                    self._without_fix.add(row)
                if ping.heading_deg is None:
                    self._without_heading.add(row)
            row += 1
            yield ping
        self._pings = row
        self._skipped = +self._skipped
        self._file.check_unchanged()

    def _frames(self) -> Iterator[tuple[str, bytes, bytes]]:
        """Yield place, header and samples of every frame.

        Raises:
            SurveyFileError: The file is damaged or ends inside a frame.
        """
        layout = self._layout
        reader = SequentialReader(self._file, FILE_HEADER_BYTES)
        while reader.remaining:
            start = reader.offset
            place = f"frame at byte {start}"
            head = reader.read(layout.header_bytes, place)
            (offset,) = struct.unpack_from("<I", head)
            if offset != start & 0xFFFFFFFF:
                raise self._file.error(f"{place}, offset", offset, str(start))
            (size,) = struct.unpack_from("<H", head, layout.frame_bytes)
            if size < layout.header_bytes:
                raise self._file.error(f"{place}, frame size", size, f"at least {layout.header_bytes}")
            yield place, head, reader.read(size - layout.header_bytes, place)

    def _start_time(self, head: bytes, place: str) -> float:
        (started_s,) = struct.unpack_from("<I", head, self._layout.time_s)
        if started_s < _FIRST_DATE_S:
            raise self._file.error(f"{place}, time", started_s, f"seconds since 1970, at least {_FIRST_DATE_S}")
        return float(started_s)

    def _ping(self, place: str, head: bytes, raw: bytes, started_s: float) -> Ping:
        layout = self._layout
        (count,) = struct.unpack_from(layout.samples_type, head, layout.samples)
        if count < 2 or count % 2 or count > len(raw):
            raise self._file.error(f"{place}, number of samples", count, f"an even number, 2 to {len(raw)}")
        left, right = np.split(np.frombuffer(raw, np.uint8, count), 2)
        slant_range_m = self._slant_range_m(place, head)
        position = _position(*struct.unpack_from("<2i", head, layout.east))
        (time_ms,) = struct.unpack_from("<i", head, layout.time_ms)
        (speed_kn,) = struct.unpack_from("<f", head, layout.speed)
        (heading_rad,) = struct.unpack_from("<f", head, layout.heading)
        speed_mps = speed_kn * KNOT_MPS
        return Ping(
            number=struct.unpack_from("<I", head, layout.index)[0],
            time_utc_s=started_s + time_ms / 1000,
            channels=(
                ChannelPing(Side.PORT, left[::-1].copy(), slant_range_m),
                ChannelPing(Side.STARBOARD, right.copy(), slant_range_m),
            ),
            lat_deg=position.lat_deg if position else None,
            lon_deg=position.lon_deg if position else None,
            heading_deg=_heading_deg(heading_rad),
            speed_mps=speed_mps if is_plausible("speed_mps", speed_mps) else None,
        )

    def _slant_range_m(self, place: str, head: bytes) -> float:
        """Return the range of each side, metres."""
        (low_ft,) = struct.unpack_from("<f", head, self._layout.min_range)
        (high_ft,) = struct.unpack_from("<f", head, self._layout.max_range)
        if not 0 < high_ft * _FOOT_M <= MAX_SLANT_RANGE_M:  # includes NaN
            raise self._file.error(f"{place}, maximum range", high_ft, f"up to {MAX_SLANT_RANGE_M} m, in feet")
        if not (low_ft == 0 or math.isclose(low_ft, -high_ft, rel_tol=1e-3)):
            raise self._file.error(f"{place}, minimum range", low_ft, f"0 or {-high_ft}")
        return float(high_ft * _FOOT_M)


def _heading_deg(heading_rad: float) -> float | None:
    """Return a heading of 0 to 360 degrees; None if it is exactly 0 or implausible."""
    if heading_rad == 0 or not abs(heading_rad) <= _MAX_HEADING_RAD:  # includes NaN
        return None
    return math.degrees(heading_rad) % 360 % 360  # a tiny negative angle gives 360 the first time


def _position(east_m: int, north_m: int) -> Position | None:
    """Return the position of coordinates on the Mercator map; None without a fix or beyond the map."""
    if (east_m, north_m) == (0, 0) or abs(east_m) > math.pi * _RADIUS_M:
        return None
    lat_rad = 2 * math.atan(math.exp(north_m / _RADIUS_M)) - math.pi / 2
    return position_in_degrees(math.degrees(lat_rad), math.degrees(east_m / _RADIUS_M))
