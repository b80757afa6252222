"""Lengths on an image in metres, the height of an object from its shadow, with their uncertainty; size of an object.

The ends of a length or width move to half brightness (`highlight_ends`). The widths of the beam and of the codec's blur
are then subtracted in quadrature. `python -m research.lengths` compares the results with simulated objects.

Columns of an image in slant range are converted to metres on a flat seabed for length and width: ground = sqrt(slant² -
altitude²). A shadow stays in slant range, as the formula of the height requires.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from itertools import product
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from sonarpost.errors import BadInputError
from sonarpost.messages import Contact, ReconstructedImage
from sonarpost.review.highlight_ends import Point, snapped_ends
from sonarpost.review.image_geometry import Mark, contact_mark, mark_sigma_m, range_axis, slant_range_m
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
        height = {} if contact is None else height_from_shadow(contact, length)
        return {**_body(line, line.start, end, (True, True), length), **height}
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
    pixel_m = contact.pixel_along_m, contact.pixel_across_m
    recorded: _Components = partial(_components, pixel_m, None)
    components, range_sigma_m, metres = recorded, 0.0, range_axis(contact) or "unknown"
    mark = _mark_on_ground(contact, missing.shape, start, end)
    if mark is not None and to_ground and metres == "slant":
        components, metres = partial(_components, pixel_m, mark), "ground"
        range_sigma_m = math.hypot(
            _change(components, line, line._replace(altitude_m=line.altitude_m + ALTITUDE_SIGMA_M)),
            _change(components, line, line._replace(range_offset_m=mark_sigma_m(contact, mark))),
        )
    elif to_ground and metres != "ground":
        # Not converted: the difference to the ground, or that of a typical grazing angle.
        across_m, difference_m = abs(recorded(line)[1]), UNCONVERTED_SIGMA * abs(recorded(line)[1])
        if mark is not None and metres == "unknown":
            difference_m = abs(abs(_components(pixel_m, mark, line)[1]) - across_m)
        range_sigma_m = across_m / math.hypot(*recorded(line)) * difference_m
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


def _components(pixel_m: tuple[float, float], mark: Mark | None, line: _Line) -> tuple[float, float]:
    """Return the components (along, across) of a line in metres: on the seabed, without a mark those of the image."""
    along_m = line.scale * (line.end[0] - line.start[0]) * pixel_m[0]
    if mark is None:
        return along_m, line.scale * (line.end[1] - line.start[1]) * pixel_m[1]
    start_m, end_m = (
        mark.range_m + line.range_offset_m + line.scale * (column - mark.column) * pixel_m[1]
        for _, column in (line.start, line.end)
    )
    start_m, end_m = (math.sqrt(max(0.0, slant_m**2 - line.altitude_m**2)) for slant_m in (start_m, end_m))
    return along_m, end_m - start_m


def _mark_on_ground(contact: Contact, shape: tuple[int, ...], start: Point, end: Point) -> Mark | None:
    """Return the mark, from which slant is converted to ground range; None if unknown, or for the water column."""
    mark = contact_mark(contact, *shape)
    if mark is None or contact.pixel_across_m is None or contact.altitude_m is None:
        return None
    nearest_m = mark.range_m + (min(start[1], end[1]) - mark.column) * contact.pixel_across_m
    return None if nearest_m < NADIR_LIMIT * (contact.altitude_m + ALTITUDE_SIGMA_M) else mark


def _change(components: _Components, line: _Line, changed: _Line) -> float:
    """Return the change of the length."""
    return abs(math.hypot(*components(changed)) - math.hypot(*components(line)))


def _edge_sigma(components: _Components, line: _Line, sigmas_px: tuple[float, float]) -> float:
    """Return the standard deviation of the length from those of its ends along each axis, projected on the line."""
    total = 0.0
    vector = components(line)
    length_m = math.hypot(*vector)
    for axis, name in product((0, 1), ("start", "end")):
        change = components(_moved(line, name, axis, 0.5))[axis] - components(_moved(line, name, axis, -0.5))[axis]
        total += (sigmas_px[name == "end"] * vector[axis] / length_m * change) ** 2
    return math.sqrt(total)


def _moved(line: _Line, name: str, axis: int, step_px: float) -> _Line:
    """Return a line whose `start` or `end` is moved along the rows (axis 0) or the columns."""
    point = list(getattr(line, name))
    point[axis] += step_px
    changes: dict[str, Any] = {name: (point[0], point[1])}
    return line._replace(**changes)


def _fraction_on(mask: npt.NDArray[np.bool_], start: Point, end: Point) -> float:
    """Return the fraction of a line on true pixels."""
    steps = 2 * math.ceil(max(abs(end[0] - start[0]), abs(end[1] - start[1]))) + 1
    rows = np.linspace(start[0], end[0], steps).astype(int).clip(0, mask.shape[0] - 1)
    columns = np.linspace(start[1], end[1], steps).astype(int).clip(0, mask.shape[1] - 1)
    return float(mask[rows, columns].mean())


def height_from_shadow(contact: Contact, shadow: Length) -> dict[str, object]:
    """Return the fields of the height of an object in a measurement; empty if altitude or range is unknown.

    Height over shadow equals altitude over the range of the shadow's end, all in slant range: the ray over the top of
    the object meets the flat seabed there. If the contact record has only the ground range, the slant range is the
    hypotenuse of ground range and altitude. The same triangle in ground range has the ground range of the object. If
    the range of the image is unknown, the difference of both is part of the uncertainty.
    """
    altitude_m, slant_m = contact.altitude_m, slant_range_m(contact)
    if altitude_m is None or slant_m is None or slant_m + shadow.value_m <= 0:
        return {}
    shadow_end_m = slant_m + shadow.value_m
    height_m = shadow.value_m * altitude_m / shadow_end_m
    sigmas = [
        altitude_m * slant_m / shadow_end_m**2 * shadow.sigma_m,
        shadow.value_m / shadow_end_m * ALTITUDE_SIGMA_M,
    ]
    if shadow.metres == "unknown":
        ground_m = math.sqrt(max(0.0, slant_m**2 - altitude_m**2))
        sigmas.append(shadow.value_m * altitude_m / (ground_m + shadow.value_m) - height_m)
    inputs = {"shadow_m": shadow.value_m, "altitude_m": altitude_m, "slant_range_m": slant_m}
    return {"height_m": height_m, "height_sigma_m": math.hypot(*sigmas), "height_inputs": inputs}


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


@dataclass(frozen=True, slots=True)
class MeasuredSize:
    """Latest measurement of each quantity, with its standard deviation; None if operators did not measure it.

    Attributes:
        length_m: Length of the object.
        length_sigma_m: Its standard deviation.
        width_m: Width of the object.
        width_sigma_m: Its standard deviation.
        shadow_m: Length of the shadow.
        shadow_sigma_m: Its standard deviation.
        height_m: Height above the seabed, from the shadow.
        height_sigma_m: Its standard deviation.
    """

    length_m: float | None = None
    length_sigma_m: float | None = None
    width_m: float | None = None
    width_sigma_m: float | None = None
    shadow_m: float | None = None
    shadow_sigma_m: float | None = None
    height_m: float | None = None
    height_sigma_m: float | None = None

    @property
    def text(self) -> str:
        """Measured quantities for people: L 1.84 ± 0.09 m, W 0.52 ± 0.06 m; empty without measurements."""
        return ", ".join(f"{letter} {value}" for letter, value in self.rows().items())

    def rows(self) -> dict[str, str]:
        """Return the measured quantities as text by their letter: L, W, shadow, H."""
        found = {}
        for letter, kind in (("L", "length"), ("W", "width"), ("shadow", "shadow"), ("H", "height")):
            value_m, sigma_m = getattr(self, f"{kind}_m"), getattr(self, f"{kind}_sigma_m")
            if value_m is not None:
                found[letter] = f"{value_m:.2f} m" if sigma_m is None else f"{value_m:.2f} ± {sigma_m:.2f} m"
        return found


SIZE_FIELDS: Final = tuple(field.name for field in fields(MeasuredSize))


def measured_size(measurements: Sequence[Mapping[str, object]]) -> MeasuredSize:
    """Return the size from the stored measurements of a contact, oldest first; see `summary`."""
    values: dict[str, float] = {}
    for kind, found in summary(measurements).items():
        for name, value in (("m", found and found["value_m"]), ("sigma_m", found and found["sigma_m"])):
            if isinstance(value, float):
                values[f"{kind}_{name}"] = value
    return MeasuredSize(**values)
