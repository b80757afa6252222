"""Several looks at one object, found by position."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from sonarpost.review.local import distance_m

PASS_S: Final = 60.0
"""An object is in the beam for seconds; a vehicle that turns round comes back after more than this."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a group of looks is: the position of its first look, so that a group cannot creep along a row of objects.

    Attributes:
        group: Its name.
        lat_deg: WGS 84.
        lon_deg: WGS 84.
        sigma_m: Standard deviation of that position; None where it is not known.
        vehicle_id: That looked first.
        seen_utc_s: When it did; None where that is not known.
    """

    group: str
    lat_deg: float
    lon_deg: float
    sigma_m: float | None = None
    vehicle_id: str = ""
    seen_utc_s: float | None = None


def reach_m(radius_m: float, *sigmas_m: float | None) -> float:
    """Return how far apart two looks at one object may lie.

    Two standard deviations of the difference, at least `radius_m`, and at most four times that: positions that are
    hardly known must not make one object of a whole field.
    """
    spread_m = 2.0 * math.hypot(*(sigma_m or 0.0 for sigma_m in sigmas_m))
    return min(max(radius_m, spread_m), 4.0 * radius_m)


def same_pass(one: Place, other: Place) -> bool:
    """Tell whether one vehicle saw both on one run past them.

    The error of its navigation is then the same for both, so that what lies apart is two things however badly their
    positions are known.
    """
    if one.vehicle_id != other.vehicle_id or one.seen_utc_s is None or other.seen_utc_s is None:
        return False
    return abs(one.seen_utc_s - other.seen_utc_s) < PASS_S


def nearest_group(look: Place, places: Iterable[Place], radius_m: float) -> str | None:
    """Return the group of the nearest place within reach, None where a look begins a group of its own.

    Args:
        look: The new look; its `group` is of no account.
        places: Of the groups around.
        radius_m: Reach where positions are well known; on one pass a quarter of it, for an object that was found twice.
    """
    found: tuple[float, str] | None = None
    for place in places:
        apart_m = distance_m(look.lat_deg, look.lon_deg, place.lat_deg, place.lon_deg)
        limit_m = radius_m / 4 if same_pass(look, place) else reach_m(radius_m, look.sigma_m, place.sigma_m)
        if apart_m <= limit_m and (found is None or apart_m < found[0]):
            found = (apart_m, place.group)
    return None if found is None else found[1]
