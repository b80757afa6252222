"""A side without its water column, over equal steps on the bottom, and evened out across the swath."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter1d

from sonarpost.sonar.geometry import ground_to_slant_range_m
from sonarpost.sonar.survey import FloatImage, Samples, Side, Survey

FloatArray = npt.NDArray[np.float64]

MAX_COLUMNS: Final = 1 << 16
_ANGLE_BINS: Final = 90
_LEAST_SAMPLES: Final = 30
"""Fewer samples of an angle or range say nothing of its mean."""


def ground_range_image(survey: Survey, side: Side, altitude_m: FloatArray, spacing_m: float) -> FloatImage:
    """Return one side over a flat bottom in equal steps of ground range.

    Each column takes the echo at the slant range of its middle, between the two nearest samples; where a column
    spans several samples (far from the nadir it never does by more than `spacing_m` over theirs) they are averaged.

    Args:
        survey: The pings.
        side: The side.
        altitude_m: Altitude of each ping, shape (pings,); NaN where unknown.
        spacing_m: Width of a column in metres.

    Returns:
        Shape (pings, columns), float32, NaN beyond a ping's range, in pings without that side and in pings without
        altitude. Column 0 begins below the sonar.

    Raises:
        ValueError: Another number of altitudes than pings, or a spacing that is not positive or gives over 65,536
            columns.
    """
    if altitude_m.shape != (len(survey.pings),):
        raise ValueError(f"altitudes of shape {altitude_m.shape}, expected one for each of {len(survey.pings)} pings")
    reach_m = survey.reach_m(side)
    if not spacing_m > 0 or reach_m / spacing_m > MAX_COLUMNS:
        raise ValueError(f"spacing of {spacing_m} m over {reach_m} m, expected 1 to {MAX_COLUMNS} columns")
    edges_m = np.arange(int(np.ceil(reach_m / spacing_m)) + 1) * spacing_m
    image = np.full((len(survey.pings), len(edges_m) - 1), np.nan, dtype=np.float32)
    for row, (ping, height_m) in enumerate(zip(survey.pings, altitude_m.tolist(), strict=True)):
        channel = ping.channel(side)
        if channel is None or not np.isfinite(height_m):
            continue
        places = ground_to_slant_range_m(edges_m, height_m) / channel.sample_spacing_m
        image[row] = means_between(channel.echo(), places)
    return image


def means_between(samples: Samples | FloatImage, places: FloatArray, *, least_width: float = 0.0) -> FloatArray:
    """Return the mean of a ping's samples between each two neighbouring places.

    Places count samples from the beginning of the first one. A sample that a place cuts counts on both sides with its
    part there, so a step within one sample has that sample's value.

    Args:
        samples: Of one channel, or their echo strength, shape (n,), any number dtype, n from 1.
        places: Not decreasing, from 0 on, shape (m + 1,).
        least_width: A step must span more samples than this to have a mean.

    Returns:
        Shape (m,), float64; NaN where a step ends beyond the last sample or is not wider than `least_width`.
    """
    cumulative = np.concatenate([[0.0], np.cumsum(samples, dtype=np.float64)])
    totals = np.diff(np.interp(places, np.arange(len(cumulative)), cumulative))
    widths = np.diff(places)
    inside = (places[1:] <= len(samples)) & (widths > least_width)
    means = np.full(len(widths), np.nan)
    means[inside] = totals[inside] / widths[inside]
    return means


def range_normalised(image: FloatImage, *, window_pings: int = 501) -> FloatImage:
    """Divide each column by its mean around each ping: what falls off with range becomes even.

    Args:
        image: Shape (pings, columns); NaN where nothing is known. Over ground or slant range.
        window_pings: Pings over which the mean is taken; long against any object.

    Returns:
        Same shape, float32, about 1 everywhere; NaN stays.
    """
    known = np.isfinite(image)
    values = np.where(known, image, 0).astype(np.float64)
    count = uniform_filter1d(known.astype(np.float64), window_pings, axis=0, mode="constant")
    mean = uniform_filter1d(values, window_pings, axis=0, mode="constant") / np.maximum(count, 1e-9)
    result: FloatImage = np.where(known & (mean > 0), image / np.where(mean > 0, mean, 1), np.nan).astype(np.float32)
    return result


def beam_normalised(image: FloatImage, altitude_m: FloatArray, spacing_m: float) -> FloatImage:
    """Divide each sample by the mean of all samples seen at its angle: beam pattern and grazing angle become even.

    The angle is that from the nadir, atan(ground range / altitude); its pattern is taken over the whole image, so it
    holds when the altitude changes, where a mean by column does not.

    Args:
        image: Over ground range, as `ground_range_image` gives it.
        altitude_m: Altitude of each ping, shape (pings,); NaN where unknown.
        spacing_m: Width of a column in metres.

    Returns:
        Same shape, float32, about 1 everywhere; NaN where nothing is known, or the angle was hardly seen.
    """
    ground_m = (np.arange(image.shape[1]) + 0.5) * spacing_m
    angle = np.arctan2(ground_m[None, :], altitude_m[:, None])
    known = np.isfinite(image) & np.isfinite(angle)
    place = np.where(known, angle / (np.pi / 2) * _ANGLE_BINS, 0).astype(np.intp).clip(0, _ANGLE_BINS - 1)
    count = np.bincount(place[known], minlength=_ANGLE_BINS)
    total = np.bincount(place[known], weights=image[known].astype(np.float64), minlength=_ANGLE_BINS)
    mean = np.where(count >= _LEAST_SAMPLES, total / np.maximum(count, 1), 0.0)
    divisor = mean[place]
    usable = known & (divisor > 0)
    result: FloatImage = np.where(usable, image / np.where(usable, divisor, 1), np.nan).astype(np.float32)
    return result
