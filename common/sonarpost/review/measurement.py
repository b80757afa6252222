"""Lengths on an image in metres, and the height of an object from its shadow, with their uncertainty.

The ends of a length or width move to half brightness (`highlight_ends`). The widths of the beam and of the codec's blur
are then subtracted in quadrature. `python -m research.lengths` compares the results with simulated objects.

Columns of an image in slant range are converted to metres on a flat seabed for length and width: ground = sqrt(slant² -
altitude²). A shadow stays in slant range, as the formula of the height requires.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from sonarpost.errors import BadInputError
from sonarpost.messages import Contact, ReconstructedImage
from sonarpost.review.highlight_ends import Point, snapped_ends
from sonarpost.review.image_geometry import contact_mark, mark_sigma_m, range_axis, slant_range_m
from sonarpost.review.rendering import eight_bits
from sonarpost.review.resolution import CODEBOOK_CODECS, FULL_WIDTH, blur_px, codebook_edge_px

SHADOW_SIGMA_PX: Final = 0.7
"""Standard deviation of the end of a shadow that a person sets, along each axis."""

SNAPPED_SIGMA_PX: Final = 1.0
"""Standard deviation of an end at half brightness, along each axis."""

UNSNAPPED_SIGMA_PX: Final = 3.0
"""The same of an end without half brightness, which stays where a person has set it."""

HIGHLIGHT_SIGMA_M: Final = (0.05, 0.18)
"""Standard deviation between a highlight and its object, along and across the track.

Across the track the far side of an object is not insonified, and its upper edge is displaced towards the vehicle.
"""

BLUR_SIGMA: Final = 0.5
"""Relative standard deviation of the correction for beam and blur."""

NEAR_FIELD_M: Final = 0.12
"""Width of the beam near the vehicle: the effective length of the array."""

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

MeasurementKind = Literal["length", "width", "shadow"]
RangeKind = Literal["ground", "slant", "unknown"]
MEASURED_LAYER: Final = "raw"
"""Layer of the received pixels."""
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
        edge_sigma_m: From the ends of the line, and from the difference of a highlight to its object.
        blur_sigma_m: From the correction for beam and blur; of a shadow, from the blur of the codec.
        scale_sigma_m: From the pixel size.
        range_sigma_m: From the conversion to ground range, or from its absence.
        blur_m: Width of beam and blur along the line, which is subtracted in quadrature from the length of the line.
        along_m: Component along the track.
        across_m: Component across the track.
        metres: Range of the across-track component; "unknown" if the record does not state that of the image.
        missing_fraction: Fraction of the line on pixels that were not received.
    """

    value_m: float
    sigma_m: float
    edge_sigma_m: float
    blur_sigma_m: float
    scale_sigma_m: float
    range_sigma_m: float
    blur_m: float
    along_m: float
    across_m: float
    metres: RangeKind
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


def measure_line(image: ReconstructedImage, line: Line, beam_width_deg: float) -> dict[str, object]:
    """Measure a line on an image; return the fields of a measurement of the console's HTTP interface.

    The ends of a length or width move to half brightness. A shadow lies across the track: the row of its end is that of
    its start.

    Args:
        image: Image of the contact.
        line: Line as a person has drawn it.
        beam_width_deg: Horizontal beam width of the sonar between half-power points; 0 for no correction.

    Raises:
        NotMeasurableError: The layer is another image, no image was received, or see `measure_length`.
    """
    if line.layer != MEASURED_LAYER:
        raise NotMeasurableError("image", "layer", line.layer, MEASURED_LAYER)
    if not image.codec:
        raise NotMeasurableError("image", "version", line.version, "a version with received pixels")
    contact, missing = image.contact, image.missing()
    codec_px = blur_px(image.codec, image.bytes_received, missing.size)
    # In an image of codebook entries an edge may be anywhere within a tile on either side.
    has_codebook = image.codec in CODEBOOK_CODECS
    tile_px = codebook_edge_px(image.bytes_total or image.bytes_received, missing.size) if has_codebook else 0
    if line.kind == "shadow":
        end = line.start[0], line.end[1]
        sigma_px = math.hypot(SHADOW_SIGMA_PX, tile_px / math.sqrt(3.0))
        length = measure_length(contact, missing, line.start, end, (sigma_px, sigma_px), to_ground=False)
        length = _with_shadow_blur(length, contact, codec_px)
        return {**_body(line, line.start, end, (True, True), length), **_height(contact, length)}
    # The line as it was drawn is checked first.
    measure_length(contact, missing, line.start, line.end)
    places = snapped_ends(eight_bits(image.pixels.to_array()), missing, line.start, line.end)
    found = (places[0] is not None, places[1] is not None)
    start, end = places[0] or line.start, places[1] or line.end
    sigmas_px = tuple(
        math.hypot(SNAPPED_SIGMA_PX if snapped else UNSNAPPED_SIGMA_PX, tile_px / math.sqrt(3.0)) for snapped in found
    )
    highlight = measure_length(contact, missing, start, end, (sigmas_px[0], sigmas_px[1]))
    length = _without_blur(highlight, contact, abs(end[1] - start[1]), codec_px, beam_width_deg)
    return _body(line, start, end, found, length)


def _body(line: Line, start: Point, end: Point, snapped: tuple[bool, bool], length: Length) -> dict[str, object]:
    return {
        "kind": line.kind,
        "version": line.version,
        "layer": line.layer,
        "from": list(start),
        "to": list(end),
        "snapped": list(snapped),
        **asdict(length),
        "height_m": None,
        "height_sigma_m": None,
        "height_inputs": None,
    }


def _height(contact: Contact | None, shadow: Length) -> dict[str, object]:
    """Return the fields of the height; empty if altitude or range is unknown."""
    height = None if contact is None else height_from_shadow(contact, shadow)
    if height is None:
        return {}
    inputs = {"shadow_m": shadow.value_m, "altitude_m": height.altitude_m, "slant_range_m": height.slant_range_m}
    return {"height_m": height.height_m, "height_sigma_m": height.sigma_m, "height_inputs": inputs}


def _without_blur(length: Length, contact: Contact | None, columns: float, codec_px: float, beam_deg: float) -> Length:
    """Return the length of a highlight without beam and blur, whose widths are subtracted in quadrature.

    The beam blurs along the track. At least half of the length remains.

    Args:
        length: Length between the places of half brightness.
        contact: Contact record.
        columns: Columns of the line.
        codec_px: Full width of the codec's blur at half maximum.
        beam_deg: Beam width between half-power points.
    """
    if contact is None or contact.pixel_along_m is None:
        return length
    range_m = slant_range_m(contact) or 0.0
    beam_m = math.hypot(NEAR_FIELD_M, range_m * math.radians(beam_deg)) if beam_deg > 0 else 0.0
    along, across = length.along_m / length.value_m, length.across_m / length.value_m
    column_m = length.across_m / columns if columns > 0 else 0.0
    blur_m = math.hypot(along * math.hypot(beam_m, codec_px * contact.pixel_along_m), across * codec_px * column_m)
    value_m = math.sqrt(max(length.value_m**2 - blur_m**2, (length.value_m / 2) ** 2))
    highlight_sigmas_m = along * HIGHLIGHT_SIGMA_M[0], across * HIGHLIGHT_SIGMA_M[1]
    edge_sigma_m = math.hypot(length.edge_sigma_m, *highlight_sigmas_m)
    blur_sigma_m = BLUR_SIGMA * (length.value_m - value_m)
    return replace(
        length,
        value_m=value_m,
        sigma_m=math.hypot(edge_sigma_m, blur_sigma_m, length.scale_sigma_m, length.range_sigma_m),
        edge_sigma_m=edge_sigma_m,
        blur_sigma_m=blur_sigma_m,
        blur_m=blur_m,
        along_m=along * value_m,
        across_m=across * value_m,
    )


def _with_shadow_blur(shadow: Length, contact: Contact | None, codec_px: float) -> Length:
    """Return a shadow whose two ends have half of the codec's blur as a further standard deviation."""
    if contact is None or contact.pixel_across_m is None:
        return shadow
    blur_sigma_m = math.sqrt(2.0) * codec_px / FULL_WIDTH / 2 * contact.pixel_across_m
    return replace(shadow, blur_sigma_m=blur_sigma_m, sigma_m=math.hypot(shadow.sigma_m, blur_sigma_m))


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
    sigmas_px: tuple[float, float] = (0.0, 0.0),
    *,
    to_ground: bool = True,
) -> Length:
    """Measure the length of a line on an image, without correction for blur.

    Args:
        contact: Contact record with the pixel size.
        missing: Shape (height_px, width_px), true for pixels that were not received.
        start: (row, column) of one end; see `Line`.
        end: (row, column) of the other end.
        sigmas_px: Standard deviations of both ends, along each axis.
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
    value_m = math.hypot(along_m, across_m)
    sigmas = (
        _edge_sigma(components, line, sigmas_px),
        0.0,
        _change(components, line, line._replace(scale=1.0 + SCALE_SIGMA)),
        range_sigma_m,
    )
    return Length(value_m, math.hypot(*sigmas), *sigmas, 0.0, abs(along_m), abs(across_m), metres, missing_fraction)


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


def _edge_sigma(components: _Components, line: _Line, sigmas_px: tuple[float, float]) -> float:
    """Return the standard deviation of the length from those of its ends along each axis, projected on the line."""
    total = 0.0
    vector = components(line)
    length_m = math.hypot(*vector)
    for axis, (rows, columns) in enumerate(((0.5, 0.0), (0.0, 0.5))):
        for sigma_px, ahead, behind in (
            (
                sigmas_px[0],
                line._replace(start=_moved(line.start, rows, columns)),
                line._replace(start=_moved(line.start, -rows, -columns)),
            ),
            (
                sigmas_px[1],
                line._replace(end=_moved(line.end, rows, columns)),
                line._replace(end=_moved(line.end, -rows, -columns)),
            ),
        ):
            total += (sigma_px * vector[axis] / length_m * (components(ahead)[axis] - components(behind)[axis])) ** 2
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
