"""Reader of Klein SDF recordings: the side-scan pages of UUV-3500 sonars, low (3501) and high frequency (3502).

The layout is that of two open readers that agree; no recording of a sonar was read. [N] is Neptus of LSTS (`SdfHeader`,
`SdfData`, `SdfParser`, `SdfSidescanParser`), [O] the Octave reader of OceanScan (oceanscan/octave-sss, `sdf_reader.m`).
A file is a sequence of pages: u32 0xFFFFFFFF, u32 number of bytes after the marker, u32 page version, and the rest of a
header of 512 bytes without the marker [N, O]. Then each side follows, port before starboard: u32 number of samples, u32
samples [N, O], nearest first [N]. The rest of a page, such as the SDFX extension, is skipped [N, O]. All values are
little endian. Offsets from the marker:

* 16 u32 ping number, 20 u32 samples of a side, 32 u32 range in metres, 36 u32 speed in cm/s [N, O].
* 72 u32 year, 76 month, 80 day, 84 hour, 88 minute, 92 second; 220 f32 fraction of the second [N, O].
* 140 f32 heading in degrees, 148 f64 latitude and 156 f64 longitude in radians [N, O]: the names are those of a ship,
  the values those of the vehicle that carries the sonar. [N] describes the heading as course over ground.
* 184 u32 size of the header [N].
* 200 f32 pitch and 204 f32 roll in degrees, 208 f32 depth and 212 f32 altitude in metres [N, O].
* 408 u32 frequency in kHz [N, O].

Conversions and assumptions:

* Pings are those of the page version with the most pages, of equal ones the lowest. Channels of the other with the same
  ping number follow its own in the ping. Pages of other versions are skipped.
* The slant range is the range of the header. The clock of the recorder counts as UTC.
* A heading, altitude, depth or speed of exactly 0, and pitch and roll that are both 0, were not recorded.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from sonarpost.sonar.navigation import PingCounter, is_plausible, position_in_degrees
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers.open_file import CheckedFile, SequentialReader
from sonarpost.sonar.source import StreamedSource
from sonarpost.sonar.survey import MAX_SLANT_RANGE_M, ChannelPing, Ping, Side

MARKER: Final = b"\xff\xff\xff\xff"
HEADER_BYTES: Final = 512
MAX_PAGE_BYTES: Final = 1 << 24
SIDE_SCAN_PAGES: Final = (3501, 3502)

_START: Final = struct.Struct("<4sII")
_DATA: Final = len(MARKER) + HEADER_BYTES
"""Offset of the samples from the marker."""
_FREQUENCIES_KHZ: Final = (10, 10_000)
_HELD_PAGES: Final = 8


@dataclass(frozen=True, slots=True)
class _Page:
    """A side-scan page: version, ping number, header from the marker, and the channels, port first."""

    version: int
    number: int
    place: str
    head: bytes
    channels: tuple[ChannelPing, ...]


class SdfSource(StreamedSource):
    """An open SDF recording.

    A file that ends inside its last page, as after a power failure, is read up to there with a warning. The cut page
    may not be longer than the longest one before it.

    Raises:
        SurveyFileError: Not an SDF file, damaged, without a page of a version that is read, or unreadable.
    """

    def __init__(self, path: Path, options: SurveyOptions) -> None:
        super().__init__(path, options)
        self._file = CheckedFile(path)
        self._notes: Counter[str] = Counter()
        self._without_fix, self._without_heading = PingCounter(), PingCounter()
        self._pings = 0
        self._cut = ""
        try:
            self._version = self._main_version()
            self._validate("Klein", path.stem)
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _format_warnings(self) -> list[str]:
        warnings = [self._cut] if self._cut else []
        warnings += [f"{text} ({count} times)" for text, count in sorted(self._notes.items())]
        texts = ((self._without_fix, "no position fix in"), (self._without_heading, "no heading in"))
        return warnings + [f"{text} {counter.summary(self._pings)}" for counter, text in texts if counter.count]

    def _main_version(self) -> int:
        """Return the page version with the most pages, of those that are read.

        Raises:
            SurveyFileError: The file is damaged, or contains only pages of other versions.
        """
        counts = Counter(version for _, version, _ in self._raw_pages(with_content=False))
        found = [version for version in SIDE_SCAN_PAGES if counts[version]]
        if not found:
            others = ", ".join(f"{version} ({count} times)" for version, count in counts.most_common(6)) or "none"
            expected = "3501 or 3502, the side-scan pages of UUV-3500 sonars; pages of other versions are not read"
            raise self._file.error("page version", others, expected)
        return max(found, key=lambda version: (counts[version], -version))

    def _raw_pages(self, *, with_content: bool) -> Iterator[tuple[str, int, bytes]]:
        """Yield place, version and content from the marker of every complete page; content only of side-scan pages.

        Raises:
            SurveyFileError: The file is damaged.
        """
        reader = SequentialReader(self._file)
        longest = 0
        while remaining := reader.remaining:
            place = f"page at byte {reader.offset}"
            start = reader.read(min(_START.size, remaining), place)
            if start[: len(MARKER)] != MARKER[: len(start)]:
                raise self._file.error(f"{place}, marker", start[: len(MARKER)].hex(), MARKER.hex())
            _, size, version = _START.unpack(start.ljust(_START.size, b"\0"))
            rest = len(MARKER) + size - _START.size
            if len(start) == _START.size and not 0 <= rest <= MAX_PAGE_BYTES:
                expected = f"{_START.size - len(MARKER)} to {MAX_PAGE_BYTES} bytes"
                raise self._file.error(f"{place}, number of bytes", size, expected)
            if rest > reader.remaining or len(start) < _START.size:
                if size <= longest:
                    self._cut = (
                        f"the file ends inside its last page, as after a power failure: {remaining} bytes are left out"
                    )
                    return
                reader.read(max(rest, reader.remaining + 1), place)  # raises the error of a truncated file
            longest = max(longest, size)
            if with_content and version in SIDE_SCAN_PAGES:
                yield place, version, start + reader.read(rest, place)
            else:
                reader.offset += rest
                yield place, version, b""

    def _read_pings(self, *, first_pass: bool) -> Iterator[Ping]:
        notes = self._notes if first_pass else Counter[str]()
        row = 0
        for page, other in self._paired(notes):
            ping = self._ping(page, other)
            if first_pass:
                if ping.lat_deg is None:
                    self._without_fix.add(row)
                if ping.heading_deg is None:
                    self._without_heading.add(row)
            row += 1
            yield ping
        self._pings = row
        self._file.check_unchanged()

    def _paired(self, notes: Counter[str]) -> Iterator[tuple[_Page, _Page | None]]:
        """Yield the pages of the main version, each with the page of the other one of the same ping number."""
        current: _Page | None = None
        others: dict[int, _Page] = {}

        def leave_out(page: _Page) -> None:
            notes[f"left out page of version {page.version}: none left of its number in version {self._version}"] += 1

        for page in self._pages(notes):
            if page.version == self._version:
                if current is not None:
                    yield current, others.pop(current.number, None)
                current = page
                continue
            if page.number in others:
                leave_out(page)
                continue
            others[page.number] = page
            if len(others) > _HELD_PAGES:
                leave_out(others.pop(next(iter(others))))
        if current is not None:
            yield current, others.pop(current.number, None)
        for page in others.values():
            leave_out(page)

    def _pages(self, notes: Counter[str]) -> Iterator[_Page]:
        """Yield the side-scan pages with at least one channel."""
        for place, version, raw in self._raw_pages(with_content=True):
            if version not in SIDE_SCAN_PAGES:
                notes[f"skipped page of version {version}: not side-scan of a UUV-3500 sonar (3501, 3502)"] += 1
                continue
            if len(raw) < _DATA:
                expected = f"at least {HEADER_BYTES} for page version {version}"
                raise self._file.error(f"{place}, number of bytes", len(raw) - len(MARKER), expected)
            (header_bytes,) = struct.unpack_from("<I", raw, 184)
            if header_bytes != HEADER_BYTES:
                raise self._file.error(f"{place}, size of the header", header_bytes, str(HEADER_BYTES))
            channels = self._channels(place, raw, notes)
            if channels:
                (number,) = struct.unpack_from("<I", raw, 16)
                yield _Page(version, number, place, raw[:_DATA], channels)

    def _channels(self, place: str, raw: bytes, notes: Counter[str]) -> tuple[ChannelPing, ...]:
        """Return the sides of a page; none if its header contradicts them."""
        want, range_m = struct.unpack_from("<I8xI", raw, 20)
        (frequency_khz,) = struct.unpack_from("<I", raw, 408)
        low_khz, high_khz = _FREQUENCIES_KHZ
        frequency_hz = frequency_khz * 1000.0 if low_khz <= frequency_khz <= high_khz else None
        channels = []
        offset = _DATA
        for side in Side:
            words = (len(raw) - offset) // 4
            count = struct.unpack_from("<I", raw, offset)[0] if words > 0 else 0
            if count > max(words - 1, 0):
                raise self._file.error(f"{place}, number of {side.value} samples", count, f"up to {words - 1}")
            if count not in (0, want):
                notes["skipped page: a side has another number of samples than its header"] += 1
                return ()
            if count:
                samples = np.frombuffer(raw, "<u4", count, offset + 4).astype(np.uint32)
                channels.append(ChannelPing(side, samples, float(range_m), frequency_hz))
            offset += 4 + 4 * count
        if not channels or not 0 < range_m <= MAX_SLANT_RANGE_M:
            notes["skipped page: no samples, or impossible range"] += 1
            return ()
        return tuple(channels)

    def _ping(self, page: _Page, other: _Page | None) -> Ping:
        head = page.head
        position = position_in_degrees(*(math.degrees(angle) for angle in struct.unpack_from("<dd", head, 148)))
        (heading_deg,) = struct.unpack_from("<f", head, 140)
        pitch_deg, roll_deg, depth_m, altitude_m = struct.unpack_from("<4f", head, 200)
        attitude_known = pitch_deg != 0 or roll_deg != 0

        def known(name: str, value: float) -> float | None:
            return value if value != 0 and is_plausible(name, value) else None

        return Ping(
            number=page.number,
            time_utc_s=self._time(page),
            channels=page.channels + (other.channels if other else ()),
            lat_deg=position.lat_deg if position else None,
            lon_deg=position.lon_deg if position else None,
            heading_deg=None if known("heading_deg", heading_deg) is None else heading_deg % 360,
            altitude_m=known("altitude_m", altitude_m),
            depth_m=known("depth_m", depth_m),
            speed_mps=known("speed_mps", struct.unpack_from("<I", head, 36)[0] / 100),
            pitch_deg=pitch_deg if attitude_known and is_plausible("pitch_deg", pitch_deg) else None,
            roll_deg=roll_deg if attitude_known and is_plausible("roll_deg", roll_deg) else None,
        )

    def _time(self, page: _Page) -> float:
        """Return the time of a ping, UTC seconds since 1970.

        Raises:
            SurveyFileError: The page has no valid date.
        """
        year, month, day, hour, minute, second = stamp = struct.unpack_from("<6I", page.head, 72)
        (fraction_s,) = struct.unpack_from("<f", page.head, 220)
        try:
            time_s = datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp()
        except (ValueError, OverflowError):
            time_s = -1.0
        if time_s < 0:
            expected = "year from 1970 on, month, day, hour, minute, second"
            raise self._file.error(f"{page.place}, date and time", stamp, expected)
        return time_s + (fraction_s if 0 <= fraction_s < 1 else 0.0)
