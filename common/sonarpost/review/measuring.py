"""Lengths on a picture in metres, and the height of an object from its shadow, each with its uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.errors import BadInputError
from sonarpost.messages import Contact

CLICK_SIGMA_PX: Final = 0.7
"""How well a person meets an edge, of each end along each axis."""

SCALE_SIGMA: Final = 0.025
"""Of a pixel's size: it travels in steps of 2.5 %."""

ALTITUDE_SIGMA_M: Final = 0.25
"""The altitude travels in steps of 0.5 m."""

Point = tuple[float, float]


class NotMeasurableError(BadInputError):
    """A length cannot be told from this picture at this place."""


@dataclass(frozen=True, slots=True)
class Length:
    """A length on the bottom.

    Attributes:
        value_m: The length.
        sigma_m: Its standard deviation.
        along_m: Its part along the track.
        across_m: Its part across the track.
        missing_fraction: How much of the line lies where nothing was received.
    """

    value_m: float
    sigma_m: float
    along_m: float
    across_m: float
    missing_fraction: float


@dataclass(frozen=True, slots=True)
class Height:
    """The height of an object above a flat bottom.

    Attributes:
        height_m: shadow x altitude / (slant range + shadow).
        sigma_m: Its standard deviation.
        altitude_m: Of the vehicle, that was used.
        slant_range_m: To the object, that was used.
    """

    height_m: float
    sigma_m: float
    altitude_m: float
    slant_range_m: float


def measure_length(contact: Contact | None, missing: npt.NDArray[np.bool_], start: Point, end: Point) -> Length:
    """Return the length of a line on a picture.

    Args:
        contact: For the size of a pixel.
        missing: Shape (height_px, width_px), true where the picture is not measured.
        start: (row, column) in pixels from the upper left corner; (0.5, 0.5) is the middle of the first pixel.
        end: The other end.

    Raises:
        NotMeasurableError: The size of a pixel is not known, an end lies outside the picture, the ends are one point,
            or the line crosses pixels that are not measured.
    """
    where = "picture"
    if contact is None or contact.pixel_along_m is None or contact.pixel_across_m is None:
        raise NotMeasurableError(where, "pixel_along_m, pixel_across_m", None, "the size of a pixel in metres")
    height_px, width_px = missing.shape
    for name, (row, column) in (("from", start), ("to", end)):
        if not (0 <= row <= height_px and 0 <= column <= width_px):
            raise NotMeasurableError(where, name, (row, column), f"a point within {height_px} x {width_px} px")
    if start == end:
        raise NotMeasurableError(where, "to", end, "another point than `from`")
    share = _share_on(missing, start, end)
    if share > 0:
        raise NotMeasurableError(where, "line", f"{share:.0%} not received", "a line over received pixels only")
    along_m = (end[0] - start[0]) * contact.pixel_along_m
    across_m = (end[1] - start[1]) * contact.pixel_across_m
    value_m = math.hypot(along_m, across_m)
    click = 2.0 * CLICK_SIGMA_PX**2
    # The uncertainty of both ends, along the line's own direction.
    variance = click * (
        (along_m / value_m * contact.pixel_along_m) ** 2 + (across_m / value_m * contact.pixel_across_m) ** 2
    )
    sigma_m = math.sqrt(variance + (SCALE_SIGMA * value_m) ** 2)
    return Length(value_m, sigma_m, abs(along_m), abs(across_m), share)


def _share_on(missing: npt.NDArray[np.bool_], start: Point, end: Point) -> float:
    """Return how much of a line lies on true pixels."""
    steps = 2 * math.ceil(max(abs(end[0] - start[0]), abs(end[1] - start[1]))) + 1
    rows = np.linspace(start[0], end[0], steps).astype(int).clip(0, missing.shape[0] - 1)
    columns = np.linspace(start[1], end[1], steps).astype(int).clip(0, missing.shape[1] - 1)
    return float(missing[rows, columns].mean())


def slant_range_of(contact: Contact) -> float | None:
    """Return the slant range to an object in metres, from its ground range where only that travelled; None: unknown."""
    if contact.slant_range_m is not None:
        return contact.slant_range_m
    if contact.ground_range_m is None or contact.altitude_m is None:
        return None
    return math.hypot(contact.ground_range_m, contact.altitude_m)


def height_from_shadow(contact: Contact, shadow: Length) -> Height | None:
    """Return the height of an object from the length of its shadow; None where altitude or range is not known."""
    altitude_m, slant_m = contact.altitude_m, slant_range_of(contact)
    if altitude_m is None or slant_m is None or slant_m + shadow.value_m <= 0:
        return None
    whole_m = slant_m + shadow.value_m
    height_m = shadow.value_m * altitude_m / whole_m
    by_shadow = altitude_m * slant_m / whole_m**2 * shadow.sigma_m
    by_altitude = shadow.value_m / whole_m * ALTITUDE_SIGMA_M
    return Height(height_m, math.hypot(by_shadow, by_altitude), altitude_m, slant_m)
