"""Measures of a decoded image against the speckle-free scene: PSNR, isolated dots, highlight, shadow and height.

Sizes in pixels are pings along the track (rows) and samples of slant range (columns, nadir to the left).
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from research.common.quality import psnr_db
from sonarpost.codec.interface import Image
from sonarpost.detection.detector import height_from_shadow_m
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, TruthObject

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

DOT_MAX_PX: Final = 6
DOT_CONTRAST: Final = 18.0
DOT_MEDIAN_PX: Final = 7
PSNR_LIMIT_DB: Final = 60.0
"""Upper limit of the PSNR, which is infinite for an image without error and would make every mean infinite."""
MIN_SHADOW_PX: Final = 6
"""A shorter shadow in the reference is not compared."""
MIN_CONTRAST: Final = 1.5
"""A highlight in the reference below this multiple of the seabed level is not compared."""
_WINDOW_MARGIN_PX: Final = 3
_SHADOW_START_M: Final = 0.25
"""A shadow begins within the object's extent or this distance behind it."""
_SHADOW_GAP_M: Final = 0.25
"""A gap of this length does not end a shadow."""
_GUARD_ROWS: Final = 6


@dataclass(frozen=True, slots=True)
class ObjectPlace:
    """Place of an object in an image, with what its height follows from.

    Attributes:
        row: Row of its centre.
        column: Column of its centre.
        half_rows: Half of its extent along the track, in rows, at least 1.
        half_columns: Half of its extent in slant range, in columns, at least 1.
        sample_m: Slant range of one column.
        first_slant_m: Slant range of column 0.
        altitude_m: Altitude of the sonar in the ping of `row`.
    """

    row: int
    column: int
    half_rows: int
    half_columns: int
    sample_m: float
    first_slant_m: float
    altitude_m: float


@dataclass(frozen=True, slots=True)
class ObjectMeasurement:
    """Highlight and shadow of an object in an image.

    Attributes:
        peak: Greatest mean of 3 x 3 pixels in the window around the object, grey levels.
        peak_row: Row of the centre of these pixels.
        peak_column: Column of the centre of these pixels.
        seabed: Level of the seabed beside the object, grey levels.
        shadow_px: Length of the shadow in columns; 0 without shadow.
        shadow_is_cut: Whether the shadow extends to the end of the image, so that its length is a lower bound.
        height_m: Height of the object above a flat bottom that follows from the shadow; 0 without shadow.
    """

    peak: float
    peak_row: int
    peak_column: int
    seabed: float
    shadow_px: int
    shadow_is_cut: bool
    height_m: float


@dataclass(frozen=True, slots=True)
class ObjectErrors:
    """Differences of a measurement from that in a reference image; NaN where they cannot be compared.

    Attributes:
        highlight: |peak - reference| / reference.
        position_px: Distance between the two positions of the peak.
        shadow_px: |length - reference|.
        height: |height - reference| / reference.
    """

    highlight: float
    position_px: float
    shadow_px: float
    height: float


def place_in_window(item: TruthObject, spec: SurveySpec, altitude_m: float, top: int, left: int) -> ObjectPlace:
    """Return the place of an object in a window of the survey.

    Args:
        item: The object.
        spec: Specification of the survey.
        altitude_m: Altitude of the sonar in the object's ping.
        top: Ping of row 0.
        left: Sample of column 0.
    """
    angle = math.radians(item.orientation_deg)
    along_m = math.hypot(item.length_m * math.cos(angle), item.width_m * math.sin(angle))
    across_m = math.hypot(item.length_m * math.sin(angle), item.width_m * math.cos(angle))
    return ObjectPlace(
        row=item.ping - top,
        column=item.sample_index - left,
        half_rows=max(1, round(along_m / 2 / spec.ping_spacing_m)),
        half_columns=max(1, round((across_m + item.height_m) / 2 / spec.sample_m)),
        sample_m=spec.sample_m,
        first_slant_m=left * spec.sample_m,
        altitude_m=altitude_m,
    )


def clipped_psnr_db(reference: Image, image: Image) -> float:
    """Return the PSNR in dB, at most `PSNR_LIMIT_DB`."""
    return min(psnr_db(reference, image), PSNR_LIMIT_DB)


def count_dots(image: Image) -> int:
    """Return the number of isolated dots of an image.

    A dot is a group of 1 to 6 pixels, connected by edges or corners, each of which differs by more than 18 grey levels
    from the median of the 7 x 7 pixels around it.

    Args:
        image: Shape (height, width), uint8.
    """
    grey = image.astype(np.float64)
    differs = np.abs(grey - ndimage.median_filter(grey, DOT_MEDIAN_PX, mode="reflect")) > DOT_CONTRAST
    labels, count = ndimage.label(differs, structure=np.ones((3, 3)))
    if count == 0:
        return 0
    return int(np.count_nonzero(np.bincount(labels.ravel())[1:] <= DOT_MAX_PX))


def measure_object(image: Image, place: ObjectPlace) -> ObjectMeasurement:
    """Measure highlight and shadow of an object.

    The window of the highlight is the object's extent and 3 pixels on each side. The shadow is measured on the mean of
    the middle half of the object's rows. It is the longest run of columns darker than half of the seabed level that
    begins within the object's extent or 0.25 m behind it; a gap of at most 0.25 m does not end a run. The seabed level
    is the median of the rows beside the object in the same columns.

    Args:
        image: Shape (height, width), uint8.
        place: Place of the object; its centre is inside the image.
    """
    grey = image.astype(np.float64)
    top = max(place.row - place.half_rows - _WINDOW_MARGIN_PX, 0)
    left = max(place.column - place.half_columns - _WINDOW_MARGIN_PX, 0)
    means = ndimage.uniform_filter(grey, 3, mode="nearest")
    window = means[
        top : place.row + place.half_rows + _WINDOW_MARGIN_PX + 1,
        left : place.column + place.half_columns + _WINDOW_MARGIN_PX + 1,
    ]
    row, column = (int(index) for index in np.unravel_index(int(np.argmax(window)), window.shape))

    begin = max(place.column - place.half_columns, 0)
    half = max(1, place.half_rows // 2)
    across = grey[max(place.row - half, 0) : place.row + half + 1, begin:]
    profile = ndimage.uniform_filter1d(across.mean(axis=0), 3, mode="nearest")
    seabed = _seabed_level(grey[:, begin:], place)
    starts = place.column + place.half_columns + round(_SHADOW_START_M / place.sample_m) - begin
    first, last = _longest_run(profile < 0.5 * seabed, starts, round(_SHADOW_GAP_M / place.sample_m))
    shadow_m, slant_m = (last - first) * place.sample_m, place.first_slant_m + (begin + first) * place.sample_m
    return ObjectMeasurement(
        peak=float(window[row, column]),
        peak_row=top + row,
        peak_column=left + column,
        seabed=seabed,
        shadow_px=last - first,
        shadow_is_cut=last > first and last == profile.size,
        height_m=height_from_shadow_m(shadow_m, slant_m, place.altitude_m) if last > first else 0.0,
    )


def _seabed_level(grey: Values, place: ObjectPlace) -> float:
    """Return the median of the rows beside the object; of all rows if the object extends over all of them."""
    beside = np.ones(grey.shape[0], dtype=np.bool_)
    beside[max(place.row - place.half_rows - _GUARD_ROWS, 0) : place.row + place.half_rows + _GUARD_ROWS + 1] = False
    return float(np.median(grey[beside] if beside.any() else grey))


def _longest_run(dark: Flags, start_within: int, max_gap: int) -> tuple[int, int]:
    """Return the first and one past the last column of the longest run that begins up to `start_within`.

    Dark columns with at most `max_gap` other ones between them are one run. (0, 0) without a run.
    """
    places = np.flatnonzero(dark)
    if places.size == 0:
        return 0, 0
    breaks = np.flatnonzero(np.diff(places) > max_gap + 1)
    firsts = places[np.concatenate(([0], breaks + 1))]
    lasts = places[np.concatenate((breaks, [places.size - 1]))] + 1
    lengths = np.where(firsts <= start_within, lasts - firsts, 0)
    longest = int(np.argmax(lengths))
    return (int(firsts[longest]), int(lasts[longest])) if lengths[longest] else (0, 0)


def object_errors(found: ObjectMeasurement, reference: ObjectMeasurement) -> ObjectErrors:
    """Return the differences of a measurement from that in a reference image.

    The highlight is NaN if the reference has none of at least `MIN_CONTRAST`. Shadow and height are NaN if the
    reference has no shadow of at least `MIN_SHADOW_PX`, or one that is cut.
    """
    highlight = position_px = shadow_px = height = math.nan
    if reference.peak > 0 and reference.peak >= MIN_CONTRAST * reference.seabed:
        highlight = abs(found.peak - reference.peak) / reference.peak
        position_px = math.hypot(found.peak_row - reference.peak_row, found.peak_column - reference.peak_column)
    if reference.shadow_px >= MIN_SHADOW_PX and not reference.shadow_is_cut:
        shadow_px = float(abs(found.shadow_px - reference.shadow_px))
        height = abs(found.height_m - reference.height_m) / reference.height_m
    return ObjectErrors(highlight, position_px, shadow_px, height)


def finite_median(values: Iterable[float]) -> float:
    """Return the median of the finite values; NaN without any."""
    finite = [value for value in values if math.isfinite(value)]
    return float(np.median(finite)) if finite else math.nan
