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

* A page version is a frequency. Pages of the same ping number and time are one ping, of other versions are skipped.
* The slant range is the range of the header. The clock of the recorder counts as UTC.
* A heading, altitude, depth or speed of exactly 0, and pitch and roll that are both 0, were not recorded.
"""

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Final

import numpy as np
from typing_extensions import override

from sonarpost.sonar.navigation import plausible, plausible_angle, position_in_degrees
from sonarpost.sonar.readers.file_source import FileSource
from sonarpost.sonar.readers.joining import PingPart, joined
from sonarpost.sonar.readers.records import Notes, RecordFormat, records
from sonarpost.sonar.survey import MAX_SLANT_RANGE_M, ChannelPing, Ping, Side

MARKER: Final = b"\xff\xff\xff\xff"
HEADER_BYTES: Final = 512
MAX_PAGE_BYTES: Final = 1 << 24
SIDE_SCAN_PAGES: Final = (3501, 3502)

_START: Final = struct.Struct("<4sII")
_VERSIONS: Final = (1000, 9999)
"""Limits of the page versions; those in use are 3000 to 5004."""
_HEADER_SIZE: Final = 184
"""Offset of the size of the header from the marker."""
_DATA: Final = len(MARKER) + HEADER_BYTES
"""Offset of the samples from the marker."""
_HEADER: Final = re.compile(
    rb"\xff(?=\xff{3}.{3}[\x00\x01](?:[\xad\xae]\x0d\x00\x00.{172}\x00\x02\x00\x00|(?![\xad\xae]\x0d)..\x00\x00))",
    re.DOTALL,
)
"""Marker, possible number of bytes and version, and of side-scan pages (0x0DAD, 0x0DAE) the size of the header."""
_FREQUENCIES_KHZ: Final = (10, 10_000)
_SAME_PING_S: Final = 0.1
"""Maximum difference of the times of the pages of a ping; pings that are closer have different numbers."""
_HELD_PINGS: Final = 8


class _Page(RecordFormat):
    name = "page"
    magic = MARKER
    head_bytes = _HEADER_SIZE + 4
    min_head_bytes = _START.size

    @override
    def length(self, head: bytes, offset: int) -> int:
        marker, size, version = _START.unpack_from(head)
        least = HEADER_BYTES if version in SIDE_SCAN_PAGES else _START.size - len(MARKER)
        valid = marker == MARKER and _VERSIONS[0] <= version <= _VERSIONS[1] and least <= size <= MAX_PAGE_BYTES
        return len(MARKER) + size if valid else 0

    @override
    def candidates(self, data: bytes, offset: int) -> Iterator[int]:
        """Yield the indices of headers: samples may have the value of the marker, if they are saturated."""
        return (found.start() for found in _HEADER.finditer(data))

    @override
    def is_proved(self, raw: bytes) -> bool:
        """Return whether it is a side-scan page with as many samples as its header states."""
        _, _, version = _START.unpack_from(raw)
        if version not in SIDE_SCAN_PAGES or len(raw) < _DATA + 8:
            return False
        want, header_bytes, port = (struct.unpack_from("<I", raw, at)[0] for at in (20, _HEADER_SIZE, _DATA))
        after = _DATA + 4 + 4 * port
        if header_bytes != HEADER_BYTES or port not in (0, want) or after + 4 > len(raw):
            return False
        (starboard,) = struct.unpack_from("<I", raw, after)
        return starboard in (0, want) and after + 4 + 4 * starboard <= len(raw)


_PAGE: Final = _Page()


class SdfSource(FileSource):
    """An open SDF recording.

    Raises:
        SurveyFileError: Not an SDF file, without a page of a version that is read, or unreadable.
    """

    SONAR = "Klein"

    @override
    def _stored_pings(self, notes: Notes) -> Iterator[Ping]:
        for part in joined(self._parts(notes), max_gap_s=_SAME_PING_S, held_pings=_HELD_PINGS):
            yield _ping(part)

    def _parts(self, notes: Notes) -> Iterator[PingPart[bytes]]:
        """Yield the side-scan pages with at least one channel.

        Raises:
            SurveyFileError: The file has only pages of other versions.
        """
        versions: Counter[int] = Counter()
        for place, _, raw in records(self._file, _PAGE, 0, notes):
            _, _, version = _START.unpack_from(raw)
            versions[version] += 1
            if version not in SIDE_SCAN_PAGES:
                notes.add(f"skipped page of version {version}: not side-scan of a UUV-3500 sonar (3501, 3502)")
                continue
            with notes.leaving_out(place):
                channels = self._channels(place, raw, SIDE_SCAN_PAGES.index(version), notes)
                if channels:
                    (number,) = struct.unpack_from("<I", raw, 16)
                    yield PingPart(number, self._time(place, raw), raw[:_DATA], channels)
        if versions and versions.keys().isdisjoint(SIDE_SCAN_PAGES):
            others = ", ".join(f"{version} ({count} times)" for version, count in versions.most_common(6))
            expected = "3501 or 3502, the side-scan pages of UUV-3500 sonars; pages of other versions are not read"
            raise self._file.error("page version", others, expected)

    def _channels(self, place: str, raw: bytes, index: int, notes: Notes) -> tuple[ChannelPing, ...]:
        """Return the sides of a page; none if its header contradicts them.

        Raises:
            SurveyFileError: The page has another header, or is shorter than its samples.
        """
        (header_bytes,) = struct.unpack_from("<I", raw, _HEADER_SIZE)
        if header_bytes != HEADER_BYTES:
            raise self._file.error(f"{place}, size of the header", header_bytes, str(HEADER_BYTES))
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
                notes.add("skipped page: a side has another number of samples than its header")
                return ()
            if count:
                samples = np.frombuffer(raw, "<u4", count, offset + 4).astype(np.uint32)
                channels.append(ChannelPing(side, samples, float(range_m), frequency_hz, index=index))
            offset += 4 + 4 * count
        if not channels or not 0 < range_m <= MAX_SLANT_RANGE_M:
            notes.add("skipped page: no samples, or impossible range")
            return ()
        return tuple(channels)

    def _time(self, place: str, head: bytes) -> float:
        """Return the time of a ping, UTC seconds since 1970.

        Raises:
            SurveyFileError: The page has no valid date.
        """
        year, month, day, hour, minute, second = stamp = struct.unpack_from("<6I", head, 72)
        (fraction_s,) = struct.unpack_from("<f", head, 220)
        try:
            time_s = datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp()
        except (ValueError, OverflowError):
            time_s = -1.0
        if time_s < 0:
            expected = "year from 1970 on, month, day, hour, minute, second"
            raise self._file.error(f"{place}, date and time", stamp, expected)
        return time_s + (fraction_s if 0 <= fraction_s < 1 else 0.0)


def _ping(part: PingPart[bytes]) -> Ping:
    head = part.head
    position = position_in_degrees(*(math.degrees(angle) for angle in struct.unpack_from("<dd", head, 148)))
    (heading_deg,) = struct.unpack_from("<f", head, 140)
    pitch_deg, roll_deg, depth_m, altitude_m = struct.unpack_from("<4f", head, 200)
    attitude_known = pitch_deg != 0 or roll_deg != 0

    def known(name: str, value: float) -> float | None:
        return plausible(name, value) if value != 0 else None

    return Ping(
        number=part.number,
        time_utc_s=part.time_utc_s,
        channels=part.channels,
        lat_deg=position.lat_deg if position else None,
        lon_deg=position.lon_deg if position else None,
        heading_deg=plausible_angle(heading_deg) if heading_deg != 0 else None,
        altitude_m=known("altitude_m", altitude_m),
        depth_m=known("depth_m", depth_m),
        speed_mps=known("speed_mps", struct.unpack_from("<I", head, 36)[0] / 100),
        pitch_deg=plausible("pitch_deg", pitch_deg) if attitude_known else None,
        roll_deg=plausible("roll_deg", roll_deg) if attitude_known else None,
    )
