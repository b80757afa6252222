"""Grouping of several looks at one object by position."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from sonarpost.review.local_frame import distance_m

PASS_S: Final = 60.0
"""Maximum duration of one pass over an object. A vehicle that turns needs more time to return."""


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
