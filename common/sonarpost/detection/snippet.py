"""The picture of a contact: what the operator will see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarpost.detection.contacts import Detection
from sonarpost.sonar.survey import Side, Survey

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
