"""Reader of XTF (eXtended Triton Format) side-scan recordings, ping by ping (format: see `xtf_records`)."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from pyxtf import XTFPacketStart

from sonarpost.sonar.geometry import Position
from sonarpost.sonar.navigation import (
    KNOT_MPS,
    NAVIGATION_LIMITS,
    PingCounter,
    Projection,
    is_plausible,
    position_in_degrees,
)
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers.open_file import CheckedFile, SequentialReader
from sonarpost.sonar.readers.xtf_records import (
    HEADER_BYTES,
    Attitude,
    PingParser,
    decode_text,
    parse_attitude,
    read_header,
)
from sonarpost.sonar.source import StreamedSource
from sonarpost.sonar.survey import ChannelPing, Ping, Side

PACKET_MAGIC: Final = 0xFACE
SONAR_PACKET: Final = 0
ATTITUDE_PACKET: Final = 3
NAV_UNITS_METRES: Final = 0
NAV_UNITS_DEGREES: Final = 3
MAX_PACKET_BYTES: Final = 1 << 24

_START_BYTES: Final = ctypes.sizeof(XTFPacketStart)
_ATTITUDE_VALID_S: Final = 1.0
"""An attitude packet is valid for the pings of this time after it."""
_ATTITUDE_FIELDS: Final = ("heading_deg", "pitch_deg", "roll_deg")
_PROFILE_COLUMNS: Final = 32
_PROFILE_PINGS: Final = 64


class XtfSource(StreamedSource):
    """An open XTF recording.

    The file must be complete: a file that ends inside a packet is rejected. A field that is zero in every ping is
    unknown. HSeconds of 100 (rounding of a recorder) is read as the next second. Pitch, roll and heading that no ping
    contains are taken from attitude packets up to one second before the ping.

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
        reader = SequentialReader(self._file)
        header, channels = read_header(reader, self._file)
        self._first_packet = reader.offset
        crs = self.options.projected_crs
        nav_units = int(header.NavUnits)
        projection = Projection(crs, self.path) if crs is not None and nav_units == NAV_UNITS_METRES else None
        self._cleaner = NavigationCleaner(nav_units, projection)
        farthest_first = self.options.port_order == "farthest_first"
        self._parser = PingParser(self._file, channels, port_farthest_first=farthest_first)
        self._port_order = _PortOrderCheck()
        self._attitudes = 0
        self._attitude_fields: set[str] = set()
        self._pings = 0
        self._validate(decode_text(header.SonarName) or "unknown", self.path.stem)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _format_warnings(self) -> list[str]:
        warnings = [f"{text} ({count} times)" for text, count in sorted(self._parser.notes.items())]
        if self._attitudes and self._from_attitude():
            names = ", ".join(self._from_attitude())
            warnings.append(f"{names} from attitude packets ({self._attitudes} of them)")
        return [*warnings, *self._cleaner.warnings(self._pings), *self._port_order.warnings()]

    def _from_attitude(self) -> tuple[str, ...]:
        """Return the fields taken from attitude packets: zero in every ping, and set in a packet."""
        return tuple(name for name in sorted(self._attitude_fields) if not self._cleaner.is_recorded(name))

    def _read_pings(self, *, first_pass: bool) -> Iterator[Ping]:
        attitude: Attitude | None = None
        row = 0
        for kind, place, raw in self._packets():
            if kind == ATTITUDE_PACKET and (parsed := parse_attitude(raw)) is not None:
                attitude = parsed
                if first_pass:
                    self._attitudes += 1
                    self._attitude_fields.update(name for name in _ATTITUDE_FIELDS if getattr(parsed, name))
            elif kind == SONAR_PACKET:
                yield self._ping(raw, place, attitude, row if first_pass else None)
                row += 1
            elif first_pass:
                self._parser.notes[f"skipped packet of type {kind}: not a sonar ping"] += 1
        self._pings = row
        self._file.check_unchanged()

    def _packets(self) -> Iterator[tuple[int, str, bytes]]:
        """Yield (type, place in the file, bytes of the whole record) of each packet."""
        reader = SequentialReader(self._file, self._first_packet)
        while reader.remaining:
            place = f"packet at byte {reader.offset}"
            raw = reader.read(_START_BYTES, place)
            start = XTFPacketStart.from_buffer_copy(raw)
            if start.MagicNumber != PACKET_MAGIC:
                raise self._file.error(f"{place}, MagicNumber", hex(start.MagicNumber), hex(PACKET_MAGIC))
            length = int(start.NumBytesThisRecord)
            if not _START_BYTES <= length <= MAX_PACKET_BYTES:
                expected = f"{_START_BYTES} to {MAX_PACKET_BYTES} bytes"
                raise self._file.error(f"{place}, NumBytesThisRecord", length, expected)
            yield int(start.HeaderType), place, raw + reader.read(length - _START_BYTES, place)

    def _ping(self, raw: bytes, place: str, attitude: Attitude | None, row: int | None) -> Ping:
        """Return a ping; `row` is its row in the first pass, else None."""
        header, time_utc_s = self._parser.header(raw, place)
        of_ship = self.options.position_source == "ship"
        stored = Ping(
            number=int(header.PingNumber),
            time_utc_s=time_utc_s,
            channels=tuple(self._parser.channels(raw, header, place)),
            lat_deg=float(header.ShipYcoordinate if of_ship else header.SensorYcoordinate),
            lon_deg=float(header.ShipXcoordinate if of_ship else header.SensorXcoordinate),
            heading_deg=float(header.SensorHeading),
            altitude_m=float(header.SensorPrimaryAltitude),
            depth_m=float(header.SensorDepth),
            speed_mps=float(header.SensorSpeed) * KNOT_MPS,
            pitch_deg=float(header.SensorPitch),
            roll_deg=float(header.SensorRoll),
        )
        if row is not None:
            self._cleaner.observe(row, stored)
            self._port_order.observe(stored.channels)
        ping = self._cleaner.clean(stored)
        if attitude is not None and 0 <= time_utc_s - attitude.time_utc_s <= _ATTITUDE_VALID_S:
            ping = replace(ping, **{name: getattr(attitude, name) for name in self._from_attitude()})
        return ping


class _PortOrderCheck:
    """Detects port samples stored in the opposite order to the assumed one.

    Both sides record the same water column and similar seabed, so their mean profiles correlate if both begin at the
    vehicle. The check only gives a warning.
    """

    def __init__(self) -> None:
        self._sums = {side: np.zeros(_PROFILE_COLUMNS) for side in Side}
        self._counts = dict.fromkeys(Side, 0)

    def observe(self, channels: tuple[ChannelPing, ...]) -> None:
        """Add the first channel of each side to its profile."""
        added: set[Side] = set()
        for channel in channels:
            per_column = channel.samples.shape[0] // _PROFILE_COLUMNS
            if channel.side in added or per_column < 2:
                continue
            added.add(channel.side)
            columns = channel.samples[: per_column * _PROFILE_COLUMNS].reshape(_PROFILE_COLUMNS, per_column)
            self._sums[channel.side] += columns.mean(axis=1)
            self._counts[channel.side] += 1

    def warnings(self) -> list[str]:
        """Return the warning, if the order seems wrong."""
        if min(self._counts.values()) < _PROFILE_PINGS:
            return []
        port, starboard = (self._profile(side) for side in Side)
        scale = float(np.linalg.norm(port) * np.linalg.norm(starboard))
        if scale == 0 or float(port[::-1] @ starboard) < 0.5 * scale or float(port @ starboard) > 0:
            return []
        return ["port looks stored nearest sample first, against the format: port may be mirrored"]

    def _profile(self, side: Side) -> npt.NDArray[np.float64]:
        profile: npt.NDArray[np.float64] = np.log1p(self._sums[side] / self._counts[side])
        profile -= profile.mean()
        return profile


class NavigationCleaner:
    """Replaces unknown and implausible navigation values by None.

    The pings are given as stored in the file: `lat_deg` and `lon_deg` hold the Y and X coordinate in the unit of the
    file, and unknown values are zero.

    These are None: a position that is 0/0, not finite or out of range; a position in metres without a projection; an
    altitude of 0; a field that is zero in every ping; all fields of a ping whose navigation is all zero; a value
    outside `NAVIGATION_LIMITS`.

    Args:
        nav_units: NavUnits of the file header: 3 is degrees, 0 projected metres. The values are not used to guess it.
        projection: Projection of coordinates in metres, if known.
    """

    def __init__(self, nav_units: int, projection: Projection | None) -> None:
        self._nav_units = nav_units
        self._projection = projection
        self._recorded: set[str] = set()
        self._without_fix = PingCounter()
        self._implausible: dict[str, PingCounter] = {}

    def observe(self, row: int, stored: Ping) -> None:
        """Count irregularities of a ping in the first pass through the file."""
        if self._position(stored) is None:
            self._without_fix.add(row)
        for name in NAVIGATION_LIMITS:
            value = getattr(stored, name)
            if value:
                self._recorded.add(name)
                if not is_plausible(name, value):
                    self._implausible.setdefault(name, PingCounter()).add(row)

    def is_recorded(self, name: str) -> bool:
        """Return whether the field is not zero in any ping observed so far."""
        return name in self._recorded

    def clean(self, stored: Ping) -> Ping:
        """Return the ping with its position in degrees, and None for unknown and implausible values."""
        values: dict[str, Any] = {name: getattr(stored, name) for name in NAVIGATION_LIMITS}
        empty = not any((stored.lat_deg, stored.lon_deg, *values.values()))  # the recorder had no navigation yet
        for name, value in values.items():
            unknown = empty or name not in self._recorded or (name == "altitude_m" and value == 0)
            if unknown or value is None or not is_plausible(name, value):
                values[name] = None
        if values["heading_deg"] == 360.0:
            values["heading_deg"] = 0.0
        position = self._position(stored)
        lat_deg, lon_deg = (None, None) if position is None else (position.lat_deg, position.lon_deg)
        return replace(stored, lat_deg=lat_deg, lon_deg=lon_deg, **values)

    def warnings(self, total: int) -> list[str]:
        """Return one line for each kind of irregularity in `total` pings."""
        warnings: list[str] = []
        if self._nav_units == NAV_UNITS_METRES and self._projection is None:
            warnings.append(
                "no positions: NavUnits is 0 (projected metres) and the file does not contain the projection; "
                "set the option projected_crs"
            )
        elif self._nav_units not in (NAV_UNITS_DEGREES, NAV_UNITS_METRES):
            expected = f"{NAV_UNITS_DEGREES} (degrees) or {NAV_UNITS_METRES} (projected metres)"
            warnings.append(f"no positions: NavUnits is {self._nav_units}, expected {expected}")
        elif self._without_fix.count:
            warnings.append(f"no position fix in {self._without_fix.summary(total)}")
        implausible = sorted(self._implausible.items())
        return warnings + [f"{name} out of range in {counter.summary(total)}" for name, counter in implausible]

    def _position(self, stored: Ping) -> Position | None:
        if stored.lat_deg is None or stored.lon_deg is None:
            return None
        if self._nav_units == NAV_UNITS_METRES and self._projection is not None:
            return self._projection.position(stored.lon_deg, stored.lat_deg)
        return position_in_degrees(stored.lat_deg, stored.lon_deg) if self._nav_units == NAV_UNITS_DEGREES else None
