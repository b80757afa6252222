"""Navigation of XTF pings: which values are real, and which are only fields left at zero."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Final

from pyxtf import XTFPingHeader

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
    """Navigation of one ping: SI units and degrees, None where the file gives nothing usable."""

    lat_deg: float | None
    lon_deg: float | None
    heading_deg: float | None
    altitude_m: float | None
    depth_m: float | None
    speed_mps: float | None
    pitch_deg: float | None
    roll_deg: float | None

    @classmethod
    def of_ping(cls, head: XTFPingHeader) -> NavigationRecord:
        """Take the sensor's fields of a ping header as they stand; speed is in knots there.

        The ship's fields are left alone: for a towed or independent sonar they are another place.
        """
        return cls(
            lat_deg=float(head.SensorYcoordinate),
            lon_deg=float(head.SensorXcoordinate),
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


def clean_navigation(raw: Sequence[NavigationRecord], nav_units: int) -> tuple[list[NavigationRecord], list[str]]:
    """Turn fields as stored into values or None.

    Args:
        raw: One record a ping, as stored.
        nav_units: NavUnits of the file header; only 3 (degrees) gives positions.

    Returns:
        As many records, and warnings, one line each. None stands for: a position at 0/0, not finite or not on
        Earth; any position in a file of projected metres; an altitude of 0; any field that is zero in every ping;
        everything in a ping whose navigation is all zero; and a value outside what a vehicle can have.
    """
    absent = [name for name in _OPTIONAL if not any(getattr(record, name) for record in raw)]
    warnings: list[str] = []
    cleaned: list[NavigationRecord] = []
    without_fix: list[int] = []
    odd: dict[str, list[int]] = {}
    for row, record in enumerate(raw):
        fixed = _position(record, nav_units)
        if fixed.lat_deg is None:
            without_fix.append(row)
        values = {name: getattr(record, name) for name in _OPTIONAL}
        for name, value in values.items():
            if name in absent or record.is_empty() or (name == "altitude_m" and value == 0):
                values[name] = None
            elif not _plausible(name, value):
                values[name] = None
                odd.setdefault(name, []).append(row)
        if values["heading_deg"] == 360.0:
            values["heading_deg"] = 0.0
        cleaned.append(replace(fixed, **values))
    if nav_units != NAV_UNITS_DEGREES:
        name = "projected metres" if nav_units == NAV_UNITS_METRES else "not degrees"
        warnings.append(f"no positions: NavUnits is {nav_units} ({name}), expected {NAV_UNITS_DEGREES}")
    elif without_fix:
        warnings.append(f"no position fix in {_rows(without_fix, len(raw))}")
    warnings += [f"{name} out of range in {_rows(rows, len(raw))}" for name, rows in sorted(odd.items())]
    return cleaned, warnings


def _position(record: NavigationRecord, nav_units: int) -> NavigationRecord:
    lat_deg, lon_deg = record.lat_deg, record.lon_deg
    usable = (
        nav_units == NAV_UNITS_DEGREES
        and lat_deg is not None
        and lon_deg is not None
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


def _rows(rows: list[int], count: int) -> str:
    return f"{len(rows)} of {count} pings, the first in row {rows[0]}"
