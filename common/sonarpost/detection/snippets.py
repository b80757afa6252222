"""Snippets: the pixels of a contact, cut from a survey.

- `cut_snippet` and `cut_expanded` keep the resolution of the recording (pings by samples of slant range).
- `ground_projected_image` projects to the bottom: rows and columns of fixed size in metres, counted from below the
  sonar, with the altitude of each ping. It averages the echo strength, with the weight of the recorder applied, over
  the fraction of every ping that a row covers.

All images are grey as `to_grey` maps it, with 0 where nothing was recorded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from sonarpost.detection.detector import Detection
from sonarpost.sonar.ground_range import MAX_COLUMNS, ground_range_image
from sonarpost.sonar.survey import FloatImage, Side, Survey

SNIPPET_HEIGHT_PX = 100
SNIPPET_WIDTH_PX = 100

# Percentiles of the window that map to grey 0 and 255, so that a single glint does not darken the rest.
LOW_PERCENTILE = 0.5
HIGH_PERCENTILE = 99.5

_GREY_STEPS = 1 << 24
"""Steps of echo strength before the mapping to grey."""


@dataclass(frozen=True, slots=True)
class SurveySnippet:
    """Pixels cut from a survey at its own resolution.

    Attributes:
        image: Shape (height_px, width_px), uint8; rows along-track in the order of recording, columns across-track,
            column 0 nearest the vehicle (nadir to the left on both sides).
        image16: The same window, uint16: the values of the file, divided by `divisor16` if they exceed 16 bits.
        divisor16: File value per step of `image16`; 1 for files of 8 or 16 bits.
        first_ping_index: Index into `Survey.pings` of row 0.
        first_sample: Sample index of column 0.
    """

    image: npt.NDArray[np.uint8]
    image16: npt.NDArray[np.uint16]
    divisor16: int
    first_ping_index: int
    first_sample: int


def cut_snippet(
    survey: Survey, detection: Detection, height_px: int = SNIPPET_HEIGHT_PX, width_px: int = SNIPPET_WIDTH_PX
) -> SurveySnippet:
    """Cut the snippet of a contact.

    Along-track the window is centred on the highlight. Across-track it is centred on the highlight plus half the
    shadow, at most so far out that the highlight stays in the left quarter. At the borders of the recording the window
    is shifted; only a survey with fewer pings or samples gives a smaller image. Samples that a ping does not have
    are 0.

    Raises:
        ValueError: A size below 1, or a detection outside this survey.
    """
    samples = _checked_samples(survey, detection, height_px, width_px)
    top, rows = _window(detection.ping_index, height_px, len(survey.pings))
    left, columns = _window(_centre_column(detection, width_px), width_px, samples)
    raw, known = _file_values(survey, detection.side, (top, rows), (left, columns))
    divisor = 1 << max(0, int(raw.max()).bit_length() - 16)
    return SurveySnippet(
        image=to_grey(raw, known),
        image16=(raw // divisor).astype(np.uint16),
        divisor16=divisor,
        first_ping_index=top,
        first_sample=left,
    )


def cut_expanded(survey: Survey, detection: Detection, height_px: int, width_px: int) -> npt.NDArray[np.uint8] | None:
    """Cut twice the seabed of `cut_snippet` in each direction, around the same centre, at half the resolution.

    A pixel is the mean of the recorded ones of the four file values that it covers; 0 if there is none. The window is
    shifted at the borders of the recording like that of `cut_snippet`.

    Returns:
        Shape (height_px, width_px), uint8, smaller if the survey has less than twice the snippet's pings or samples.
        None if the result would cover no more seabed than the snippet in one direction.

    Raises:
        ValueError: As `cut_snippet`.
    """
    samples = _checked_samples(survey, detection, height_px, width_px)
    top, rows = _window(detection.ping_index, 2 * height_px, len(survey.pings) // 2 * 2)
    left, columns = _window(_centre_column(detection, width_px), 2 * width_px, samples // 2 * 2)
    if rows <= height_px or columns <= width_px:
        return None
    raw, known = _file_values(survey, detection.side, (top, rows), (left, columns))
    count = _sums_of_four(known.astype(np.float64))
    means = _sums_of_four(raw) / np.maximum(count, 1.0)
    return to_grey(means, count > 0)


def _sums_of_four(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the sums of blocks of two rows by two columns."""
    rows, columns = values.shape
    sums: npt.NDArray[np.float64] = values.reshape(rows // 2, 2, columns // 2, 2).sum(axis=(1, 3))
    return sums


def _checked_samples(survey: Survey, detection: Detection, height_px: int, width_px: int) -> int:
    """Return the maximum number of samples of a ping on the detection's side.

    Raises:
        ValueError: A size below 1, or a detection outside this survey.
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


def _file_values(
    survey: Survey, side: Side, pings: tuple[int, int], samples: tuple[int, int]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Return the file values of a window (0 where not recorded) and where they are recorded.

    If the scale of the pings changes, the values are converted to that of the first one.

    `pings` and `samples` are each the first index and the number.
    """
    (top, rows), (left, columns) = pings, samples
    raw = np.zeros((rows, columns), dtype=np.float64)
    known = np.zeros((rows, columns), dtype=np.bool_)
    scale: float | None = None
    for row in range(rows):
        channel = survey.pings[top + row].channel(side)
        if channel is not None:
            scale = channel.scale if scale is None else scale
            values = channel.samples[left : left + columns]
            raw[row, : values.shape[0]] = values.astype(np.float64) * (channel.scale / scale)
            known[row, : values.shape[0]] = True
    return raw, known


def to_grey(
    raw: npt.NDArray[np.uint32] | npt.NDArray[np.float64], known: npt.NDArray[np.bool_]
) -> npt.NDArray[np.uint8]:
    """Map file values to grey.

    grey = 255 * (sqrt(value) - low) / (high - low), rounded and limited to 0..255, where low and high are the 0.5th and
    99.5th percentile of sqrt(value) over the known pixels. The square root gives seabed, shadow and highlight similar
    shares of the grey levels. A window of constant value is mid grey (128), unknown pixels are 0.

    Args:
        raw: Shape (rows, columns), values of the file, or means of them.
        known: Same shape, True where recorded.
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
    """Return first index and length of a window of `size` around `centre`, shifted to lie within `limit`."""
    length = min(size, limit)
    return min(max(centre - length // 2, 0), limit - length), length


def ground_projected_image(
    survey: Survey, detection: Detection, height_px: int, width_px: int, pixel_m: float
) -> npt.NDArray[np.uint8] | None:
    """Return the bottom around a contact, with the contact in the centre.

    Args:
        survey: The pings in which the contact was detected.
        detection: The contact.
        height_px: Rows, along-track in the order of recording.
        width_px: Columns, across-track, nadir to the left.
        pixel_m: Side of a pixel on a flat bottom.

    Returns:
        Shape (height_px, width_px), uint8, grey as `to_grey` maps it; 0 beyond the ends of the recording, beyond the
        range of the sonar, and on the other side of the nadir. None if altitude or distance between pings is unknown,
        or if the pixels are too small for the range of the sonar.
    """
    altitude_m, range_m, along_m = detection.altitude_m, detection.ground_range_m, detection.pixel_along_m
    if altitude_m is None or range_m is None or along_m is None:
        return None
    if survey.max_slant_range_m(detection.side) / pixel_m > MAX_COLUMNS:
        return None
    # Edges of the rows, in pings from the beginning of the survey.
    edges = detection.ping_index + 0.5 + (np.arange(height_px + 1) - height_px / 2) * pixel_m / along_m
    first, end = max(int(edges[0]), 0), min(int(np.ceil(edges[-1])), len(survey.pings))
    pings = survey.pings[first:end]
    altitudes_m = np.array([p.altitude_m if p.altitude_m is not None else altitude_m for p in pings])
    ground = ground_range_image(replace(survey, pings=pings), detection.side, altitudes_m, pixel_m)
    left = int(range_m / pixel_m) - width_px // 2
    rows = _row_means(_columns(ground, left, width_px), np.asarray(edges - first, dtype=np.float64))
    known = np.isfinite(rows)
    greatest = float(np.max(rows, where=known, initial=0.0))
    scaled = np.where(known, rows, 0.0) * (_GREY_STEPS / greatest if greatest > 0 else 0.0)
    return to_grey(np.rint(scaled).astype(np.uint32), known)


def _columns(image: FloatImage, left: int, width: int) -> FloatImage:
    """Return `width` columns from `left` on, NaN outside the image."""
    out = np.full((image.shape[0], width), np.nan, dtype=np.float32)
    begin, end = max(left, 0), min(left + width, image.shape[1])
    if end > begin:
        out[:, begin - left : end - left] = image[:, begin:end]
    return out


def _row_means(image: FloatImage, edges: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the mean of the finite values between neighbouring edges, given in rows; NaN where there is none."""
    known = np.isfinite(image)
    start = np.zeros((1, image.shape[1]))
    total = np.vstack([start, np.cumsum(np.where(known, image, 0.0), axis=0, dtype=np.float64)])
    count = np.vstack([start, np.cumsum(known, axis=0, dtype=np.float64)])
    inside = np.clip(edges, 0, image.shape[0])
    low = np.minimum(inside.astype(np.int64), max(image.shape[0] - 1, 0))
    fraction = (inside - low)[:, None]
    high = np.minimum(low + 1, image.shape[0])
    sums, counts = (np.diff(table[low] * (1 - fraction) + table[high] * fraction, axis=0) for table in (total, count))
    return np.where(counts > 1e-6, sums / np.maximum(counts, 1e-6), np.nan)
