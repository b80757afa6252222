"""Reader of Lowrance recordings, SL2 and SL3: the composite side-scan channel.

The layout is that of published descriptions and open readers, checked for SL3 with two recordings. After a header of
8 bytes, frames follow: a header and samples of 8 bits, little endian. The header is what the samples leave of the
frame: 144 bytes in SL2; in SL3 168 or 180 (frame versions 10 and 13), and 128 in some channels. Its fields are the
same in all versions. A frame of channel 5 contains both sides: the left half farthest first, then the right half.
Frames of other channels are skipped.

Conversions and assumptions where the format is incomplete:

* Ranges are in feet. SL3 stores the left range as a negative minimum; a minimum of 0 gives both sides the maximum.
* The date is that of the first frame of each channel; later frames have a counter in its place. The time of a ping is
  that date plus its signed milliseconds. It counts as UTC.
* Positions are metres of a spherical Mercator map with the polar radius of WGS 84. A position of 0, 0 is no fix.
* Heading and course over ground are in radians. An angle of exactly 0, as all headings of both recordings, was not
  recorded.
* The depth of the echo sounder is not in the frames of channel 5: the altitude comes from bottom tracking.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt
from typing_extensions import override

from sonarpost.sonar.geometry import Position
from sonarpost.sonar.navigation import KNOT_MPS, plausible, position_in_degrees
from sonarpost.sonar.readers.file_source import FileSource
from sonarpost.sonar.readers.open_file import CheckedFile, SequentialReader
from sonarpost.sonar.readers.records import Notes, RecordFormat, records
from sonarpost.sonar.survey import MAX_SLANT_RANGE_M, ChannelPing, Ping, Side

_FILE_HEADER_BYTES: Final = 8
_COMPOSITE: Final = 5
_CHANNEL_NAMES: Final = {3: "left side-scan", 4: "right side-scan"}
_THREE_D: Final = 9
"""A channel of SL3 with other content than samples."""
_SIZES: Final = ("frame_bytes", "channel", "samples")
_MAX_HEADER_BYTES: Final = 256
_MAX_FRAME_BYTES: Final = 1 << 16
_WRAP: Final = 1 << 32
"""Offsets in the file are stored without their upper bits."""

_FOOT_M: Final = 0.3048
_RADIUS_M: Final = 6_356_752.3142
_DATES_S: Final = (946_684_800, 4_102_444_800)
"""2000 to 2100: an earlier date is that of a unit without a clock."""
_DATED_FRAMES: Final = 64
"""Number of frames among which the date is searched."""
_MAX_ANGLE_RAD: Final = 1e4
_SEARCH_BYTES: Final = (1 << 12, 1 << 16)
"""First and greatest size of the parts that are searched at once: the next frame is usually near."""

NumbersT = TypeVar("NumbersT", int, npt.NDArray[np.int64])


@dataclass(frozen=True, slots=True)
class _Layout:
    """Sizes in a frame header (of the frame, its channel, number of samples), and offsets of other fields, bytes."""

    min_header_bytes: int
    last_channel: int
    sizes: np.dtype[Any]
    index: int
    min_range: int
    max_range: int
    time_s: int
    speed: int
    east: int
    course: int
    heading: int
    time_ms: int


def _sizes(formats: tuple[str, ...], offsets: tuple[int, ...]) -> np.dtype[Any]:
    return np.dtype({"names": _SIZES, "formats": formats, "offsets": offsets})


_LAYOUTS: Final = {
    2: _Layout(144, 8, _sizes(("<u2", "<u2", "<u2"), (28, 32, 34)), 36, 40, 44, 60, 100, 108, 120, 128, 140),
    3: _Layout(128, 11, _sizes(("<u2", "<u4", "<u4"), (8, 12, 44)), 16, 20, 24, 40, 84, 92, 104, 112, 124),
}
"""Layout by the format number of the file header."""


class _Frames(RecordFormat):
    """Frames of a file. They have no marker: sizes and channel must agree.

    A frame begins with its offset in the file. After a lost or an inserted byte that differs from the real one, but
    the difference to the next frame remains the size, which a frame that is found by a search must have.
    """

    name = "frame"

    def __init__(self, layout: _Layout, file: CheckedFile) -> None:
        self._layout, self._file = layout, file
        self.head_bytes = layout.min_header_bytes

    def sizes(self, head: bytes) -> tuple[int, int, int]:
        """Return size in bytes, channel and number of samples of a frame."""
        frame_bytes, channel, samples = np.frombuffer(head, self._layout.sizes, 1).item()
        return frame_bytes, channel, samples

    @override
    def length(self, head: bytes, offset: int) -> int:
        sizes = self.sizes(head)
        return sizes[0] if self._agree(*sizes) else 0

    @override
    def candidates(self, data: bytes, offset: int) -> Iterator[int]:
        size = self._file.size_bytes
        reach = min(len(data) + _MAX_FRAME_BYTES, size - offset)  # up to the frame after the last one in the data
        extended = self._file.read_at(offset, reach, f"byte {offset}") + bytes(4)
        stored: npt.NDArray[np.uint32] = np.ndarray((reach + 1,), "<u4", extended, 0, (1,))
        first, count = 0, _SEARCH_BYTES[0]
        while (count := min(count, len(data) - self.head_bytes - first + 1)) > 0:
            at_each_byte: npt.NDArray[Any] = np.ndarray((count,), self._layout.sizes, data, first, (1,))
            sizes = [at_each_byte[name].astype(np.int64) for name in _SIZES]
            near = np.flatnonzero(self._agree(*sizes))
            starts, ends = first + near, np.minimum(first + near + sizes[0][near], reach)
            shift = (stored[starts] - (offset + starts) + _WRAP // 2) % _WRAP - _WRAP // 2
            is_linked = (stored[starts] + sizes[0][near]) % _WRAP == stored[ends]
            is_last = (offset + ends == size) & (np.abs(shift) <= size)
            yield from starts[is_linked | (shift == 0) | is_last].tolist()
            first, count = first + count, min(2 * count, _SEARCH_BYTES[1])

    def _agree(self, frame_bytes: NumbersT, channel: NumbersT, samples: NumbersT) -> bool | npt.NDArray[np.bool_]:
        """Return whether sizes are those of a frame; of numbers, or element by element of arrays."""
        header_bytes = frame_bytes - samples
        is_header = (header_bytes <= _MAX_HEADER_BYTES) & (header_bytes % 4 == 0) | (channel == _THREE_D)
        is_long_enough = header_bytes >= self._layout.min_header_bytes
        agree: bool | npt.NDArray[np.bool_] = (channel <= self._layout.last_channel) & is_long_enough & is_header
        return agree


class LowranceSource(FileSource):
    """An open SL2 or SL3 recording; the file header, not the suffix, selects the layout.

    Raises:
        SurveyFileError: Not an SL2 or SL3 file, without a date or a composite side-scan ping, or unreadable.
    """

    SONAR = "Lowrance"

    @override
    def _prepare(self) -> None:
        (number,) = struct.unpack_from("<H", self._file.read_at(0, _FILE_HEADER_BYTES, "file header"))
        if number not in _LAYOUTS:
            raise self._file.error("format", number, "2 (SL2) or 3 (SL3)")
        self._layout = _LAYOUTS[number]
        self._frames = _Frames(self._layout, self._file)
        self._started_s = self._start_time()

    def _start_time(self) -> float:
        """Return the most frequent date of the first frames, UTC seconds since 1970: one may be damaged."""
        heads = {}
        first = SequentialReader(self._file).peek(_FILE_HEADER_BYTES, self._frames.head_bytes)
        if len(first) == self._frames.head_bytes and self._frames.length(first, _FILE_HEADER_BYTES):
            heads[_FILE_HEADER_BYTES] = first  # its samples may be damaged
        found = records(self._file, self._frames, _FILE_HEADER_BYTES, Notes(), with_content=False)
        heads |= {offset: head for _, offset, head in islice(found, _DATED_FRAMES)}
        times = [struct.unpack_from("<I", head, self._layout.time_s)[0] for head in heads.values()]
        low_s, high_s = _DATES_S
        dates = Counter(time_s for time_s in times if low_s <= time_s <= high_s)
        if times and not dates:
            raise self._file.error(
                f"frame at byte {min(heads)}, time", times[0], f"seconds since 1970, {low_s} to {high_s}"
            )
        return float(dates.most_common(1)[0][0]) if dates else 0.0

    @override
    def _stored_pings(self, notes: Notes) -> Iterator[Ping]:
        for place, _, raw in records(self._file, self._frames, _FILE_HEADER_BYTES, notes):
            _, channel, samples = self._frames.sizes(raw)
            if channel == _COMPOSITE:
                with notes.leaving_out(place):
                    yield self._ping(place, raw, samples)
            elif channel in _CHANNEL_NAMES:
                notes.add(f"skipped channel: {_CHANNEL_NAMES[channel]}, not composite")

    def _ping(self, place: str, raw: bytes, samples: int) -> Ping:
        layout = self._layout
        if samples < 2 or samples % 2:
            raise self._file.error(f"{place}, number of samples", samples, "an even number, at least 2")
        left, right = np.split(np.frombuffer(raw, np.uint8, samples, len(raw) - samples), 2)
        slant_range_m = self._slant_range_m(place, raw)
        position = _position(*struct.unpack_from("<2i", raw, layout.east))
        (time_ms,) = struct.unpack_from("<i", raw, layout.time_ms)
        (speed_kn,) = struct.unpack_from("<f", raw, layout.speed)
        (course_rad,) = struct.unpack_from("<f", raw, layout.course)
        (heading_rad,) = struct.unpack_from("<f", raw, layout.heading)
        return Ping(
            number=struct.unpack_from("<I", raw, layout.index)[0],
            time_utc_s=self._started_s + time_ms / 1000,
            channels=(
                ChannelPing(Side.PORT, left[::-1].copy(), slant_range_m),
                ChannelPing(Side.STARBOARD, right.copy(), slant_range_m),
            ),
            lat_deg=position.lat_deg if position else None,
            lon_deg=position.lon_deg if position else None,
            heading_deg=_angle_deg(heading_rad),
            speed_mps=plausible("speed_mps", speed_kn * KNOT_MPS),
            course_deg=_angle_deg(course_rad),
        )

    def _slant_range_m(self, place: str, raw: bytes) -> float:
        """Return the range of each side, metres."""
        (low_ft,) = struct.unpack_from("<f", raw, self._layout.min_range)
        (high_ft,) = struct.unpack_from("<f", raw, self._layout.max_range)
        if not 0 < high_ft * _FOOT_M <= MAX_SLANT_RANGE_M:  # includes NaN
            raise self._file.error(f"{place}, maximum range", high_ft, f"up to {MAX_SLANT_RANGE_M} m, in feet")
        if not (low_ft == 0 or math.isclose(low_ft, -high_ft, rel_tol=1e-3)):
            raise self._file.error(f"{place}, minimum range", low_ft, f"0 or {-high_ft}")
        return float(high_ft * _FOOT_M)


def _angle_deg(angle_rad: float) -> float | None:
    """Return an angle of 0 to 360 degrees; None if it is exactly 0 or implausible."""
    if angle_rad == 0 or not abs(angle_rad) <= _MAX_ANGLE_RAD:  # includes NaN
        return None
    return math.degrees(angle_rad) % 360 % 360  # a tiny negative angle gives 360 the first time


def _position(east_m: int, north_m: int) -> Position | None:
    """Return the position of coordinates on the Mercator map; None without a fix or beyond the map."""
    if (east_m, north_m) == (0, 0):
        return None
    lat_rad = 2 * math.atan(math.exp(north_m / _RADIUS_M)) - math.pi / 2
    return position_in_degrees(math.degrees(lat_rad), math.degrees(east_m / _RADIUS_M))
