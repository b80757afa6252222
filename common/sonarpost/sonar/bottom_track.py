"""Bottom tracking: altitude from the first bottom return, which ends the dark water column."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter, uniform_filter

from sonarpost.sonar.survey import Side, Survey

FloatArray = npt.NDArray[np.float64]

_BINS: Final = 512
_RING_DOWN_M: Final = 0.4
"""Range in which the transducers still ring from the transmission; below any survey altitude."""
_SUSTAINED_FRACTION: Final = 1 / 40
"""Fraction of the range that a rise must last; fish and bubbles are shorter."""
_RISE: Final = 0.5
"""Threshold of the first return between the levels of water and bottom, as a fraction in decibels."""
_MIN_CONTRAST: Final = 1.8
_SMOOTHING_PINGS: Final = 5
_MEDIAN_PINGS: Final = 31
"""Window of the median over the estimates; also the longest gap that is interpolated."""
_STEP_BINS: Final = 10
_MIN_STEP: Final = math.log(1.3)


def track_bottom(survey: Survey) -> FloatArray:
    """Estimate the altitude of every ping from the first sustained rise of the echo strength.

    Both sides are averaged by slant range: a rise on one side only is an object. The estimate is the first place after
    the ringing of the transmission where the echo rises above the level of the water and stays there. If the recorder
    compresses the echo, water and far bottom differ little; an earlier and sharper step is then used. A median over
    31 pings smooths the estimates.

    Args:
        survey: Pings with any number of samples and any range.

    Returns:
        Altitude in metres, shape (pings,), float64; NaN without a clear rise.
    """
    range_m = max(survey.max_slant_range_m(side) for side in Side)
    skip = round(_RING_DOWN_M / range_m * _BINS) if range_m > 0 else _BINS
    if skip >= _BINS:  # nothing follows the ringing
        return np.full(len(survey.pings), np.nan)
    echo = _common_range(survey, range_m)
    echo = uniform_filter(echo, size=(_SMOOTHING_PINGS, 3), mode="nearest")
    first = _first_rise(echo, skip)
    first = _with_local_steps(echo, first, skip)
    return _median_smoothed(first * range_m / _BINS)


def _common_range(survey: Survey, range_m: float) -> FloatArray:
    """Return the mean echo of both sides, shape (pings, bins) over 0..range_m, each side scaled to a mean of 1."""
    centres_m = (np.arange(_BINS) + 0.5) * range_m / _BINS
    total = np.zeros((len(survey.pings), _BINS))
    for side in survey.sides():
        image = np.zeros_like(total)
        for row, ping in enumerate(survey.pings):
            channel = ping.channel(side)
            if channel is not None:
                image[row] = _resampled(channel.echo(), channel.sample_spacing_m, centres_m)
        mean = image.mean()
        total += image / mean if mean > 0 else image
    return total


def _resampled(samples: npt.NDArray[np.float32], spacing_m: float, centres_m: FloatArray) -> FloatArray:
    """Return the mean of the samples in each bin (interpolated if bins are finer); 0 beyond the last one."""
    cumulative = np.concatenate([[0.0], np.cumsum(samples, dtype=np.float64)])
    half_m = (centres_m[1] - centres_m[0]) / 2
    edges = np.concatenate([centres_m - half_m, [centres_m[-1] + half_m]]) / spacing_m
    filled = np.interp(edges, np.arange(cumulative.shape[0]), cumulative)
    mean: FloatArray = np.diff(filled) / np.diff(edges)
    return mean


def _first_rise(echo: FloatArray, skip: int) -> FloatArray:
    """Return the bin of the first sustained rise of each row, float64, NaN without one."""
    searched = echo[:, skip:]
    water = np.percentile(searched, 5, axis=1, keepdims=True)
    bottom = np.percentile(searched, 70, axis=1, keepdims=True)
    # The level of a silent water column (zeros) is set to a thousandth of the bottom's.
    water = np.maximum(water, bottom / 1000)
    level = water ** (1 - _RISE) * bottom**_RISE
    above = searched >= level
    hold = max(math.ceil(echo.shape[1] * _SUSTAINED_FRACTION), 2)
    # Number of bins above the level among the `hold` bins from each place on.
    counts = np.cumsum(np.pad(above, ((0, 0), (1, hold))), axis=1)
    sustained = above & (counts[:, hold:-1] - counts[:, : -hold - 1] >= 0.8 * hold)
    # The search starts after the first bin below the level: before it is the transmission.
    started = np.maximum.accumulate(~above, axis=1)
    found = sustained & started
    first = np.where(found.any(axis=1), found.argmax(axis=1) + float(skip), np.nan)
    # Sides are scaled to a mean of 1: a ping below a ten-thousandth of it is silent at any contrast.
    flat = (bottom <= _MIN_CONTRAST * water) | (bottom < 1e-4)
    first[flat[:, 0]] = np.nan
    return first


def _with_local_steps(echo: FloatArray, first: FloatArray, skip: int) -> FloatArray:
    """Replace an estimate by a higher step at a shorter range; a missing estimate by the highest step.

    The step at a bin is the logarithm of the mean echo just after it over that just before it.
    """
    cumulative = np.cumsum(np.pad(echo, ((0, 0), (1, 0))), axis=1)
    means = (cumulative[:, _STEP_BINS:] - cumulative[:, :-_STEP_BINS]) / _STEP_BINS
    floor = np.maximum(np.percentile(echo, 70, axis=1, keepdims=True) / 100, 1e-4)
    logs = np.log(means + floor)
    step = np.full(echo.shape, -np.inf)
    step[:, _STEP_BINS : echo.shape[1] - _STEP_BINS + 1] = logs[:, _STEP_BINS:] - logs[:, :-_STEP_BINS]
    step[:, : skip + _STEP_BINS] = -np.inf  # the near half of the step would be the ringing
    bins = np.arange(echo.shape[1])
    known = np.isfinite(first)
    place = np.where(known, first, echo.shape[1]).astype(np.intp)
    # The level threshold of a gradual rise lies some bins after its step: use the highest step nearby.
    near = np.abs(bins - place[:, None]) <= _STEP_BINS
    own = np.where(near & known[:, None], step, -np.inf).max(axis=1)
    earlier = np.where(bins < (place - 2 * _STEP_BINS)[:, None], step, -np.inf)
    best = earlier.argmax(axis=1)
    height = earlier.max(axis=1)
    better = height >= np.maximum(own, _MIN_STEP)
    return np.where(better, best.astype(np.float64), first)


def _median_smoothed(values: FloatArray) -> FloatArray:
    """Return the median over `_MEDIAN_PINGS` rows; gaps up to that length are interpolated."""
    known = np.flatnonzero(np.isfinite(values))
    if not known.size:
        return values
    rows = np.arange(values.shape[0])
    filled = np.interp(rows, known, values[known])
    smooth = np.asarray(median_filter(filled, size=_MEDIAN_PINGS, mode="nearest"), dtype=np.float64)
    nearest = np.min(np.abs(rows[:, None] - known[_neighbours(rows, known)]), axis=1)
    smooth[nearest > _MEDIAN_PINGS // 2] = np.nan
    return smooth


def _neighbours(rows: npt.NDArray[np.intp], known: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Return the indices in `known` (ascending) of the neighbours below and above each row, shape (rows, 2)."""
    above = np.searchsorted(known, rows).clip(0, known.size - 1)
    return np.stack([(above - 1).clip(0), above], axis=1)


def altitudes_m(survey: Survey) -> FloatArray:
    """Return the altitude of every ping: that of the file, else from `track_bottom`.

    Returns:
        Shape (pings,), float64, metres; NaN if both are unknown.
    """
    recorded = np.array([math.nan if p.altitude_m is None else p.altitude_m for p in survey.pings], dtype=np.float64)
    missing = np.isnan(recorded)
    if missing.any() and any(side in survey.sides() for side in Side):
        recorded[missing] = track_bottom(survey)[missing]
    return recorded
