"""Ground-range projection of a side, and normalisation across the swath."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.sonar.geometry import ground_to_slant_range_m
from sonarpost.sonar.survey import FloatImage, Samples, Side, Survey

FloatArray = npt.NDArray[np.float64]

MAX_COLUMNS: Final = 1 << 16
_ANGLE_BINS: Final = 90
_MIN_SAMPLES: Final = 30
"""Minimum number of samples for the mean of an angle."""


def ground_range_image(survey: Survey, side: Side, altitude_m: FloatArray, spacing_m: float) -> FloatImage:
    """Project one side to a flat bottom, in equal steps of ground range.

    Each column is the mean echo over the slant ranges that it covers.

    Args:
        survey: The pings.
        side: Port or starboard.
        altitude_m: Altitude of each ping, shape (pings,); NaN if unknown.
        spacing_m: Width of a column in metres.

    Returns:
        Shape (pings, columns), float32, NaN beyond the range of a ping and in pings without that side or without
        altitude. Column 0 begins below the sonar.

    Raises:
        ValueError: The number of altitudes differs from the number of pings, or the spacing is not positive or gives
            more than 65,536 columns.
    """
    if altitude_m.shape != (len(survey.pings),):
        raise ValueError(f"altitudes of shape {altitude_m.shape}, expected one for each of {len(survey.pings)} pings")
    range_m = survey.max_slant_range_m(side)
    if not spacing_m > 0 or range_m / spacing_m > MAX_COLUMNS:
        raise ValueError(f"spacing of {spacing_m} m over {range_m} m, expected 1 to {MAX_COLUMNS} columns")
    edges_m = np.arange(int(np.ceil(range_m / spacing_m)) + 1) * spacing_m
    image = np.full((len(survey.pings), len(edges_m) - 1), np.nan, dtype=np.float32)
    for row, (ping, height_m) in enumerate(zip(survey.pings, altitude_m.tolist(), strict=True)):
        channel = ping.channel(side)
        if channel is None or not np.isfinite(height_m):
            continue
        edges = ground_to_slant_range_m(edges_m, height_m) / channel.sample_spacing_m
        image[row] = interval_means(channel.echo(), edges)
    return image


def interval_means(samples: Samples | FloatImage, edges: FloatArray) -> FloatArray:
    """Return the mean of a ping's samples between neighbouring edges.

    A sample that contains an edge contributes to both intervals in proportion, so an interval within one sample has
    the value of that sample.

    Args:
        samples: Samples of one channel, or their echo strength, shape (n,), any number dtype, n from 1.
        edges: In samples from the beginning of the first one, not decreasing, from 0 on, shape (m + 1,).

    Returns:
        Shape (m,), float64; NaN where an interval is empty or ends beyond the last sample.
    """
    cumulative = np.concatenate([[0.0], np.cumsum(samples, dtype=np.float64)])
    totals = np.diff(np.interp(edges, np.arange(len(cumulative)), cumulative))
    widths = np.diff(edges)
    inside = (edges[1:] <= len(samples)) & (widths > 0)
    means = np.full(len(widths), np.nan)
    means[inside] = totals[inside] / widths[inside]
    return means


def beam_normalised(image: FloatImage, altitude_m: FloatArray, spacing_m: float) -> FloatImage:
    """Divide each sample by the mean of all samples at its angle, which removes beam pattern and grazing angle.

    The angle from the nadir is atan(ground range / altitude). Its mean is taken over the whole image, so it remains
    valid when the altitude changes, unlike a mean by column.

    Args:
        image: Over ground range, from `ground_range_image`.
        altitude_m: Altitude of each ping, shape (pings,); NaN if unknown.
        spacing_m: Width of a column in metres.

    Returns:
        Same shape, float32, about 1 on average; NaN where unknown or where the angle has fewer than 30 samples.
    """
    ground_m = (np.arange(image.shape[1]) + 0.5) * spacing_m
    angle = np.arctan2(ground_m[None, :], altitude_m[:, None])
    known = np.isfinite(image) & np.isfinite(angle)
    place = np.where(known, angle / (np.pi / 2) * _ANGLE_BINS, 0).astype(np.intp).clip(0, _ANGLE_BINS - 1)
    count = np.bincount(place[known], minlength=_ANGLE_BINS)
    total = np.bincount(place[known], weights=image[known].astype(np.float64), minlength=_ANGLE_BINS)
    mean = np.where(count >= _MIN_SAMPLES, total / np.maximum(count, 1), 0.0)
    divisor = mean[place]
    usable = known & (divisor > 0)
    result: FloatImage = np.where(usable, image / np.where(usable, divisor, 1), np.nan).astype(np.float32)
    return result
