"""Projected coordinates: their extent in a file, and their conversion to degrees. All are in metres."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from pyproj import Transformer
from pyproj.exceptions import ProjError

from sonarpost.sonar.geometry import Position

_WGS84: Final = "EPSG:4326"
MAX_COORDINATE_M: Final = 1e8
"""Maximum easting or northing: twice and a half the circumference of the Earth."""
_EXPECTED: Final = "a projected coordinate system, for example EPSG:32616"


@dataclass(frozen=True, slots=True)
class GridExtent:
    """Extent of the projected coordinates of a file in metres; each is (easting, northing).

    Attributes:
        first_m: First coordinates of the recording.
        last_m: Last coordinates.
        min_m: Least easting and northing.
        max_m: Greatest easting and northing.
    """

    first_m: tuple[float, float]
    last_m: tuple[float, float]
    min_m: tuple[float, float]
    max_m: tuple[float, float]


def grid_coordinates(easting_m: float, northing_m: float) -> tuple[float, float] | None:
    """Return the coordinates of a file; None if they are 0/0, not finite or beyond any projection."""
    here = (easting_m, northing_m)
    valid = here != (0.0, 0.0) and all(math.isfinite(value) and abs(value) <= MAX_COORDINATE_M for value in here)
    return here if valid else None


def extended(extent: GridExtent | None, easting_m: float, northing_m: float) -> GridExtent | None:
    """Return an extent that includes further coordinates; unchanged if these are not valid."""
    here = grid_coordinates(easting_m, northing_m)
    if here is None:
        return extent
    if extent is None:
        return GridExtent(here, here, here, here)
    low, high = extent.min_m, extent.max_m
    return GridExtent(
        first_m=extent.first_m,
        last_m=here,
        min_m=(min(low[0], easting_m), min(low[1], northing_m)),
        max_m=(max(high[0], easting_m), max(high[1], northing_m)),
    )


class Projection:
    """A projected coordinate system.

    Args:
        crs: Coordinate system as pyproj accepts it: `EPSG:32619`, a PROJ string, WKT.

    Attributes:
        unit_m: Unit of the system in metres: 1, or about 0.3048 for feet.

    Raises:
        ValueError: Not a projected coordinate system.
    """

    def __init__(self, crs: str) -> None:
        try:
            self._transformer = Transformer.from_crs(crs, _WGS84, always_xy=True)
        except ProjError as error:
            raise ValueError(_EXPECTED) from error
        source = self._transformer.source_crs
        # A third axis, the height, may have another unit.
        units_m = set() if source is None else {axis.unit_conversion_factor for axis in source.axis_info[:2]}
        if source is None or not source.is_projected or len(units_m) != 1:
            raise ValueError(_EXPECTED)
        self.unit_m: float = units_m.pop()

    def position(self, easting_m: float, northing_m: float) -> Position | None:
        """Return the position; None if it is not finite, 0/0 or outside the projection."""
        if not (math.isfinite(easting_m) and math.isfinite(northing_m)) or (easting_m, northing_m) == (0.0, 0.0):
            return None
        try:
            stored = easting_m / self.unit_m, northing_m / self.unit_m
            lon_deg, lat_deg = self._transformer.transform(*stored, errcheck=True)
        except ProjError:
            return None
        if not (math.isfinite(lon_deg) and math.isfinite(lat_deg) and abs(lat_deg) <= 90):
            return None
        return Position(float(lat_deg), (float(lon_deg) + 180) % 360 - 180)

    def coordinates(self, position: Position) -> tuple[float, float]:
        """Return easting and northing in metres, infinite outside the projection."""
        easting, northing = self._transformer.transform(position.lon_deg, position.lat_deg, direction="INVERSE")
        return float(easting) * self.unit_m, float(northing) * self.unit_m
