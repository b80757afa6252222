"""The picture of a contact: what the operator will see.

## sonarpost.detection.snippets
The picture of a contact over a piece of seabed: the same scale whatever the range, the speed and the sonar.

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

from sonarpost.detection.detector import Detection
from sonarpost.sonar.geometry import ground_to_slant_range_m
from sonarpost.sonar.ground_range import MAX_COLUMNS, ground_range_image, means_between
from sonarpost.sonar.survey import FloatImage, Side, Survey

SNIPPET_HEIGHT_PX = 100
SNIPPET_WIDTH_PX = 100

# Grey 0 and 255 lie at these percentiles of the window, so that one glint does not turn the rest black. The square root
# of amplitude lies between: it spends the grey levels where seabed, shadow and highlight differ.
LOW_PERCENTILE = 0.5
HIGH_PERCENTILE = 99.5


@dataclass(frozen=True, slots=True)
class SnippetCut:
    """A picture cut from a survey at its own resolution.

    Attributes:
        image: Shape (height_px, width_px), uint8; rows along-track in the order of recording, columns across-track,
            column 0 nearest the vehicle (nadir to the left on both sides).
        image16: The same window, uint16: the file's own values, divided by `divisor16` where they exceed 16 bits.
        divisor16: File value per step of `image16`; 1 for files of 8 or 16 bits.
        target_row: Row of the contact's highlight in the picture.
        target_column: Column of it.
        first_ping_index: Index into `Survey.pings` of row 0.
        first_sample: Sample index of column 0.
        pixel_along_m: Travel between rows; None when the survey does not tell.
        pixel_across_m: Slant range of a column.
    """

    image: npt.NDArray[np.uint8]
    image16: npt.NDArray[np.uint16]
    divisor16: int
    target_row: int
    target_column: int
    first_ping_index: int
    first_sample: int
    pixel_along_m: float | None
    pixel_across_m: float


def cut_snippet(
    survey: Survey, detection: Detection, height_px: int = SNIPPET_HEIGHT_PX, width_px: int = SNIPPET_WIDTH_PX
) -> SnippetCut:
    """Cut the picture of a contact.

    The window is centred on the highlight along-track, and on the highlight plus half the shadow across-track (but
    never so far out that the highlight leaves its left quarter). At the recording's borders the window is shifted, not
    shrunk; only a survey with fewer pings or samples than asked for gives a smaller picture. Samples that a ping does
    not have are 0.

    Raises:
        ValueError: When a size is below 1, or the detection does not belong to this survey.
    """
    samples = _samples(survey, detection, height_px, width_px)
    centre_column = _centre_column(detection, width_px)
    top, rows = _window(detection.ping_index, height_px, len(survey.pings))
    left, columns = _window(centre_column, width_px, samples)
    raw, known = _cut(survey, detection.side, (top, rows), (left, columns))
    divisor = 1 << max(0, int(raw.max()).bit_length() - 16)
    return SnippetCut(
        image=to_grey(raw, known),
        image16=(raw // divisor).astype(np.uint16),
        divisor16=divisor,
        target_row=detection.ping_index - top,
        target_column=detection.sample - left,
        first_ping_index=top,
        first_sample=left,
        pixel_along_m=detection.pixel_along_m,
        pixel_across_m=detection.pixel_across_m,
    )


def cut_expanded(survey: Survey, detection: Detection, height_px: int, width_px: int) -> npt.NDArray[np.uint8] | None:
    """Cut twice the ground of `cut_snippet` in each direction, around the same centre, in pixels of twice the size.

    A pixel is the mean of the four file values that it covers, of those there are; 0 where there is none. The window is
    shifted at the recording's borders as that of `cut_snippet`.

    Args:
        survey: The pings in which it was found.
        detection: The contact.
        height_px: Rows of the snippet.
        width_px: Columns of the snippet.

    Returns:
        Shape (height_px, width_px), uint8, or less where the survey has less than twice the snippet's pings or samples.
        None where that would show no more ground than the snippet along, or across.

    Raises:
        ValueError: As `cut_snippet`.
    """
    samples = _samples(survey, detection, height_px, width_px)
    top, rows = _window(detection.ping_index, 2 * height_px, len(survey.pings) // 2 * 2)
    left, columns = _window(_centre_column(detection, width_px), 2 * width_px, samples // 2 * 2)
    if rows <= height_px or columns <= width_px:
        return None
    raw, known = _cut(survey, detection.side, (top, rows), (left, columns))
    count = _by_fours(known.astype(np.float64))
    means = _by_fours(raw.astype(np.float64)) / np.maximum(count, 1.0)
    return to_grey(means, count > 0)


def _by_fours(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Sums of blocks of two rows and two columns."""
    rows, columns = values.shape
    sums: npt.NDArray[np.float64] = values.reshape(rows // 2, 2, columns // 2, 2).sum(axis=(1, 3))
    return sums


def _samples(survey: Survey, detection: Detection, height_px: int, width_px: int) -> int:
    """Return the most samples that a ping has on the detection's side.

    Raises:
        ValueError: When a size is below 1, or the detection does not belong to this survey.
    """
    if height_px < 1 or width_px < 1:
        raise ValueError(f"height_px, width_px: got {height_px}, {width_px}, expected 1 or more")
    samples = survey.sample_count(detection.side)
    if not (0 <= detection.ping_index < len(survey.pings) and 0 <= detection.sample < samples):
        raise ValueError(
            f"detection: got ping index {detection.ping_index}, sample {detection.sample}, "
            f"expected inside {len(survey.pings)} pings of {samples} samples"
        )
    return samples


def _centre_column(detection: Detection, width_px: int) -> int:
    return detection.sample + min(detection.shadow_samples // 2, width_px // 4)


def _cut(
    survey: Survey, side: Side, pings: tuple[int, int], samples: tuple[int, int]
) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.bool_]]:
    """Return a window's file values, 0 where there are none, and where there are; `pings`, `samples`: first, count."""
    (top, rows), (left, columns) = pings, samples
    raw = np.zeros((rows, columns), dtype=np.uint32)
    known = np.zeros((rows, columns), dtype=np.bool_)
    for row in range(rows):
        channel = survey.pings[top + row].channel(side)
        if channel is not None:
            piece = channel.samples[left : left + columns]
            raw[row, : piece.shape[0]] = piece
            known[row, : piece.shape[0]] = True
    return raw, known


def to_grey(
    raw: npt.NDArray[np.uint32] | npt.NDArray[np.float64], known: npt.NDArray[np.bool_]
) -> npt.NDArray[np.uint8]:
    """Map file values to grey.

    grey = 255 * (sqrt(value) - low) / (high - low), rounded and limited to 0..255, where low and high are the 0.5th and
    99.5th percentile of sqrt(value) over the known pixels. A window of one value gives mid grey (128), unknown pixels
    give 0.

    Args:
        raw: Shape (rows, columns), the file's values, or means of them.
        known: Same shape, True where the file has a sample.
    """
    root = np.sqrt(raw.astype(np.float64))
    grey = np.zeros(raw.shape, dtype=np.uint8)
    if not known.any():
        return grey
    low, high = np.percentile(root[known], (LOW_PERCENTILE, HIGH_PERCENTILE))
    scaled = 255.0 * (root[known] - low) / (high - low) if high > low else np.array(128.0)
    grey[known] = np.clip(np.rint(scaled), 0, 255).astype(np.uint8)
    return grey


def _window(centre: int, size: int, limit: int) -> tuple[int, int]:
    """First index and length of a window of `size` around `centre`, shifted to lie within `limit`."""
    length = min(size, limit)
    return min(max(centre - length // 2, 0), limit - length), length


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
