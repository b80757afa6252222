"""A contact's picture in square pixels on the bottom, whatever the sonar's resolution and the vehicle's speed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from sonarpost.detect.contacts import Detection
from sonarpost.detect.snippet import to_grey
from sonarpost.sonar.ground_range import MAX_COLUMNS, ground_range_image
from sonarpost.sonar.survey import FloatImage, Survey

_STEPS = 1 << 24
"""Of grey are enough to keep the echo's range of values."""


def ground_picture(
    survey: Survey, found: Detection, height_px: int, width_px: int, pixel_m: float
) -> npt.NDArray[np.uint8] | None:
    """Return the bottom around a contact, which lies in the middle.

    Args:
        survey: The pings in which it was found.
        found: The contact.
        height_px: Rows, along-track in the order of recording.
        width_px: Columns, across-track, the nadir to the left.
        pixel_m: Side of a pixel on a flat bottom.

    Returns:
        Shape (height_px, width_px), uint8, grey as `to_grey` makes it; 0 where nothing was recorded: beyond the
        recording's ends and the sonar's range, and on the other side of the nadir. None where the survey does not
        tell altitude or travel, or the pixels are too small for the sonar's range.
    """
    if found.pixel_along_m is None or found.altitude_m is None or found.ground_range_m is None:
        return None
    reach_m = max((c.slant_range_m for p in survey.pings for c in p.channels if c.side is found.side), default=0.0)
    if reach_m / pixel_m > MAX_COLUMNS:
        return None
    # Edges of the rows, in pings from the beginning of the survey.
    edges = found.ping_index + 0.5 + (np.arange(height_px + 1) - height_px / 2) * pixel_m / found.pixel_along_m
    first, end = max(int(edges[0]), 0), min(int(np.ceil(edges[-1])), len(survey.pings))
    pings = survey.pings[first:end]
    altitudes_m = np.array([p.altitude_m if p.altitude_m is not None else found.altitude_m for p in pings])
    ground = ground_range_image(replace(survey, pings=pings), found.side, altitudes_m, pixel_m)
    left = int(found.ground_range_m / pixel_m) - width_px // 2
    rows = _averaged_rows(_columns(ground, left, width_px), np.asarray(edges - first, dtype=np.float64))
    known = np.isfinite(rows)
    greatest = float(np.max(rows, where=known, initial=0.0))
    scaled = np.where(known, rows, 0.0) * (_STEPS / greatest if greatest > 0 else 0.0)
    return to_grey(np.rint(scaled).astype(np.uint32), known)


def _columns(image: FloatImage, left: int, width: int) -> FloatImage:
    """Return columns from `left` on, NaN where the image has none."""
    cut = np.full((image.shape[0], width), np.nan, dtype=np.float32)
    begin, end = max(left, 0), min(left + width, image.shape[1])
    if end > begin:
        cut[:, begin - left : end - left] = image[:, begin:end]
    return cut


def _averaged_rows(image: FloatImage, edges: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the mean of what is known between each two edges, which are in rows of the image; NaN where nothing is."""
    known = np.isfinite(image)
    start = np.zeros((1, image.shape[1]))
    total = np.vstack([start, np.cumsum(np.where(known, image, 0.0), axis=0, dtype=np.float64)])
    count = np.vstack([start, np.cumsum(known, axis=0, dtype=np.float64)])
    inside = np.clip(edges, 0, image.shape[0])
    low = np.minimum(inside.astype(np.int64), max(image.shape[0] - 1, 0))
    part = (inside - low)[:, None]
    high = np.minimum(low + 1, image.shape[0])
    sums, counts = (np.diff(table[low] * (1 - part) + table[high] * part, axis=0) for table in (total, count))
    return np.where(counts > 1e-6, sums / np.maximum(counts, 1e-6), np.nan)
