"""Positions for the review: metres around an origin, geodesics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pyproj import Geod

_WGS84 = Geod(ellps="WGS84")


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """Azimuthal equidistant projection. Distances and bearings from the origin are true.

    Attributes:
        lat_deg: WGS 84 latitude of the origin.
        lon_deg: WGS 84 longitude of the origin.
    """

    lat_deg: float
    lon_deg: float

    def to_local(self, lats_deg: Sequence[float], lons_deg: Sequence[float]) -> list[tuple[float, float]]:
        """Return (x_m east, y_m north) of WGS 84 positions, rounded to 0.01 m."""
        if not lats_deg:
            return []
        ones = np.ones(len(lats_deg))
        found = _WGS84.inv(self.lon_deg * ones, self.lat_deg * ones, np.asarray(lons_deg), np.asarray(lats_deg))
        bearing, range_m = np.radians(np.asarray(found[0], np.float64)), np.asarray(found[2], np.float64)
        x_m, y_m = (range_m * np.sin(bearing)).round(2), (range_m * np.cos(bearing)).round(2)
        return [(float(x), float(y)) for x, y in zip(x_m, y_m, strict=True)]


def destination(lat_deg: float, lon_deg: float, bearing_deg: float, range_m: float) -> tuple[float, float]:
    """Return (lat_deg, lon_deg), WGS 84, of the point at a true bearing and range from a position."""
    lon, lat, _ = _WGS84.fwd(lon_deg, lat_deg, bearing_deg, range_m)
    return float(lat), float(lon)


def distance_m(from_lat_deg: float, from_lon_deg: float, to_lat_deg: float, to_lon_deg: float) -> float:
    """Return the length of the geodesic between two WGS 84 positions, in metres."""
    return float(_WGS84.inv(from_lon_deg, from_lat_deg, to_lon_deg, to_lat_deg)[2])


def vehicle_position(
    lat_deg: float | None,
    lon_deg: float | None,
    heading_deg: float | None,
    channel: str | None,
    ground_range_m: float | None,
) -> tuple[float, float] | None:
    """Return (lat_deg, lon_deg) of the vehicle at the detection of an object; None if an argument is unknown."""
    if lat_deg is None or lon_deg is None or heading_deg is None or channel is None or ground_range_m is None:
        return None
    # The vehicle is on the port side of an object on its starboard side.
    bearing_deg = heading_deg - 90.0 if channel == "starboard" else heading_deg + 90.0
    return destination(lat_deg, lon_deg, bearing_deg, ground_range_m)
