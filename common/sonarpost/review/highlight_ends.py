"""Ends of a highlight on a line: the grey level half-way between the object and its background."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

Point = tuple[float, float]
Grey = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
FloatArray = npt.NDArray[np.float64]

SEARCH_PX: Final = 7.0
"""Greatest distance of an edge from the end that a person has set."""

_STEP_PX: Final = 0.25
_OFFSETS_PX: Final = (-1, 0, 1)
"""A profile is the mean of parallel lines at these distances."""
_INNER: Final = (1 / 6, 5 / 6)
"""Part of the line whose median is the level of the object."""
_BACKGROUND_PX: Final = (2.0, SEARCH_PX)
"""Distances from an end, outward, between which the median is the level of the background."""
_LEAST_CONTRAST: Final = 25.0
"""Least difference of object and background: a tenth of the grey levels."""


def snapped_ends(grey: Grey, missing: Mask, start: Point, end: Point) -> tuple[Point | None, Point | None]:
    """Move both ends of a line along it to the nearest place where the object's highlight falls to half brightness.

    Half brightness is the mean of two medians of grey levels: that of the object, on the inner two thirds of the line,
    and that of the background, 2 to 7 px outside the end. The place has a fraction of a pixel.

    Args:
        grey: Shape (height_px, width_px), 8 bits.
        missing: Same shape, true for pixels that were not received; they have no grey level.
        start: (row, column) of one end in pixels from the upper left corner, different from `end`.
        end: (row, column) of the other end.

    Returns:
        New start and end; None for an end without such a place within `SEARCH_PX` or half of the line.
    """
    length_px = math.hypot(end[0] - start[0], end[1] - start[1])
    rows, columns = (end[0] - start[0]) / length_px, (end[1] - start[1]) / length_px
    along_px = np.arange(-SEARCH_PX, length_px + SEARCH_PX + _STEP_PX, _STEP_PX)
    profile = _profile(grey, missing, start, (rows, columns), along_px)
    inner = profile[(along_px >= _INNER[0] * length_px) & (along_px <= _INNER[1] * length_px)]
    inner = inner[np.isfinite(inner)]
    if inner.size == 0:
        return None, None
    level, reach_px = float(np.median(inner)), min(SEARCH_PX, length_px / 2)
    before = _edge_px(profile[::-1], -along_px[::-1], level, reach_px)
    after = _edge_px(profile, along_px - length_px, level, reach_px)
    return (
        None if before is None else (start[0] - before * rows, start[1] - before * columns),
        None if after is None else (end[0] + after * rows, end[1] + after * columns),
    )


def _profile(grey: Grey, missing: Mask, start: Point, direction: Point, along_px: FloatArray) -> FloatArray:
    """Return mean grey levels of parallel lines; NaN where a line is outside the image or on a missing pixel."""
    height_px, width_px = grey.shape
    total = np.zeros(along_px.shape)
    for offset in _OFFSETS_PX:
        rows = start[0] + along_px * direction[0] - offset * direction[1]
        columns = start[1] + along_px * direction[1] + offset * direction[0]
        inside = (rows >= 0) & (rows < height_px) & (columns >= 0) & (columns < width_px)
        inside[inside] = ~missing[rows[inside].astype(int), columns[inside].astype(int)]
        levels = map_coordinates(grey.astype(np.float64), (rows - 0.5, columns - 0.5), order=1, mode="nearest")
        total += np.where(inside, levels, np.nan)
    return total / len(_OFFSETS_PX)


def _edge_px(profile: FloatArray, outward_px: FloatArray, level: float, reach_px: float) -> float | None:
    """Return the outward distance of the half brightness from an end, the nearest one; None without one.

    Args:
        profile: Grey levels from the inside outward.
        outward_px: Distance of each from the end, rising.
        level: Grey level of the object.
        reach_px: Greatest distance inward.
    """
    outside = profile[(outward_px >= _BACKGROUND_PX[0]) & (outward_px <= _BACKGROUND_PX[1])]
    outside = outside[np.isfinite(outside)]
    if outside.size == 0 or level - np.median(outside) < _LEAST_CONTRAST:
        return None
    half = (level + float(np.median(outside))) / 2
    near = (outward_px >= -reach_px) & (outward_px <= SEARCH_PX)
    levels, distances = profile[near], outward_px[near]
    # A comparison with NaN is false: a place beside a missing pixel is none.
    (steps,) = np.nonzero((levels[:-1] >= half) & (levels[1:] < half))
    if steps.size == 0:
        return None
    parts = (levels[steps] - half) / (levels[steps] - levels[steps + 1])
    places = distances[steps] + parts * (distances[steps + 1] - distances[steps])
    return float(places[np.argmin(np.abs(places))])
