"""Lengths on an image in metres, and the height of an object from its shadow, with their uncertainty."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from sonarpost.errors import BadInputError
from sonarpost.messages import Contact, ReconstructedImage
from sonarpost.review.rendering import LAYERS

CLICK_SIGMA_PX: Final = 0.7
"""Standard deviation of a point that a person sets on an edge, along each axis."""

SCALE_SIGMA: Final = 0.025
"""Relative standard deviation of the pixel size, which is transmitted in steps of 2.5 %."""

ALTITUDE_SIGMA_M: Final = 0.25
"""Standard deviation of the altitude, which is transmitted in steps of 0.5 m."""

Point = tuple[float, float]
MeasurementKind = Literal["length", "width", "shadow"]


class NotMeasurableError(BadInputError):
    """This part of the image cannot be measured."""


@dataclass(frozen=True, slots=True)
class Line:
    """A line on an image.

    Attributes:
        version: Version of the image.
        layer: Name of the displayed layer.
        kind: Quantity to measure.
        start: (row, column) in pixels from the upper left corner; (0.5, 0.5) is the centre of the first pixel.
        end: (row, column) of the other end.
    """

    version: int
    layer: str
    kind: MeasurementKind
    start: Point
    end: Point


@dataclass(frozen=True, slots=True)
class Length:
    """A length on the seabed.

    Attributes:
        value_m: Length.
        sigma_m: Its standard deviation.
        along_m: Component along the track.
        across_m: Component across the track.
        missing_fraction: Fraction of the line on pixels that were not received.
    """

    value_m: float
    sigma_m: float
    along_m: float
    across_m: float
    missing_fraction: float


@dataclass(frozen=True, slots=True)
class Height:
    """Height of an object above a flat seabed.

    Attributes:
        height_m: shadow x altitude / (slant range + shadow).
        sigma_m: Its standard deviation.
        altitude_m: Altitude of the vehicle.
        slant_range_m: Slant range to the object.
    """

    height_m: float
    sigma_m: float
    altitude_m: float
    slant_range_m: float


def measure_line(image: ReconstructedImage, line: Line) -> dict[str, object]:
    """Measure a line on an image; return the fields of a measurement of the console's HTTP interface.

    Raises:
        NotMeasurableError: The layer is synthesised, no image was received, or see `measure_length`.
    """
    layer = next((layer for layer in LAYERS if layer.name == line.layer), None)
    if layer is None:
        raise NotMeasurableError("image", "layer", line.layer, " or ".join(layer.name for layer in LAYERS))
    if not layer.measurable:
        raise NotMeasurableError("image", "layer", line.layer, f"the raw image: {layer.reason}")
    if not image.codec:
        raise NotMeasurableError("image", "version", line.version, "a version with received pixels")
    length = measure_length(image.contact, image.missing(), line.start, line.end)
    body: dict[str, object] = {
        "kind": line.kind,
        "version": line.version,
        "layer": line.layer,
        "from": list(line.start),
        "to": list(line.end),
        **asdict(length),
        "height_m": None,
        "height_sigma_m": None,
        "height_inputs": None,
        "note": "",
    }
    if line.kind != "shadow" or image.contact is None:
        return body
    height = height_from_shadow(image.contact, length)
    if height is None:
        return {**body, "note": "no height: altitude of the vehicle or range of the object unknown"}
    inputs = {"shadow_m": length.value_m, "altitude_m": height.altitude_m, "slant_range_m": height.slant_range_m}
    return {**body, "height_m": height.height_m, "height_sigma_m": height.sigma_m, "height_inputs": inputs}


def measure_length(contact: Contact | None, missing: npt.NDArray[np.bool_], start: Point, end: Point) -> Length:
    """Measure the length of a line on an image.

    Args:
        contact: Contact record with the pixel size.
        missing: Shape (height_px, width_px), true for pixels that were not received.
        start: (row, column) of one end; see `Line`.
        end: (row, column) of the other end.

    Raises:
        NotMeasurableError: The pixel size is unknown, an end is outside the image, both ends are equal, or the line
            crosses a missing pixel.
    """
    if contact is None or contact.pixel_along_m is None or contact.pixel_across_m is None:
        raise NotMeasurableError("image", "pixel_along_m, pixel_across_m", None, "the size of a pixel in metres")
    height_px, width_px = missing.shape
    for name, (row, column) in (("from", start), ("to", end)):
        if not (0 <= row <= height_px and 0 <= column <= width_px):
            raise NotMeasurableError("image", name, (row, column), f"a point within {width_px} × {height_px} px")
    if start == end:
        raise NotMeasurableError("image", "to", end, "a point different from `from`")
    missing_fraction = _fraction_on(missing, start, end)
    if missing_fraction > 0:
        got = f"{missing_fraction:.0%} not received"
        raise NotMeasurableError("image", "line", got, "a line over received pixels only")
    along_m = (end[0] - start[0]) * contact.pixel_along_m
    across_m = (end[1] - start[1]) * contact.pixel_across_m
    value_m = math.hypot(along_m, across_m)
    # Variance of both ends along the direction of the line.
    variance = (2.0 * CLICK_SIGMA_PX**2) * (
        (along_m / value_m * contact.pixel_along_m) ** 2 + (across_m / value_m * contact.pixel_across_m) ** 2
    )
    sigma_m = math.sqrt(variance + (SCALE_SIGMA * value_m) ** 2)
    return Length(value_m, sigma_m, abs(along_m), abs(across_m), missing_fraction)


def _fraction_on(mask: npt.NDArray[np.bool_], start: Point, end: Point) -> float:
    """Return the fraction of a line on true pixels."""
    steps = 2 * math.ceil(max(abs(end[0] - start[0]), abs(end[1] - start[1]))) + 1
    rows = np.linspace(start[0], end[0], steps).astype(int).clip(0, mask.shape[0] - 1)
    columns = np.linspace(start[1], end[1], steps).astype(int).clip(0, mask.shape[1] - 1)
    return float(mask[rows, columns].mean())


def height_from_shadow(contact: Contact, shadow: Length) -> Height | None:
    """Return the height of an object from the length of its shadow; None if altitude or range is unknown.

    If the contact record has only the ground range, the slant range is the hypotenuse of ground range and altitude.
    """
    altitude_m, slant_m = contact.altitude_m, contact.slant_range_m
    if slant_m is None and contact.ground_range_m is not None and altitude_m is not None:
        slant_m = math.hypot(contact.ground_range_m, altitude_m)
    if altitude_m is None or slant_m is None or slant_m + shadow.value_m <= 0:
        return None
    shadow_end_m = slant_m + shadow.value_m
    height_m = shadow.value_m * altitude_m / shadow_end_m
    sigma_from_shadow_m = altitude_m * slant_m / shadow_end_m**2 * shadow.sigma_m
    sigma_from_altitude_m = shadow.value_m / shadow_end_m * ALTITUDE_SIGMA_M
    return Height(height_m, math.hypot(sigma_from_shadow_m, sigma_from_altitude_m), altitude_m, slant_m)
