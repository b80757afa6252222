"""Reader of Humminbird recordings: `NAME.DAT` and, in the folder `NAME` beside it, `B002.SON` (port) and `B003.SON`.

Layout, as found in the recording of PyHum's source distribution and in the published descriptions of PyHum and
PING-Mapper: a ping begins with C0 DE AB 21; then come fields, each a tag and a big-endian value of four bytes (tags
from 0x80) or one (tags 0x40 to 0x7F); the tag A0 holds the number of samples and, with a byte 21, ends the header.
Headers of 67, 72 and 152 bytes are known; walking by tags reads all of them. Samples are bytes, nearest first.

What the format leaves open, and what is done about it:

* **Slant range is not recorded.** One sample is taken as 2 theta / pi metres with theta = asin(c / (L f)), L = 0.108 m,
  f = 455 kHz, c = 1475 m/s, as PyHum does: 0.0191 m. `humminbird_sample_spacing_m` of the options overrides it.
* Positions are metres of a Mercator map on the International 1924 ellipsoid's equatorial radius whose latitude is
  geocentric (PyHum's conversion).
* The depth is the echo sounder's, under the transducer. It would be the altitude, but the sounder loses the bottom for
  minutes and goes on giving figures (it does so in the last third of PyHum's recording), so the altitude is left to
  the picture unless `humminbird_depth_as_altitude` of the options says otherwise.
* The clock is the unit's own; it is taken as UTC.
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
from sonarpost.sonar.navigation import NavigationRows
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
_DAT_MAGICS: Final = (0xC1, 0xC3)
_DAT_BYTES: Final = 24
_DAT_TIME_OFFSET: Final = 20
_MAX_DAT_BYTES: Final = 1 << 16
_RADIUS_M: Final = 6_378_388.0
_GEODETIC: Final = 1.006_764_292_7
"""Tangent of the geodetic latitude over that of the geocentric one, International 1924: 1 / (1 - e^2)."""


@dataclass(frozen=True, slots=True)
class _Record:
    fields: dict[int, int]
    samples: bytes
    place: str


class HumminbirdSource(StreamedSource):
    """An open Humminbird recording, found by its DAT file.

    Raises:
        SurveyFileError: The DAT file or both channels are missing, or a file is damaged; the message names it.
    """

    def __init__(self, path: Path, options: SurveyOptions) -> None:
        super().__init__(path, options)
        self._files: dict[Side, CheckedFile] = {}
        self._started_s = _start_time(path)
        self._spacing_m = options.humminbird_sample_spacing_m or SAMPLE_SPACING_M
        self._without_fix, self._without_heading, self._without_depth = (
            NavigationRows(),
            NavigationRows(),
            NavigationRows(),
        )
        self._pings = 0
        self._unpaired = 0
        found = {side: channel for side, name in _SIDES.items() if (channel := _beside(path, name)) is not None}
        if not found:
            expected = f"B002.SON or B003.SON in {path.with_suffix('')}"
            raise SurveyFileError(str(path), "side-scan channels", "none", expected)
        try:
            for side, channel in found.items():
                self._files[side] = CheckedFile(channel)
            self._scan("Humminbird", path.stem)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the channels."""
        for file in self._files.values():
            file.close()

    def _notes(self) -> list[str]:
        notes = []
        if self.options.humminbird_sample_spacing_m is None:
            notes.append(
                f"slant range is not recorded: {self._spacing_m:.4f} m a sample are assumed "
                "(humminbird_sample_spacing_m of the options)"
            )
        if len(self._files) == 1:
            notes.append(f"the file of the other side than {next(iter(self._files)).value} is missing")
        elif self._unpaired:
            notes.append(f"only one side in {self._unpaired} of {self._pings} pings")
        texts: tuple[tuple[NavigationRows, str], ...] = (
            (self._without_fix, "no position fix in"),
            (self._without_heading, "no heading in"),
            (self._without_depth, "no depth under the transducer in"),
        )
        if not self.options.humminbird_depth_as_altitude:
            notes.append("the echo sounder's depth is not taken for the altitude (humminbird_depth_as_altitude)")
            texts = texts[:2]
        return notes + [f"{text} {rows.of(self._pings)}" for rows, text in texts if rows.count]

    def _walk(self, *, first: bool) -> Iterator[Ping]:
        row = 0
        for time_ms, channels in self._paired():
            ping = self._ping(time_ms, channels)
            if first:
                self._observe(row, ping)
            row += 1
            yield ping
        self._pings = row
        for file in self._files.values():
            file.check_unchanged()

    def _observe(self, row: int, ping: Ping) -> None:
        for value, rows in (
            (ping.lat_deg, self._without_fix),
            (ping.heading_deg, self._without_heading),
            (ping.altitude_m, self._without_depth),
        ):
            if value is None:
                rows.add(row)
        self._unpaired += len(ping.channels) == 1

    def _paired(self) -> Iterator[tuple[int, dict[Side, _Record]]]:
        """Yield the records of both sides, those of the same time together."""
        walks = {side: _records(file) for side, file in self._files.items()}
        waiting = {side: next(walk, None) for side, walk in walks.items()}
        while present := {side: record for side, record in waiting.items() if record is not None}:
            time_ms = min(record.fields[_TIME_MS] for record in present.values())
            now = {side: record for side, record in present.items() if record.fields[_TIME_MS] == time_ms}
            for side in now:
                waiting[side] = next(walks[side], None)
            yield time_ms, now

    def _ping(self, time_ms: int, records: dict[Side, _Record]) -> Ping:
        fields = next(iter(records.values())).fields
        place = _position(fields)
        heading_good, heading = divmod(fields.get(_HEADING, 0), 1 << 16)
        speed_good, speed = divmod(fields.get(_SPEED, 0), 1 << 16)
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
            lat_deg=place.lat_deg if place else None,
            lon_deg=place.lon_deg if place else None,
            heading_deg=heading / 10 % 360 if heading_good and heading <= 3600 else None,
            altitude_m=depth_m if 0 < depth_m < 1000 else None,
            speed_mps=speed / 10 if speed_good and speed <= 500 else None,
        )


def _records(file: CheckedFile) -> Iterator[_Record]:
    """Yield the pings of one channel.

    Raises:
        SurveyFileError: The file is damaged or ends inside a ping.
    """
    walk = SequentialReader(file)
    number = 0
    while walk.left:
        place = f"ping {number} at byte {walk.offset}"
        start = walk.take(len(_START), place)
        if start != _START:
            raise file.error(f"{place}, start", start, f"{_START!r}")
        fields = _fields(walk, file, place)
        count = fields[_SAMPLES]
        if not 1 <= count <= _MAX_SAMPLES:
            raise file.error(f"{place}, number of samples", count, f"1 to {_MAX_SAMPLES}")
        yield _Record(fields, walk.take(count, place), place)
        number += 1


def _fields(walk: SequentialReader, file: CheckedFile, place: str) -> dict[int, int]:
    """Read a header's fields up to its end."""
    fields: dict[int, int] = {}
    first = walk.offset
    while walk.offset - first < _MAX_HEADER_BYTES:
        tag = walk.take(1, place)[0]
        if tag < 0x40:
            raise file.error(f"{place}, tag", hex(tag), "a field of the header, 0x40 to 0xff")
        width = 4 if tag & 0x80 else 1
        fields[tag] = int.from_bytes(walk.take(width, place), "big")
        if tag == _SAMPLES:
            end = walk.take(1, place)[0]
            if end != _HEADER_END:
                raise file.error(f"{place}, end of the header", hex(end), hex(_HEADER_END))
            missing = [hex(each) for each in (_NUMBER, _TIME_MS) if each not in fields]
            if missing:
                raise file.error(f"{place}, fields", f"no {', '.join(missing)}", "record number and time")
            return fields
    raise file.error(f"{place}, header", f"over {_MAX_HEADER_BYTES} bytes", "the number of samples at its end")


def _position(fields: dict[int, int]) -> Position | None:
    """Return the position of metres on the recorder's Mercator map; None where there is none."""
    east_m, north_m = (_signed(fields.get(tag, 0)) for tag in (_EAST, _NORTH))
    if (east_m, north_m) == (0, 0) or abs(east_m) > math.pi * _RADIUS_M or abs(north_m) > 3 * _RADIUS_M:
        return None
    geocentric = 2 * math.atan(math.exp(north_m / _RADIUS_M)) - math.pi / 2
    lat_deg = math.degrees(math.atan(math.tan(geocentric) * _GEODETIC))
    return Position(lat_deg, (math.degrees(east_m / _RADIUS_M) + 180) % 360 - 180)


def _signed(value: int) -> int:
    return value - (1 << 32) if value >= 1 << 31 else value


def _start_time(path: Path) -> float:
    """Return when a recording began, UTC seconds, from its DAT file."""
    with CheckedFile(path) as file:
        if not _DAT_BYTES <= file.size_bytes <= _MAX_DAT_BYTES:
            raise file.error("file size", file.size_bytes, f"{_DAT_BYTES} to {_MAX_DAT_BYTES} bytes")
        raw = file.read_at(0, _DAT_BYTES, "header")
        if raw[0] not in _DAT_MAGICS:
            raise file.error("first byte", hex(raw[0]), " or ".join(hex(magic) for magic in _DAT_MAGICS))
        (started_s,) = struct.unpack_from(">I", raw, _DAT_TIME_OFFSET)
        if started_s == 0:
            raise file.error("time", 0, "seconds since 1970 (the ONIX series, which has none, is not read)")
        return float(started_s)


def _beside(path: Path, name: str) -> Path | None:
    """Return a channel's file in the folder named as the DAT file, in either case."""
    folder = path.with_suffix("")
    for spelling in (name, name.lower()):
        if (folder / spelling).exists():
            return folder / spelling
    return None
