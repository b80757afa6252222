"""Reader of Humminbird recordings: `NAME.DAT` and, in the folder `NAME` beside it, `B002.SON` (port) and `B003.SON`.

The layout is that of the recording in PyHum's source distribution and of the published descriptions of PyHum and
PING-Mapper. A ping begins with C0 DE AB 21. Fields follow, each a tag and a big-endian value of four bytes (tags from
0x80) or one byte (tags 0x40 to 0x7F). The tag A0 contains the number of samples and, with a byte 21, ends the header.
Headers of 67, 72 and 152 bytes are known; all are read by their tags. Samples are bytes, nearest first. A DAT file of
96 or 100 bytes is that of the SOLIX series, with a little-endian date (published description; no recording was read).

Assumptions where the format is incomplete:

* **Slant range is not recorded.** One sample is assumed to be 2 theta / pi metres with theta = asin(c / (L f)),
  L = 0.108 m, f = 455 kHz, c = 1475 m/s, as in PyHum: 0.0191 m. The option `humminbird_sample_spacing_m` overrides it.
* Positions are metres of a Mercator map on the equatorial radius of the International 1924 ellipsoid with geocentric
  latitude (PyHum's conversion).
* The depth is that of the echo sounder under the transducer. The sounder may lose the bottom and continue to record
  values, as in the last third of PyHum's recording. The depth is therefore used as altitude only with the option
  `humminbird_depth_as_altitude`; by default the altitude comes from bottom tracking.
* The clock of the unit is assumed to be UTC. Pings of both sides with the same time are one.
"""

from __future__ import annotations

import heapq
import math
import struct
from collections import deque
from collections.abc import Iterator
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np
from typing_extensions import override

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.geometry import Position
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers.file_source import FileSource
from sonarpost.sonar.readers.joining import PingPart, joined
from sonarpost.sonar.readers.open_file import CheckedFile
from sonarpost.sonar.readers.records import Notes, RecordFormat, records
from sonarpost.sonar.survey import ChannelPing, Ping, Side

SAMPLE_SPACING_M: Final = 2 / math.pi * math.asin(1475 / (0.108 * 455_000))

_START: Final = b"\xc0\xde\xab\x21"
_HEADER_END: Final = b"\x21"
_MIN_HEADER_BYTES: Final = 20
_MAX_HEADER_BYTES: Final = 512
_MAX_SAMPLES: Final = 1 << 16
_NUMBER, _TIME_MS, _EAST, _NORTH, _HEADING, _SPEED, _DEPTH, _FREQUENCY, _SAMPLES = (
    *(0x80, 0x81, 0x82, 0x83, 0x84, 0x85, 0x87, 0x92),
    0xA0,
)
_MIN_TAG: Final = 0x40
_SIDES: Final = {Side.PORT: "B002.SON", Side.STARBOARD: "B003.SON"}
_CHANNEL_SUFFIXES: Final = (".son", ".idx")
_DAT_MAGICS: Final = (0xC1, 0xC3)
_DAT_BYTES: Final = 24
_DAT_TIME_OFFSET: Final = 20
_SOLIX_DAT_BYTES: Final = (96, 100)
"""Sizes of the DAT files of the SOLIX series, which are little endian and have no known first byte."""
_SOLIX_TIMES_S: Final = (946_684_800, 4_102_444_800)
"""2000 to 2100."""
_MAX_DAT_BYTES: Final = 1 << 16
_NO_DEPTH: Final = "no depth under the transducer"
_RADIUS_M: Final = 6_378_388.0
_GEODETIC: Final = 1.006_764_292_7
"""Ratio of the tangents of geodetic and geocentric latitude, International 1924: 1 / (1 - e^2)."""


class _PingFormat(RecordFormat):
    """Pings of one channel."""

    magic = _START
    head_bytes = _MAX_HEADER_BYTES
    min_head_bytes = _MIN_HEADER_BYTES

    def __init__(self, file_name: str) -> None:
        self.name = f"ping of {file_name}"

    @override
    def length(self, head: bytes, offset: int) -> int:
        fields, header_bytes = _header(head)
        return header_bytes + fields[_SAMPLES] if header_bytes else 0


class HumminbirdSource(FileSource):
    """An open Humminbird recording, given by its DAT file.

    Raises:
        SurveyFileError: The DAT file is missing or damaged, or both channels are missing or have no ping.
    """

    SONAR = "Humminbird"

    def __init__(self, path: Path, options: SurveyOptions) -> None:
        self._spacing_m = options.humminbird_sample_spacing_m or SAMPLE_SPACING_M
        self._unpaired = 0
        super().__init__(path, options)

    @override
    def _data_files(self) -> tuple[Path, ...]:
        self._started_s = _start_time(self.path)
        paths = {side: found for side, name in _SIDES.items() if (found := _channel_path(self.path, name)) is not None}
        if not paths:
            expected = f"B002.SON or B003.SON in {self.path.with_suffix('')}"
            raise SurveyFileError(str(self.path), "side-scan channels", "none", expected)
        self._sides = tuple(paths)
        return tuple(paths.values())

    @staticmethod
    def parts(path: Path) -> tuple[Path, ...]:
        """Return the DAT file, the files of both sides, and the other channels and indices that exist.

        Raises:
            OSError: The folder cannot be read.
        """
        folder = path.with_suffix("")
        sides = [_channel_path(path, name) or folder / name for name in _SIDES.values()]
        try:
            others = sorted(each for each in folder.iterdir() if each.suffix.lower() in _CHANNEL_SUFFIXES)
        except (FileNotFoundError, NotADirectoryError):
            others = []
        return (path, *sides, *others)

    @override
    def _format_warnings(self) -> list[str]:
        warnings = []
        if self.options.humminbird_sample_spacing_m is None:
            warnings.append(
                f"slant range is not recorded: assuming {self._spacing_m:.4f} m a sample "
                "(option humminbird_sample_spacing_m)"
            )
        if len(self._files) == 1:
            warnings.append(f"only the file of {self._sides[0].value} exists")
        elif self._unpaired:
            warnings.append(f"only one side in {self._unpaired} of {self._pings} pings")
        if not self.options.humminbird_depth_as_altitude:
            warnings.append("echo sounder depth not used as altitude (option humminbird_depth_as_altitude)")
        return [*warnings, *super()._format_warnings(), *self._notes.pings.lines(self._pings, [_NO_DEPTH])]

    @override
    def _stored_pings(self, notes: Notes) -> Iterator[Ping]:
        channels = [self._parts(side, file, notes) for side, file in zip(self._sides, self._files, strict=True)]
        parts = heapq.merge(*channels, key=lambda part: part.time_utc_s)
        for row, part in enumerate(joined(parts, max_gap_s=0.0, by_number=False)):
            ping = self._ping(part)
            if notes is self._notes:  # the first pass
                self._unpaired += len(ping.channels) == 1
            if self.options.humminbird_depth_as_altitude and ping.altitude_m is None:
                notes.pings.add(_NO_DEPTH, row)
            yield ping

    def _parts(self, side: Side, file: CheckedFile, notes: Notes) -> Iterator[PingPart[dict[int, int]]]:
        """Yield the pings of one channel, without those whose time is not between the times before and after."""
        found = records(file, _PingFormat(file.path.name), 0, notes)
        parsed = ((place, raw, *_header(raw[:_MAX_HEADER_BYTES])) for place, _, raw in found)
        ahead = deque(islice(parsed, 3))  # with two that follow: one of them may be wrong
        before_ms = 0
        while ahead:
            place, raw, fields, header_bytes = ahead.popleft()
            time_ms = fields[_TIME_MS]
            after_ms = max((following[_TIME_MS] for _, _, following, _ in ahead), default=math.inf)
            ahead.extend(islice(parsed, 1))
            with notes.leaving_out(place):
                if before_ms <= after_ms and not before_ms <= time_ms <= after_ms:  # else the clock was set back
                    raise file.error(f"{place}, time", time_ms, f"{before_ms} to {after_ms} ms, as before and after it")
                before_ms = time_ms
                channel = ChannelPing(
                    side=side,
                    samples=np.frombuffer(raw, np.uint8, offset=header_bytes),
                    slant_range_m=(len(raw) - header_bytes) * self._spacing_m,
                    frequency_hz=float(fields.get(_FREQUENCY, 0)) or None,
                )
                yield PingPart(fields[_NUMBER], self._started_s + time_ms / 1000, fields, (channel,))

    def _ping(self, part: PingPart[dict[int, int]]) -> Ping:
        fields = part.head
        position = _position(fields)
        heading_valid, heading = divmod(fields.get(_HEADING, 0), 1 << 16)
        speed_valid, speed = divmod(fields.get(_SPEED, 0), 1 << 16)
        depth_m = fields.get(_DEPTH, 0) / 10 if self.options.humminbird_depth_as_altitude else 0.0
        return Ping(
            number=part.number,
            time_utc_s=part.time_utc_s,
            channels=part.channels,
            lat_deg=position.lat_deg if position else None,
            lon_deg=position.lon_deg if position else None,
            heading_deg=heading / 10 % 360 if heading_valid and heading <= 3600 else None,
            altitude_m=depth_m if 0 < depth_m < 1000 else None,
            speed_mps=speed / 10 if speed_valid and speed <= 500 else None,
        )


@lru_cache(maxsize=8)
def _header(head: bytes) -> tuple[dict[int, int], int]:
    """Return the fields of a header by their tags, and its size in bytes; a size of 0 if `head` does not begin one."""
    fields: dict[int, int] = {}
    place = len(_START)
    while head.startswith(_START) and place < len(head):
        tag = head[place]
        end = place + (5 if tag & 0x80 else 2)
        if tag < _MIN_TAG or end > len(head):
            break
        fields[tag] = int.from_bytes(head[place + 1 : end], "big")
        place = end
        if tag == _SAMPLES:
            is_end = head[place : place + 1] == _HEADER_END and 1 <= fields[tag] <= _MAX_SAMPLES
            return fields, place + 1 if is_end and {_NUMBER, _TIME_MS} <= fields.keys() else 0
    return fields, 0


def _position(fields: dict[int, int]) -> Position | None:
    """Return the position of coordinates on the recorder's Mercator map; None without a fix."""
    east_m, north_m = (_signed(fields.get(tag, 0)) for tag in (_EAST, _NORTH))
    if (east_m, north_m) == (0, 0) or abs(east_m) > 2 * math.pi * _RADIUS_M or abs(north_m) > 3 * _RADIUS_M:
        return None
    geocentric = 2 * math.atan(math.exp(north_m / _RADIUS_M)) - math.pi / 2
    lat_deg = math.degrees(math.atan(math.tan(geocentric) * _GEODETIC))
    return Position(lat_deg, (math.degrees(east_m / _RADIUS_M) + 180) % 360 - 180)


def _signed(value: int) -> int:
    return value - (1 << 32) if value >= 1 << 31 else value


def _start_time(path: Path) -> float:
    """Return the start of a recording, UTC seconds since 1970, from its DAT file."""
    with CheckedFile(path) as file:
        if not _DAT_BYTES <= file.size_bytes <= _MAX_DAT_BYTES:
            raise file.error("file size", file.size_bytes, f"{_DAT_BYTES} to {_MAX_DAT_BYTES} bytes")
        raw = file.read_at(0, _DAT_BYTES, "header")
        if file.size_bytes in _SOLIX_DAT_BYTES:
            (started_s,) = struct.unpack_from("<I", raw, _DAT_TIME_OFFSET)
            low_s, high_s = _SOLIX_TIMES_S
            if not low_s <= started_s <= high_s:
                raise file.error("time", started_s, f"seconds since 1970, {low_s} to {high_s}")
            return float(started_s)
        if raw[0] not in _DAT_MAGICS:
            raise file.error("first byte", hex(raw[0]), " or ".join(hex(magic) for magic in _DAT_MAGICS))
        (started_s,) = struct.unpack_from(">I", raw, _DAT_TIME_OFFSET)
        if started_s == 0:
            raise file.error("time", 0, "seconds since 1970 (the ONIX series has no date and is not supported)")
        return float(started_s)


def _channel_path(path: Path, name: str) -> Path | None:
    """Return the file of a channel in the folder named like the DAT file, in upper or lower case."""
    folder = path.with_suffix("")
    for spelling in (name, name.lower()):
        if (folder / spelling).exists():
            return folder / spelling
    return None
