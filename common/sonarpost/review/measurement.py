"""Lengths on an image in metres, and the height of an object from its shadow, with their uncertainty.

Columns of an image in slant range are converted to metres on a flat seabed for length and width: ground = sqrt(slant² -
altitude²). A shadow stays in slant range, as the formula of the height requires.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from sonarpost.errors import BadInputError
from sonarpost.messages import Contact, ReconstructedImage
from sonarpost.review.edge_blur import edge_sigma_px
from sonarpost.review.image_geometry import contact_mark, mark_sigma_m, range_axis, slant_range_m
from sonarpost.review.rendering import LAYERS

CLICK_SIGMA_PX: Final = 0.7
"""Standard deviation of a point that a person sets on an edge, along each axis."""

SCALE_SIGMA: Final = 0.025
"""Relative standard deviation of the pixel size, which is transmitted in steps of 2.5 %."""

ALTITUDE_SIGMA_M: Final = 0.25
"""Standard deviation of the altitude, which is transmitted in steps of 0.5 m."""

UNCONVERTED_SIGMA: Final = 0.2
"""Relative standard deviation of an across-track length that is not converted from slant to ground range.

The ratio of ground to slant length is 1/cos of the grazing angle: 1.04 to 1.41 for 15° to 45°.
"""

NADIR_LIMIT: Final = 1.05
"""Least ratio of slant range to altitude at which a column is converted to ground range; nearer is the water column."""

Point = tuple[float, float]
MeasurementKind = Literal["length", "width", "shadow"]
Metres = Literal["ground", "slant", "unknown"]
KINDS: Final[tuple[MeasurementKind, ...]] = ("length", "width", "shadow")


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
    """A length on an image in metres.

    Attributes:
        value_m: Length.
        sigma_m: Its standard deviation: the root of the sum of the squares of the following four.
        click_sigma_m: From the ends that a person sets.
        blur_sigma_m: From the blur of the codec at this number of bytes.
        scale_sigma_m: From the pixel size.
        range_sigma_m: From the conversion to ground range, or from its absence.
        along_m: Component along the track.
        across_m: Component across the track.
        metres: Range of the across-track component; "unknown" if the record does not state that of the image.
        missing_fraction: Fraction of the line on pixels that were not received.
    """

    value_m: float
    sigma_m: float
    click_sigma_m: float
    blur_sigma_m: float
    scale_sigma_m: float
    range_sigma_m: float
    along_m: float
    across_m: float
    metres: Metres
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

    A shadow lies across the track: the row of its end is that of its start.

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
    end = (line.start[0], line.end[1]) if line.kind == "shadow" else line.end
    missing = image.missing()
    blur_px = edge_sigma_px(image.codec, image.bytes_received, missing.size)
    length = measure_length(image.contact, missing, line.start, end, blur_px, to_ground=line.kind != "shadow")
    body: dict[str, object] = {
        "kind": line.kind,
        "version": line.version,
        "layer": line.layer,
        "from": list(line.start),
        "to": list(end),
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


class _Line(NamedTuple):
    """Ends of a line in pixels, with the inputs of its conversion to metres."""

    start: Point
    end: Point
    scale: float = 1.0
    altitude_m: float = 0.0
    range_offset_m: float = 0.0


def measure_length(
    contact: Contact | None,
    missing: npt.NDArray[np.bool_],
    start: Point,
    end: Point,
    blur_px: float = 0.0,
    *,
    to_ground: bool = True,
) -> Length:
    """Measure the length of a line on an image.

    Args:
        contact: Contact record with the pixel size.
        missing: Shape (height_px, width_px), true for pixels that were not received.
        start: (row, column) of one end; see `Line`.
        end: (row, column) of the other end.
        blur_px: Standard deviation of an edge in the image along each axis; see `edge_blur`.
        to_ground: Whether to convert slant range to ground range where both range and altitude are known.

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
    line = _Line(start, end, altitude_m=contact.altitude_m or 0.0)
    recorded = _recorded(contact.pixel_along_m, contact.pixel_across_m)
    components, range_sigma_m, metres = recorded, 0.0, range_axis(contact) or "unknown"
    across_m = abs(recorded(line)[1])
    value_m = math.hypot(*recorded(line))
    ground = _ground(contact, missing.shape, start, end)
    if to_ground and metres == "slant" and ground is not None:
        components, metres = ground.components, "ground"
        range_sigma_m = math.hypot(
            _change(components, line, line._replace(altitude_m=line.altitude_m + ALTITUDE_SIGMA_M)),
            _change(components, line, line._replace(range_offset_m=ground.range_sigma_m)),
        )
    elif to_ground and metres != "ground":
        # Not converted: the difference to the ground, or that of a typical grazing angle.
        known = ground is not None and metres == "unknown"
        difference_m = (
            abs(abs(ground.components(line)[1]) - across_m) if known and ground else UNCONVERTED_SIGMA * across_m
        )
        range_sigma_m = across_m / value_m * difference_m
    along_m, across_m = components(line)
    point_sigma_m = _point_sigma(components, line)
    value_m = math.hypot(along_m, across_m)
    sigmas = (
        CLICK_SIGMA_PX * point_sigma_m,
        blur_px * point_sigma_m,
        _change(components, line, line._replace(scale=1.0 + SCALE_SIGMA)),
        range_sigma_m,
    )
    return Length(value_m, math.hypot(*sigmas), *sigmas, abs(along_m), abs(across_m), metres, missing_fraction)


_Components = Callable[[_Line], tuple[float, float]]


class _Ground(NamedTuple):
    """Conversion of a line to metres on the seabed, with the standard deviation of the range of its columns."""

    components: _Components
    range_sigma_m: float


def _recorded(pixel_along_m: float, pixel_across_m: float) -> _Components:
    """Return the function from a line to its components (along, across) in the metres of the image."""

    def components(line: _Line) -> tuple[float, float]:
        (row, column), (end_row, end_column) = line.start, line.end
        along_m = line.scale * (end_row - row) * pixel_along_m
        return along_m, line.scale * (end_column - column) * pixel_across_m

    return components


def _ground(contact: Contact, shape: tuple[int, ...], start: Point, end: Point) -> _Ground | None:
    """Return the conversion from slant to ground range; None if an input is unknown, or for the water column."""
    mark = contact_mark(contact, *shape)
    along_m, across_m, altitude_m = contact.pixel_along_m, contact.pixel_across_m, contact.altitude_m
    if mark is None or along_m is None or across_m is None or altitude_m is None:
        return None
    place, recorded = mark, _recorded(along_m, across_m)
    nearest_m = place.range_m + (min(start[1], end[1]) - place.column) * across_m
    if nearest_m < NADIR_LIMIT * (altitude_m + ALTITUDE_SIGMA_M):
        return None

    def ground_m(line: _Line, column: float) -> float:
        slant_m = place.range_m + line.range_offset_m + line.scale * (column - place.column) * across_m
        return math.sqrt(max(0.0, slant_m**2 - line.altitude_m**2))

    def components(line: _Line) -> tuple[float, float]:
        return recorded(line)[0], ground_m(line, line.end[1]) - ground_m(line, line.start[1])

    return _Ground(components, mark_sigma_m(contact, place))


def _change(components: _Components, line: _Line, changed: _Line) -> float:
    """Return the change of the length."""
    return abs(math.hypot(*components(changed)) - math.hypot(*components(line)))


def _point_sigma(components: _Components, line: _Line) -> float:
    """Return the standard deviation of the length for ends with one pixel of standard deviation along each axis.

    The error of an end is projected on the line.
    """
    total = 0.0
    vector = components(line)
    length_m = math.hypot(*vector)
    for axis, (rows, columns) in enumerate(((0.5, 0.0), (0.0, 0.5))):
        for ahead, behind in (
            (
                line._replace(start=_moved(line.start, rows, columns)),
                line._replace(start=_moved(line.start, -rows, -columns)),
            ),
            (line._replace(end=_moved(line.end, rows, columns)), line._replace(end=_moved(line.end, -rows, -columns))),
        ):
            total += (vector[axis] / length_m * (components(ahead)[axis] - components(behind)[axis])) ** 2
    return math.sqrt(total)


def _moved(point: Point, rows: float, columns: float) -> Point:
    return point[0] + rows, point[1] + columns


def _fraction_on(mask: npt.NDArray[np.bool_], start: Point, end: Point) -> float:
    """Return the fraction of a line on true pixels."""
    steps = 2 * math.ceil(max(abs(end[0] - start[0]), abs(end[1] - start[1]))) + 1
    rows = np.linspace(start[0], end[0], steps).astype(int).clip(0, mask.shape[0] - 1)
    columns = np.linspace(start[1], end[1], steps).astype(int).clip(0, mask.shape[1] - 1)
    return float(mask[rows, columns].mean())


def height_from_shadow(contact: Contact, shadow: Length) -> Height | None:
    """Return the height of an object from the length of its shadow; None if altitude or range is unknown.

    Height over shadow equals altitude over the range of the shadow's end, all in slant range: the ray over the top of
    the object meets the seabed there. If the contact record has only the ground range, the slant range is the
    hypotenuse of ground range and altitude. The same triangle in ground range has the ground range of the object. If
    the range of the image is unknown, the difference of both is part of the uncertainty.
    """
    altitude_m, slant_m = contact.altitude_m, slant_range_m(contact)
    if altitude_m is None or slant_m is None or slant_m + shadow.value_m <= 0:
        return None
    shadow_end_m = slant_m + shadow.value_m
    height_m = shadow.value_m * altitude_m / shadow_end_m
    sigmas = [
        altitude_m * slant_m / shadow_end_m**2 * shadow.sigma_m,
        shadow.value_m / shadow_end_m * ALTITUDE_SIGMA_M,
    ]
    if shadow.metres == "unknown":
        ground_m = math.sqrt(max(0.0, slant_m**2 - altitude_m**2))
        sigmas.append(shadow.value_m * altitude_m / (ground_m + shadow.value_m) - height_m)
    return Height(height_m, math.hypot(*sigmas), altitude_m, slant_m)


def summary(measurements: Sequence[Mapping[str, object]]) -> dict[str, dict[str, object] | None]:
    """Return length, width, height and shadow of a contact from its measurements, the last of each kind.

    Args:
        measurements: Stored measurements, oldest first; withdrawn ones (`withdrawn_utc_s` not None) do not count.

    Returns:
        By `length`, `width`, `shadow` and `height`: `value_m`, `sigma_m` and `measurement`, the identifier of the
        measurement; None if not measured.
    """
    size: dict[str, dict[str, object] | None] = dict.fromkeys((*KINDS, "height"))
    for one in measurements:
        if one.get("withdrawn_utc_s") is not None:
            continue
        found = {"measurement": one["id"]}
        size[str(one["kind"])] = {"value_m": one["value_m"], "sigma_m": one["sigma_m"], **found}
        if one["kind"] == "shadow":
            height_m = one["height_m"]
            values = {"value_m": height_m, "sigma_m": one["height_sigma_m"], **found}
            size["height"] = None if height_m is None else values
    return size
