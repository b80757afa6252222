"""The picture of a contact over a piece of seabed: the same scale whatever the range, the speed and the sonar.

There are two, which differ pixel by pixel and are not to be exchanged for each other:

- `cut_ground_snippet` makes pictures for files: a square in metres with the contact in its very middle, over a flat
  bottom at the contact's altitude, of the file's own values, each row the mean of whole pings. It says what is unknown.
- `ground_projected_image` makes the pictures for records: rows and columns of pixels, counted from below the
  sonar, over each ping's altitude, of the echo with the recorder's weight applied, each row of its share of every ping.

In common they have which contacts have a place on the bottom, how a ping's samples are averaged over steps of it
(`means_between`), and grey (`to_grey`), 0 where nothing was recorded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from sonarpost.detection.contacts import Detection
from sonarpost.detection.snippet import to_grey
from sonarpost.sonar.geometry import ground_to_slant_range_m
from sonarpost.sonar.ground_range import MAX_COLUMNS, ground_range_image, means_between
from sonarpost.sonar.survey import FloatImage, Survey

MAX_SIDE_PX = 4096
_LEAST_SAMPLES = 1e-9
"""A pixel that spans less of a ping, at the nadir, holds little but rounding."""
_STEPS = 1 << 24
"""Of grey are enough to keep the echo's range of values."""


@dataclass(frozen=True, slots=True)
class GroundSnippet:
    """A square of seabed with a contact in its middle.

    Attributes:
        image: Shape (n, n), uint8; rows along-track in the order of recording, columns over ground range, nadir to
            the left on both sides; 0 where nothing was recorded.
        known: Same shape, True where something was.
        pixel_m: Side of a pixel on the bottom, along and across the same.
    """

    image: npt.NDArray[np.uint8]
    known: npt.NDArray[np.bool_]
    pixel_m: float


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a contact lies: `range_m` from the track, `altitude_m` below the sonar, pings `along_m` from each other."""

    altitude_m: float
    range_m: float
    along_m: float


def _place(found: Detection) -> _Place | None:
    """Return a contact's place, None where the survey does not tell all of it."""
    if found.altitude_m is None or found.ground_range_m is None or found.pixel_along_m is None:
        return None
    return _Place(found.altitude_m, found.ground_range_m, found.pixel_along_m)


def cut_ground_snippet(
    survey: Survey, detection: Detection, size_m: float = 10.0, pixel_m: float = 0.1
) -> GroundSnippet | None:
    """Cut the seabed around a contact at a fixed size and scale.

    Each pixel is the mean of the samples whose slant range falls into it over a flat bottom at the contact's altitude
    (between the two nearest, where samples are coarser), in the pings that it spans, or the nearest one. Unlike
    `cut_snippet` the contact's highlight is always the middle pixel; what lies beyond the recording is unknown.

    Args:
        survey: The survey the contact was found in.
        detection: The contact.
        size_m: Side of the square.
        pixel_m: Side of a pixel.

    Returns:
        The picture; None where the contact's altitude or the travel between pings is not known.

    Raises:
        ValueError: A size or pixel that is not above 0, or more than 4096 pixels a side.
    """
    if not (size_m > 0 and pixel_m > 0 and 1 <= size_m / pixel_m <= MAX_SIDE_PX):
        raise ValueError(f"size_m, pixel_m: got {size_m}, {pixel_m}, expected above 0 and 1 to {MAX_SIDE_PX} pixels")
    place = _place(detection)
    if place is None:
        return None
    count = math.ceil(size_m / pixel_m)
    edges_m = place.range_m + (np.arange(count + 1) - count / 2) * pixel_m
    slant_m = ground_to_slant_range_m(np.maximum(edges_m, 0.0), place.altitude_m)
    first = detection.ping_index + 0.5 - count / 2 * pixel_m / place.along_m
    values = np.full((count, count), np.nan)
    for row in range(count):
        top = first + row * pixel_m / place.along_m
        bottom = top + pixel_m / place.along_m
        rows = range(max(round(top), 0), min(round(bottom), len(survey.pings))) or range(
            math.floor(top), math.floor(top) + 1
        )
        lines = [_line(survey, detection, ping, slant_m) for ping in rows if 0 <= ping < len(survey.pings)]
        if lines:
            stacked = np.stack(lines)
            some = np.isfinite(stacked).any(axis=0)
            values[row, some] = np.nanmean(stacked[:, some], axis=0)
    values[:, edges_m[:-1] < 0] = np.nan
    known = np.isfinite(values)
    raw = np.rint(np.where(known, values, 0.0)).astype(np.uint32)
    return GroundSnippet(to_grey(raw, known), known, pixel_m)


def _line(survey: Survey, detection: Detection, ping: int, slant_m: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the mean of one ping's samples between neighbouring slant ranges, NaN beyond its end."""
    channel = survey.pings[ping].channel(detection.side)
    if channel is None or not len(channel.samples):
        return np.full(len(slant_m) - 1, np.nan)
    return means_between(channel.samples, slant_m / channel.sample_spacing_m, least_width=_LEAST_SAMPLES)


def ground_projected_image(
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
    place = _place(found)
    if place is None:
        return None
    if survey.reach_m(found.side) / pixel_m > MAX_COLUMNS:
        return None
    # Edges of the rows, in pings from the beginning of the survey.
    edges = found.ping_index + 0.5 + (np.arange(height_px + 1) - height_px / 2) * pixel_m / place.along_m
    first, end = max(int(edges[0]), 0), min(int(np.ceil(edges[-1])), len(survey.pings))
    pings = survey.pings[first:end]
    altitudes_m = np.array([p.altitude_m if p.altitude_m is not None else place.altitude_m for p in pings])
    ground = ground_range_image(replace(survey, pings=pings), found.side, altitudes_m, pixel_m)
    left = int(place.range_m / pixel_m) - width_px // 2
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
