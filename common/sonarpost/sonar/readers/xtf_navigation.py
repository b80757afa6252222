"""Navigation of XTF pings: which values are real, and which are only fields left at zero."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Final

from pyxtf import XTFPingHeader

from sonarpost.sonar.navigation_check import NavigationRows
from sonarpost.sonar.projection import Projection

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
