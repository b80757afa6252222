"""Several looks at one object, found by position."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from sonarpost.review.local import distance_m


@dataclass(frozen=True, slots=True)
class Place:
    """Where a group of looks is: the position of its first look, so that a group cannot creep along a row of objects.

    Attributes:
        group: Its name.
        lat_deg: WGS 84.
        lon_deg: WGS 84.
        sigma_m: Standard deviation of that position; None where it is not known.
    """

    group: str
    lat_deg: float
    lon_deg: float
    sigma_m: float | None


def reach_m(radius_m: float, *sigmas_m: float | None) -> float:
    """Return how far apart two looks at one object may lie.

    Two standard deviations of the difference, at least `radius_m`, and at most four times that: positions that are
    hardly known must not make one object of a whole field.
    """
    spread_m = 2.0 * math.hypot(*(sigma_m or 0.0 for sigma_m in sigmas_m))
    return min(max(radius_m, spread_m), 4.0 * radius_m)


def nearest_group(
    lat_deg: float, lon_deg: float, sigma_m: float | None, places: Iterable[Place], radius_m: float
) -> str | None:
    """Return the group of the nearest place within reach, None where a look begins a group of its own.

    Args:
        lat_deg: Of the new look, WGS 84.
        lon_deg: Of the new look, WGS 84.
        sigma_m: Standard deviation of its position; None where it is not known.
        places: Of the groups around.
        radius_m: Reach where positions are well known.
    """
    found: tuple[float, str] | None = None
    for place in places:
        apart_m = distance_m(lat_deg, lon_deg, place.lat_deg, place.lon_deg)
        if apart_m <= reach_m(radius_m, sigma_m, place.sigma_m) and (found is None or apart_m < found[0]):
            found = (apart_m, place.group)
    return None if found is None else found[1]
