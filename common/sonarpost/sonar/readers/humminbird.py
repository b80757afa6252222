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
* The clock of the unit is assumed to be UTC.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.geometry import Position
from sonarpost.sonar.navigation import PingCounter
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers.open_file import CheckedFile, SequentialReader
from sonarpost.sonar.source import StreamedSource
from sonarpost.sonar.survey import ChannelPing, Ping, Side

SAMPLE_SPACING_M: Final = 2 / math.pi * math.asin(1475 / (0.108 * 455_000))

_START: Final = b"\xc0\xde\xab\x21"
_HEADER_END: Final = 0x21
_MAX_HEADER_BYTES: Final = 512
_MAX_SAMPLES: Final = 1 << 16
_NUMBER, _TIME_MS, _EAST, _NORTH, _HEADING, _SPEED, _DEPTH, _FREQUENCY, _SAMPLES = (
    *(0x80, 0x81, 0x82, 0x83, 0x84, 0x85, 0x87, 0x92),
    0xA0,
)
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
_RADIUS_M: Final = 6_378_388.0
_GEODETIC: Final = 1.006_764_292_7
"""Ratio of the tangents of geodetic and geocentric latitude, International 1924: 1 / (1 - e^2)."""


@dataclass(frozen=True, slots=True)
class _Record:
    fields: dict[int, int]
    samples: bytes


class HumminbirdSource(StreamedSource):
    """An open Humminbird recording, given by its DAT file.

    Raises:
        SurveyFileError: The DAT file or both channels are missing, or a file is damaged.
    """

    def __init__(self, path: Path, options: SurveyOptions) -> None:
        super().__init__(path, options)
        self._files: dict[Side, CheckedFile] = {}
        self._started_s = _start_time(path)
        self._spacing_m = options.humminbird_sample_spacing_m or SAMPLE_SPACING_M
        self._without_fix, self._without_heading, self._without_depth = (PingCounter() for _ in range(3))
        self._pings = 0
        self._unpaired = 0
        paths = {side: channel for side, name in _SIDES.items() if (channel := _channel_path(path, name)) is not None}
        if not paths:
            expected = f"B002.SON or B003.SON in {path.with_suffix('')}"
            raise SurveyFileError(str(path), "side-scan channels", "none", expected)
        try:
            for side, channel in paths.items():
                self._files[side] = CheckedFile(channel)
            self._validate("Humminbird", path.stem)
        except BaseException:
            self.close()
            raise

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

    def close(self) -> None:
        """Close the channels."""
        for file in self._files.values():
            file.close()

    def _format_warnings(self) -> list[str]:
        warnings = []
        if self.options.humminbird_sample_spacing_m is None:
            warnings.append(
                f"slant range is not recorded: assuming {self._spacing_m:.4f} m a sample "
                "(option humminbird_sample_spacing_m)"
            )
        if len(self._files) == 1:
            warnings.append(f"only the file of {next(iter(self._files)).value} exists")
        elif self._unpaired:
            warnings.append(f"only one side in {self._unpaired} of {self._pings} pings")
        texts: tuple[tuple[PingCounter, str], ...] = (
            (self._without_fix, "no position fix in"),
            (self._without_heading, "no heading in"),
            (self._without_depth, "no depth under the transducer in"),
        )
        if not self.options.humminbird_depth_as_altitude:
            warnings.append("echo sounder depth not used as altitude (option humminbird_depth_as_altitude)")
            texts = texts[:2]
        return warnings + [f"{text} {counter.summary(self._pings)}" for counter, text in texts if counter.count]

    def _read_pings(self, *, first_pass: bool) -> Iterator[Ping]:
        row = 0
        for time_ms, channels in self._paired_records():
            ping = self._ping(time_ms, channels)
            if first_pass:
                self._count_missing(row, ping)
            row += 1
            yield ping
        self._pings = row
        for file in self._files.values():
            file.check_unchanged()

    def _count_missing(self, row: int, ping: Ping) -> None:
        for value, counter in (
            (ping.lat_deg, self._without_fix),
            (ping.heading_deg, self._without_heading),
            (ping.altitude_m, self._without_depth),
        ):
            if value is None:
                counter.add(row)
        self._unpaired += len(ping.channels) == 1

    def _paired_records(self) -> Iterator[tuple[int, dict[Side, _Record]]]:
        """Yield time and records of both sides; records of the same time are combined."""
        records = {side: _records(file) for side, file in self._files.items()}
        current = {side: next(iterator, None) for side, iterator in records.items()}
        while present := {side: record for side, record in current.items() if record is not None}:
            time_ms = min(record.fields[_TIME_MS] for record in present.values())
            paired = {side: record for side, record in present.items() if record.fields[_TIME_MS] == time_ms}
            for side in paired:
                current[side] = next(records[side], None)
            yield time_ms, paired

    def _ping(self, time_ms: int, records: dict[Side, _Record]) -> Ping:
        fields = next(iter(records.values())).fields
        position = _position(fields)
        heading_valid, heading = divmod(fields.get(_HEADING, 0), 1 << 16)
        speed_valid, speed = divmod(fields.get(_SPEED, 0), 1 << 16)
        depth_m = fields.get(_DEPTH, 0) / 10 if self.options.humminbird_depth_as_altitude else 0.0
        channels = tuple(
            ChannelPing(
                side=side,
                samples=np.frombuffer(record.samples, np.uint8),
                slant_range_m=len(record.samples) * self._spacing_m,
                frequency_hz=float(record.fields.get(_FREQUENCY, 0)) or None,
            )
            for side, record in records.items()
        )
        return Ping(
            number=fields[_NUMBER],
            time_utc_s=self._started_s + time_ms / 1000,
            channels=channels,
            lat_deg=position.lat_deg if position else None,
            lon_deg=position.lon_deg if position else None,
            heading_deg=heading / 10 % 360 if heading_valid and heading <= 3600 else None,
            altitude_m=depth_m if 0 < depth_m < 1000 else None,
            speed_mps=speed / 10 if speed_valid and speed <= 500 else None,
        )


def _records(file: CheckedFile) -> Iterator[_Record]:
    """Yield the pings of one channel.

    Raises:
        SurveyFileError: The file is damaged or ends inside a ping.
    """
    reader = SequentialReader(file)
    number = 0
    while reader.remaining:
        place = f"ping {number} at byte {reader.offset}"
        start = reader.read(len(_START), place)
        if start != _START:
            raise file.error(f"{place}, start", start, f"{_START!r}")
        fields = _header_fields(reader, file, place)
        count = fields[_SAMPLES]
        if not 1 <= count <= _MAX_SAMPLES:
            raise file.error(f"{place}, number of samples", count, f"1 to {_MAX_SAMPLES}")
        yield _Record(fields, reader.read(count, place))
        number += 1


def _header_fields(reader: SequentialReader, file: CheckedFile, place: str) -> dict[int, int]:
    """Read the fields of a header up to its end."""
    fields: dict[int, int] = {}
    first = reader.offset
    while reader.offset - first < _MAX_HEADER_BYTES:
        tag = reader.read(1, place)[0]
        if tag < 0x40:
            raise file.error(f"{place}, tag", hex(tag), "a field of the header, 0x40 to 0xff")
        width = 4 if tag & 0x80 else 1
        fields[tag] = int.from_bytes(reader.read(width, place), "big")
        if tag == _SAMPLES:
            end = reader.read(1, place)[0]
            if end != _HEADER_END:
                raise file.error(f"{place}, end of the header", hex(end), hex(_HEADER_END))
            missing = [hex(each) for each in (_NUMBER, _TIME_MS) if each not in fields]
            if missing:
                raise file.error(f"{place}, fields", f"no {', '.join(missing)}", "record number and time")
            return fields
    raise file.error(f"{place}, header", f"over {_MAX_HEADER_BYTES} bytes", "the number of samples at its end")


def _position(fields: dict[int, int]) -> Position | None:
    """Return the position of coordinates on the recorder's Mercator map; None without a fix."""
    east_m, north_m = (_signed(fields.get(tag, 0)) for tag in (_EAST, _NORTH))
    if (east_m, north_m) == (0, 0) or abs(east_m) > math.pi * _RADIUS_M or abs(north_m) > 3 * _RADIUS_M:
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
