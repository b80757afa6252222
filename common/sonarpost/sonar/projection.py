"""Positions in projected metres, turned into WGS-84 degrees."""

from __future__ import annotations

import math
from pathlib import Path

from pyproj import Transformer
from pyproj.exceptions import ProjError

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.geometry import Position

_WGS84 = "EPSG:4326"


class Projection:
    """A projected coordinate system, from metres to degrees.

    Args:
        crs: As pyproj takes it: `EPSG:32619`, a PROJ string, WKT.
        path: The file whose positions are in it, for messages.

    Raises:
        SurveyFileError: Not a coordinate system, or not a projected one.
    """

    def __init__(self, crs: str, path: Path) -> None:
        try:
            self._transformer = Transformer.from_crs(crs, _WGS84, always_xy=True)
            source = self._transformer.source_crs
        except ProjError as error:
            raise SurveyFileError(str(path), "projected_crs", crs, "a coordinate system pyproj knows") from error
        if source is None or not source.is_projected:
            raise SurveyFileError(str(path), "projected_crs", crs, "a projected coordinate system")
        if any(axis.unit_conversion_factor != 1 for axis in source.axis_info):
            raise SurveyFileError(str(path), "projected_crs", crs, "a coordinate system in metres")

    def position(self, easting_m: float, northing_m: float) -> Position | None:
        """Return the position, or None where there is none (not finite, 0/0, outside the projection)."""
        if not (math.isfinite(easting_m) and math.isfinite(northing_m)) or (easting_m, northing_m) == (0.0, 0.0):
            return None
        try:
            lon_deg, lat_deg = self._transformer.transform(easting_m, northing_m, errcheck=True)
        except ProjError:
            return None  # outside the projection: no position, counted by the reader as one without a fix
        if not (math.isfinite(lon_deg) and math.isfinite(lat_deg) and abs(lat_deg) <= 90):
            return None
        return Position(float(lat_deg), (float(lon_deg) + 180) % 360 - 180)
