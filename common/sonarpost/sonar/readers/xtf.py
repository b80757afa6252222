"""Reader of XTF (eXtended Triton Format) side-scan recordings, ping by ping (see `xtf_records` for the format).

## sonarpost.sonar.readers.xtf
Navigation of XTF pings: which values are real, and which are only fields left at zero.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from pyxtf import XTFPacketStart, XTFPingHeader

from sonarpost.sonar.navigation import NavigationRows, Projection
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers.open_file import CheckedFile, SequentialReader
from sonarpost.sonar.readers.xtf_records import HEADER_BYTES, Attitude, PingParser, attitude_of, read_header, text_of
from sonarpost.sonar.source import StreamedSource, gather
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

PACKET_MAGIC: Final = 0xFACE
SONAR_PACKET: Final = 0
ATTITUDE_PACKET: Final = 3
MAX_FILE_BYTES: Final = 1 << 30
"""`read_xtf` holds a survey in memory; a larger file is read through `XtfSource`."""
MAX_PACKET_BYTES: Final = 1 << 24

_START_BYTES: Final = ctypes.sizeof(XTFPacketStart)
_ATTITUDE_HOLD_S: Final = 1.0
"""How long an attitude packet stands for the pings after it."""
_ATTITUDE_FIELDS: Final = ("heading_deg", "pitch_deg", "roll_deg")
_PROFILE_COLUMNS: Final = 32
_PROFILE_PINGS: Final = 64


def read_xtf(path: Path, options: SurveyOptions | None = None) -> Survey:
    """Read an XTF recording into memory.

    A file must be whole: one that ends inside a packet is an error, since a vehicle's finished recording has no
    such tail and half a ping is not worth a wrong position. What the file does not record (a field that is zero in
    every ping) is None. HSeconds of 100 (a recorder's rounding) is taken as the next second.

    Args:
        path: The file.
        options: What the file does not say; see there.

    Returns:
        The survey, with one warning for each kind of thing that was left out.

    Raises:
        SurveyFileError: Not an XTF file, truncated, inconsistent, too long, without sonar pings, or unreadable.
    """
    with CheckedFile(path) as file:
        if file.size_bytes > MAX_FILE_BYTES:
            raise file.error("file size", file.size_bytes, f"at most {MAX_FILE_BYTES} bytes, or reading in blocks")
    with XtfSource(path, options or SurveyOptions()) as source:
        return gather(source)


class XtfSource(StreamedSource):
    """An open XTF recording.

    Pitch, roll and heading that no ping has are taken from attitude packets, the last one up to a second before.

    Raises:
        SurveyFileError: Not an XTF file, truncated, inconsistent, without sonar pings, or unreadable.
    """

    def __init__(self, path: Path, options: SurveyOptions) -> None:
        super().__init__(path, options)
        self._file = CheckedFile(path)
        try:
            self._open()
        except BaseException:
            self._file.close()
            raise

    def _open(self) -> None:
        if self._file.size_bytes < HEADER_BYTES:
            raise self._file.error("file size", self._file.size_bytes, f"at least {HEADER_BYTES} bytes")
        walk = SequentialReader(self._file)
        header, channels = read_header(walk, self._file)
        self._first_packet = walk.offset
        crs = self.options.projected_crs
        nav_units = int(header.NavUnits)
        projection = Projection(crs, self.path) if crs is not None and nav_units == NAV_UNITS_METRES else None
        self._cleaner = NavigationCleaner(nav_units, projection)
        farthest_first = self.options.port_order == "farthest_first"
        self._parser = PingParser(self._file, channels, port_farthest_first=farthest_first)
        self._order = _PortOrder()
        self._attitudes = 0
        self._attitude_fields: set[str] = set()
        self._pings = 0
        self._scan(text_of(header.SonarName) or "unknown", self.path.stem)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _notes(self) -> list[str]:
        notes = [f"{text} ({count} times)" for text, count in sorted(self._parser.notes.items())]
        if self._attitudes and self._borrowed():
            names = ", ".join(self._borrowed())
            notes.append(f"{names} from attitude packets ({self._attitudes} of them)")
        return [*notes, *self._cleaner.warnings(self._pings), *self._order.note()]

    def _borrowed(self) -> tuple[str, ...]:
        """Return the fields that come from attitude packets: those no ping has, and that are not zero there too."""
        return tuple(name for name in sorted(self._attitude_fields) if not self._cleaner.records(name))

    def _walk(self, *, first: bool) -> Iterator[Ping]:
        attitude: Attitude | None = None
        row = 0
        for kind, place, raw in self._packets():
            if kind == ATTITUDE_PACKET and (met := attitude_of(raw)) is not None:
                attitude = met
                if first:
                    self._attitudes += 1
                    self._attitude_fields.update(name for name in _ATTITUDE_FIELDS if getattr(met, name))
            elif kind == SONAR_PACKET:
                yield self._ping(raw, place, attitude, row if first else None)
                row += 1
            elif first:
                self._parser.notes[f"skipped packet of type {kind}: not a sonar ping"] += 1
        self._pings = row
        self._file.check_unchanged()

    def _packets(self) -> Iterator[tuple[int, str, bytes]]:
        """Yield (type, place, bytes of the whole record) of each packet."""
        walk = SequentialReader(self._file, self._first_packet)
        while walk.left:
            place = f"packet at byte {walk.offset}"
            raw = walk.take(_START_BYTES, place)
            start = XTFPacketStart.from_buffer_copy(raw)
            if start.MagicNumber != PACKET_MAGIC:
                raise self._file.error(f"{place}, MagicNumber", hex(start.MagicNumber), hex(PACKET_MAGIC))
            length = int(start.NumBytesThisRecord)
            if not _START_BYTES <= length <= MAX_PACKET_BYTES:
                expected = f"{_START_BYTES} to {MAX_PACKET_BYTES} bytes"
                raise self._file.error(f"{place}, NumBytesThisRecord", length, expected)
            yield int(start.HeaderType), place, raw + walk.take(length - _START_BYTES, place)

    def _ping(self, raw: bytes, place: str, attitude: Attitude | None, row: int | None) -> Ping:
        head, time_utc_s = self._parser.head(raw, place)
        channels = tuple(self._parser.channels(raw, head, place))
        record = NavigationRecord.of_ping(head, of_ship=self.options.position_source == "ship")
        if row is not None:
            self._cleaner.observe(row, record)
            self._order.observe(channels)
        fix = self._cleaner.clean(record)
        values = {name: getattr(fix, name) for name in _ATTITUDE_FIELDS}
        if attitude is not None and 0 <= time_utc_s - attitude.time_utc_s <= _ATTITUDE_HOLD_S:
            values.update({name: getattr(attitude, name) for name in self._borrowed()})
        return Ping(
            number=int(head.PingNumber),
            time_utc_s=time_utc_s,
            channels=channels,
            lat_deg=fix.lat_deg,
            lon_deg=fix.lon_deg,
            altitude_m=fix.altitude_m,
            depth_m=fix.depth_m,
            speed_mps=fix.speed_mps,
            **values,
        )


class _PortOrder:
    """Sees when port looks stored in the other order than was assumed: then it is turned the wrong way.

    Both sides see the same water column and much the same seabed, so their mean profiles agree when both begin at
    the vehicle. Nothing is turned on this evidence alone.
    """

    def __init__(self) -> None:
        self._sums = {side: np.zeros(_PROFILE_COLUMNS) for side in Side}
        self._counts = dict.fromkeys(Side, 0)

    def observe(self, channels: tuple[ChannelPing, ...]) -> None:
        """Add the first channel of each side to its profile."""
        seen: set[Side] = set()
        for channel in channels:
            per_column = channel.samples.shape[0] // _PROFILE_COLUMNS
            if channel.side in seen or per_column < 2:
                continue
            seen.add(channel.side)
            columns = channel.samples[: per_column * _PROFILE_COLUMNS].reshape(_PROFILE_COLUMNS, per_column)
            self._sums[channel.side] += columns.mean(axis=1)
            self._counts[channel.side] += 1

    def note(self) -> list[str]:
        """Return the warning, if there is reason for it."""
        if min(self._counts.values()) < _PROFILE_PINGS:
            return []
        port, starboard = (self._profile(side) for side in Side)
        scale = float(np.linalg.norm(port) * np.linalg.norm(starboard))
        if scale == 0 or float(port[::-1] @ starboard) < 0.5 * scale or float(port @ starboard) > 0:
            return []
        return ["port looks stored nearest sample first, against the format: its picture may be mirrored"]

    def _profile(self, side: Side) -> npt.NDArray[np.float64]:
        profile: npt.NDArray[np.float64] = np.log1p(self._sums[side] / self._counts[side])
        profile -= profile.mean()
        return profile


KNOT_MPS: Final = 1852 / 3600
NAV_UNITS_DEGREES: Final = 3
NAV_UNITS_METRES: Final = 0
_OPTIONAL: Final = ("heading_deg", "altitude_m", "depth_m", "speed_mps", "pitch_deg", "roll_deg")
_LIMITS: Final = {
    "heading_deg": (0.0, 360.0),
    "altitude_m": (0.0, 11_000.0),
    "depth_m": (-100.0, 11_000.0),
    "speed_mps": (0.0, 50.0),
    "pitch_deg": (-90.0, 90.0),
    "roll_deg": (-180.0, 180.0),
}


@dataclass(frozen=True, slots=True)
class NavigationRecord:
    """Navigation of one ping: SI units and degrees, None where the file gives nothing usable.

    As stored (`of_ping`), `lat_deg` and `lon_deg` hold the Y and X coordinate in whatever unit the file has.
    """

    lat_deg: float | None
    lon_deg: float | None
    heading_deg: float | None
    altitude_m: float | None
    depth_m: float | None
    speed_mps: float | None
    pitch_deg: float | None
    roll_deg: float | None

    @classmethod
    def of_ping(cls, head: XTFPingHeader, *, of_ship: bool = False) -> NavigationRecord:
        """Take the sensor's fields of a ping header as they stand; speed is in knots there.

        The ship's position is taken only when asked for: for a towed or independent sonar it is another place.
        """
        return cls(
            lat_deg=float(head.ShipYcoordinate if of_ship else head.SensorYcoordinate),
            lon_deg=float(head.ShipXcoordinate if of_ship else head.SensorXcoordinate),
            heading_deg=float(head.SensorHeading),
            altitude_m=float(head.SensorPrimaryAltitude),
            depth_m=float(head.SensorDepth),
            speed_mps=float(head.SensorSpeed) * KNOT_MPS,
            pitch_deg=float(head.SensorPitch),
            roll_deg=float(head.SensorRoll),
        )

    def is_empty(self) -> bool:
        """Return whether every field is zero: the recorder had no navigation yet."""
        return not any(getattr(self, each.name) for each in fields(self))


class NavigationCleaner:
    """Turns fields as stored into values or None.

    None stands for: a position at 0/0, not finite or not on Earth; any position in metres of which nobody said what
    projection they are in; an altitude of 0; any field that is zero in every ping; everything in a ping whose
    navigation is all zero; and a value outside what a vehicle can have.

    Args:
        nav_units: NavUnits of the file header: 3 is degrees, 0 projected metres. Values of the coordinates are never
            asked which of the two they are.
        projection: What metres are in, if known.
    """

    def __init__(self, nav_units: int, projection: Projection | None) -> None:
        self._nav_units = nav_units
        self._projection = projection
        self._recorded: set[str] = set()
        self._without_fix = NavigationRows()
        self._odd: dict[str, NavigationRows] = {}

    def observe(self, row: int, record: NavigationRecord) -> None:
        """Take note of a record on the first walk through the file."""
        if self._position(record).lat_deg is None:
            self._without_fix.add(row)
        for name in _OPTIONAL:
            value = getattr(record, name)
            if value:
                self._recorded.add(name)
                if not _plausible(name, value):
                    self._odd.setdefault(name, NavigationRows()).add(row)

    def records(self, name: str) -> bool:
        """Return whether any ping seen so far has something in this field."""
        return name in self._recorded

    def clean(self, record: NavigationRecord) -> NavigationRecord:
        """Return the record with what is not real taken out, by what all pings observed so far have."""
        values: dict[str, float | None] = {name: getattr(record, name) for name in _OPTIONAL}
        empty = record.is_empty()
        for name, value in values.items():
            unknown = empty or name not in self._recorded or (name == "altitude_m" and value == 0)
            if unknown or value is None or not _plausible(name, value):
                values[name] = None
        if values["heading_deg"] == 360.0:
            values["heading_deg"] = 0.0
        return replace(self._position(record), **values)

    def warnings(self, total: int) -> list[str]:
        """Return what was met in `total` pings, one line each."""
        notes: list[str] = []
        if self._nav_units == NAV_UNITS_METRES and self._projection is None:
            notes.append(
                "no positions: NavUnits is 0 (projected metres) and the file does not say in which projection; "
                "projected_crs of the options does"
            )
        elif self._nav_units not in (NAV_UNITS_DEGREES, NAV_UNITS_METRES):
            expected = f"{NAV_UNITS_DEGREES} (degrees) or {NAV_UNITS_METRES} (projected metres)"
            notes.append(f"no positions: NavUnits is {self._nav_units}, expected {expected}")
        elif self._without_fix.count:
            notes.append(f"no position fix in {self._without_fix.of(total)}")
        return notes + [f"{name} out of range in {rows.of(total)}" for name, rows in sorted(self._odd.items())]

    def _position(self, record: NavigationRecord) -> NavigationRecord:
        lat_deg, lon_deg = record.lat_deg, record.lon_deg
        if lat_deg is None or lon_deg is None:
            return record
        if self._nav_units == NAV_UNITS_METRES and self._projection is not None:
            place = self._projection.position(lon_deg, lat_deg)
            if place is None:
                return replace(record, lat_deg=None, lon_deg=None)
            return replace(record, lat_deg=place.lat_deg, lon_deg=place.lon_deg)
        usable = (
            self._nav_units == NAV_UNITS_DEGREES
            and math.isfinite(lat_deg)
            and math.isfinite(lon_deg)
            and abs(lat_deg) <= 90
            and abs(lon_deg) <= 180
            and (lat_deg, lon_deg) != (0.0, 0.0)
        )
        return record if usable else replace(record, lat_deg=None, lon_deg=None)


def _plausible(name: str, value: float) -> bool:
    low, high = _LIMITS[name]
    return math.isfinite(value) and low <= value <= high
