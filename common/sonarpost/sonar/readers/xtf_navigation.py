"""Navigation of XTF recordings: recorded fields, position of the sensor or of the ship, recorded layback.

Each ping has two positions. The ship's is that of the antenna. A sensor's position that differs from it was calculated
by the recorder, with the layback. Other recorders leave the sensor's position zero or copy the ship's, and store the
layback (Layback, or CableOut), in metres: it remains to be applied.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, Final, Literal

from pyxtf import XTFPingHeader

from sonarpost.sonar.geometry import Position, offset_between_m
from sonarpost.sonar.navigation import (
    KNOT_MPS,
    PingNotes,
    is_plausible,
    out_of_range,
    plausible,
    plausible_angle,
    position_in_degrees,
)
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.projection import Projection, grid_coordinates
from sonarpost.sonar.readers.joining import PingPart
from sonarpost.sonar.readers.xtf_packets import usual
from sonarpost.sonar.survey import Ping

NAV_UNITS_METRES: Final = 0
NAV_UNITS_DEGREES: Final = 3

PingHead = tuple[XTFPingHeader, tuple[float, dict[str, float]] | None]
"""Header of a sonar packet, and the attitude packet before it: time in seconds, and angles by name."""
_Place = Position | tuple[float, float]
"""A position, or easting and northing in metres."""

_FIELDS: Final = {
    "heading_deg": ("SensorHeading", 1.0),
    "altitude_m": ("SensorPrimaryAltitude", 1.0),
    "depth_m": ("SensorDepth", 1.0),
    "speed_mps": ("SensorSpeed", KNOT_MPS),
    "pitch_deg": ("SensorPitch", 1.0),
    "roll_deg": ("SensorRoll", 1.0),
}
"""Field of the ping header, and its unit, by value of a ping."""
_ATTITUDE_VALID_S: Final = 1.0
"""An attitude packet is valid for the pings of this time after it."""
_LAYBACK_M: Final = (1.0, 10_000.0)
"""Range of a layback: a shorter one is less than the error of a position."""


class Navigation:
    """Navigation of the pings of one file: `scan` all packets, `conclude`, then make each `ping`.

    A field that is zero in every ping is unknown. So is a field that only a few of many pings have: damaged ones.

    These are None: a position that is 0/0, not finite or out of range; a projected position without a projection; an
    altitude of 0; an unknown field; all fields of a ping whose navigation is all zero; a value outside
    `NAVIGATION_LIMITS`.

    Args:
        nav_units: NavUnits of the file header: 3 is degrees, 0 projected. The values are not used to guess it.
        options: Projection, source of the position, use of the recorded layback, mounting.
    """

    def __init__(self, nav_units: int, options: SurveyOptions) -> None:
        self._nav_units = nav_units
        self._options = options
        crs = options.projected_crs
        self._projection = Projection(crs) if crs is not None and nav_units == NAV_UNITS_METRES else None
        self._unit_m = 1.0 if self._projection is None else self._projection.unit_m
        self._counts: Counter[str] = Counter()
        self._attitude_counts: Counter[str] = Counter()
        self._laybacks_m = 0.0
        self._recorded: set[str] = set()
        self._from_attitude: list[str] = []
        self._source = "sensor"
        self._layback_use: Literal["", "apply", "note"] = ""

    def scan(self, head: XTFPingHeader) -> None:
        """Count the fields of a ping that are not zero."""
        self._counts["pings"] += 1
        self._counts.update(name for name, (field, _) in _FIELDS.items() if getattr(head, field))
        found = {
            "gyro": head.ShipGyro,
            "layback": head.Layback,
            "sensor": self._place(*_coordinates(head, "sensor")),
            "ship": self._place(*_coordinates(head, "ship")),
        }
        self._counts.update(name for name, value in found.items() if value)
        if (layback_m := _layback_m(head)) > _LAYBACK_M[0]:
            self._counts["towed"] += 1
            self._counts["calculated"] += self._is_calculated(head, layback_m)
            self._laybacks_m += layback_m

    def scan_attitude(self, angles: dict[str, float]) -> None:
        """Count the fields of an attitude packet that are not zero."""
        self._attitude_counts["packets"] += 1
        self._attitude_counts.update(name for name, angle in angles.items() if angle)

    def conclude(self) -> None:
        """Decide what the file records, after all packets."""
        counts, options = self._counts, self._options
        self._recorded = usual(counts, counts["pings"])
        from_attitude = usual(self._attitude_counts, self._attitude_counts["packets"]) - self._recorded
        self._from_attitude = sorted(from_attitude - {"packets"})
        self._source = options.position_source
        if self._source == "auto":
            self._source = "ship" if "ship" in self._recorded and "sensor" not in self._recorded else "sensor"
        if "towed" not in self._recorded or options.recorded_layback == "ignore" or options.mounting.layback_m:
            return
        if options.recorded_layback == "apply" or self._source == "ship":
            self._layback_use = "apply"
        elif counts["calculated"] < counts["towed"] / 2:  # a calculated position comes close to the ship in a turn
            self._layback_use = "note"

    def ping(self, part: PingPart[PingHead], row: int, notes: PingNotes) -> Ping:
        """Return a ping with its navigation, and note values that are out of range."""
        head, attitude = part.head
        x, y = _coordinates(head, self._source)
        place = self._place(x, y)
        grid_m = place if isinstance(place, tuple) else None
        stored = {name: float(getattr(head, field)) * unit for name, (field, unit) in _FIELDS.items()}
        for name, value in stored.items():
            if value and not is_plausible(name, value):
                notes.add(out_of_range(name), row)
        known = self._recorded if x or y or any(stored.values()) else set()  # the recorder had no navigation yet
        values: dict[str, Any] = {
            name: plausible(name, value) if name in known else None for name, value in stored.items()
        }
        values["altitude_m"] = values["altitude_m"] or None
        if values["heading_deg"] == 360.0:
            values["heading_deg"] = 0.0
        if attitude is not None and 0 <= part.time_utc_s - attitude[0] <= _ATTITUDE_VALID_S:
            values.update((name, attitude[1][name]) for name in self._from_attitude)
        layback_m = _layback_m(head)
        unapplied = self._layback_use == "note" and layback_m > _LAYBACK_M[0]
        position = place if isinstance(place, Position) else None
        if grid_m is not None and self._projection is not None:
            position = self._projection.position(*grid_m)
        return Ping(
            number=part.number,
            time_utc_s=part.time_utc_s,
            channels=part.channels,
            lat_deg=None if position is None else position.lat_deg,
            lon_deg=None if position is None else position.lon_deg,
            grid_m=grid_m,
            gyro_deg=plausible_angle(float(head.ShipGyro)) if "gyro" in known else None,
            layback_m=layback_m or None if self._layback_use == "apply" else None,
            position_note=self._note(layback_m) if unapplied and not self._is_calculated(head, layback_m) else None,
            **values,
        )

    def warnings(self, notes: PingNotes, total: int) -> list[str]:
        """Return one line for each kind of irregularity in `total` pings, with those of `notes`."""
        lines = []
        if self._from_attitude:
            names, packets = ", ".join(self._from_attitude), self._attitude_counts["packets"]
            lines.append(f"{names} from attitude packets ({packets} of them)")
        other = "sensor" if self._source == "ship" else "ship"
        if other in self._recorded and self._source not in self._recorded:
            lines.append(
                f'the file has the position of the {other}, not of the {self._source}: position_source = "{other}"'
            )
        elif self._source == "ship" and self._options.position_source == "auto":
            lines.append('positions are those of the ship, the file has none of the sensor (position_source = "ship")')
        if self._layback_use and "layback" not in self._recorded:
            depth = "and the depth" if "depth_m" in self._recorded else "alone, the depth is unknown"
            lines.append(f"layback calculated from the length of the cable (CableOut) {depth}")
        if self._layback_use == "note":
            lines.append(self._note(self._laybacks_m / self._counts["towed"]))
        if self._nav_units not in (NAV_UNITS_DEGREES, NAV_UNITS_METRES):
            expected = f"{NAV_UNITS_DEGREES} (degrees) or {NAV_UNITS_METRES} (projected metres)"
            lines.append(f"no positions: NavUnits is {self._nav_units}, expected {expected}")
        return lines + notes.lines(total, map(out_of_range, sorted(_FIELDS)))

    def _note(self, layback_m: float) -> str:
        reason = "the sensor's position is the ship's"
        if "ship" not in self._recorded:
            reason = "the file has no position of the ship to tell whether the sensor's includes it"
        return f'recorded layback of {layback_m:.4g} m is not applied: {reason} (option recorded_layback = "apply")'

    def _is_calculated(self, head: XTFPingHeader, layback_m: float) -> bool:
        """Return whether the sensor's position is behind the ship's by about the layback, and not a copy."""
        sensor, ship = (self._place(*_coordinates(head, source)) for source in ("sensor", "ship"))
        if isinstance(sensor, Position) and isinstance(ship, Position):
            return math.hypot(*offset_between_m(ship, sensor)) > layback_m / 2
        return isinstance(sensor, tuple) and isinstance(ship, tuple) and math.dist(ship, sensor) > layback_m / 2

    def _place(self, x: float, y: float) -> _Place | None:
        if self._nav_units == NAV_UNITS_METRES:
            return grid_coordinates(x * self._unit_m, y * self._unit_m)
        return position_in_degrees(y, x) if self._nav_units == NAV_UNITS_DEGREES else None


def _coordinates(head: XTFPingHeader, source: str) -> tuple[float, float]:
    """Return X and Y of the sensor or the ship, in the unit of the file."""
    if source == "ship":
        return float(head.ShipXcoordinate), float(head.ShipYcoordinate)
    return float(head.SensorXcoordinate), float(head.SensorYcoordinate)


def _layback_m(head: XTFPingHeader) -> float:
    """Return the recorded layback, or that of a straight cable of the recorded length; 0 if there is none."""
    layback_m = abs(float(head.Layback))
    if 0 < layback_m <= _LAYBACK_M[1]:  # excludes NaN
        return layback_m
    cable_m = head.CableOut + (head.CableOutHundredths / 100 if head.CableOutHundredths < 100 else 0.0)
    depth_m = float(head.SensorDepth) if is_plausible("depth_m", float(head.SensorDepth)) else 0.0
    return math.sqrt(max(cable_m**2 - depth_m**2, 0.0)) if cable_m <= _LAYBACK_M[1] else 0.0
