"""Positions in metres around a place, as a map without internet shows them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pyproj import Geod

_WGS84 = Geod(ellps="WGS84")


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """An azimuthal equidistant projection: distances and bearings from its origin are true.

    Attributes:
        lat_deg: WGS 84 latitude of the origin.
        lon_deg: WGS 84 longitude of the origin.
    """

    lat_deg: float
    lon_deg: float

    def to_local(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        """Return (x_m east, y_m north) of a WGS 84 position."""
        bearing_deg, _, distance_m = _WGS84.inv(self.lon_deg, self.lat_deg, lon_deg, lat_deg)
        bearing = math.radians(float(bearing_deg))
        return float(distance_m) * math.sin(bearing), float(distance_m) * math.cos(bearing)

    def to_local_all(self, lats_deg: Sequence[float], lons_deg: Sequence[float]) -> list[tuple[float, float]]:
        """Return (x_m east, y_m north) of many WGS 84 positions, to a centimetre."""
        if not lats_deg:
            return []
        ones = np.ones(len(lats_deg))
        found = _WGS84.inv(self.lon_deg * ones, self.lat_deg * ones, np.asarray(lons_deg), np.asarray(lats_deg))
        bearing, far_m = np.radians(np.asarray(found[0], np.float64)), np.asarray(found[2], np.float64)
        x_m, y_m = (far_m * np.sin(bearing)).round(2), (far_m * np.cos(bearing)).round(2)
        return [(float(x), float(y)) for x, y in zip(x_m, y_m, strict=True)]

    def to_degrees(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return (lat_deg, lon_deg) of a point of this frame."""
        return moved(self.lat_deg, self.lon_deg, math.degrees(math.atan2(x_m, y_m)), math.hypot(x_m, y_m))


def moved(lat_deg: float, lon_deg: float, bearing_deg: float, distance_m: float) -> tuple[float, float]:
    """Return the position a distance away along a true bearing: (lat_deg, lon_deg), WGS 84."""
    lon, lat, _ = _WGS84.fwd(lon_deg, lat_deg, bearing_deg, distance_m)
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
    """Return where the vehicle was when it saw an object abeam: (lat_deg, lon_deg), None where that cannot be told.

    Args:
        lat_deg: Of the object.
        lon_deg: Of the object.
        heading_deg: Of the vehicle, true.
        channel: `port` or `starboard`, the side the object lay on.
        ground_range_m: From the vehicle's track to the object.
    """
    if lat_deg is None or lon_deg is None or heading_deg is None or channel is None or ground_range_m is None:
        return None
    # From the object back: it lay to starboard, so the vehicle was to port of it.
    back_deg = heading_deg - 90.0 if channel == "starboard" else heading_deg + 90.0
    return moved(lat_deg, lon_deg, back_deg, ground_range_m)
