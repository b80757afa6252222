"""Positions for the review: metres around an origin, geodesics, grouping of several looks at one object."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from pyproj import Geod

_WGS84 = Geod(ellps="WGS84")

PASS_S: Final = 60.0
"""Maximum duration of one pass over an object. A vehicle that turns needs more time to return."""


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


@dataclass(frozen=True, slots=True)
class Look:
    """One look at an object. The first look of a group defines the position of the group, so that it cannot drift.

    Attributes:
        group: Name of the group; empty for a new look.
        lat_deg: Latitude, WGS 84.
        lon_deg: Longitude, WGS 84.
        sigma_m: Standard deviation of the position; None if unknown.
        vehicle_id: Vehicle.
        seen_utc_s: Time of detection; None if unknown.
    """

    group: str
    lat_deg: float
    lon_deg: float
    sigma_m: float | None = None
    vehicle_id: str = ""
    seen_utc_s: float | None = None


def group_distance_limit_m(radius_m: float, *sigmas_m: float | None) -> float:
    """Return the maximum distance between two looks at one object.

    It is two standard deviations of the difference, at least `radius_m` and at most four times `radius_m`. The upper
    limit prevents that uncertain positions join a whole field of objects.
    """
    spread_m = 2.0 * math.hypot(*(sigma_m or 0.0 for sigma_m in sigmas_m))
    return min(max(radius_m, spread_m), 4.0 * radius_m)


def is_same_pass(one: Look, other: Look) -> bool:
    """Return whether one vehicle made both looks on one pass. Its navigation error is then common to both."""
    if one.vehicle_id != other.vehicle_id or one.seen_utc_s is None or other.seen_utc_s is None:
        return False
    return abs(one.seen_utc_s - other.seen_utc_s) < PASS_S


def nearest_group(look: Look, groups: Iterable[Look], radius_m: float) -> str | None:
    """Return the nearest group within the distance limit; None if the look starts a new group.

    Args:
        look: The new look.
        groups: First looks of the groups nearby.
        radius_m: Distance limit for accurate positions. For looks of one pass the limit is a quarter of it.
    """
    found: tuple[float, str] | None = None
    for first in groups:
        apart_m = distance_m(look.lat_deg, look.lon_deg, first.lat_deg, first.lon_deg)
        same_pass = is_same_pass(look, first)
        limit_m = radius_m / 4 if same_pass else group_distance_limit_m(radius_m, look.sigma_m, first.sigma_m)
        if apart_m <= limit_m and (found is None or apart_m < found[0]):
            found = (apart_m, first.group)
    return None if found is None else found[1]
