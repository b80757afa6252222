"""The transform of `spiht`: the 9/7 wavelet in integers, and the trees over its coefficients."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from sonarpost.codec.interface import Image

FRACTION_BITS = 8
"""Of wavelet coefficients."""

Integers = npt.NDArray[np.int64]

# Lifting steps of the 9/7 wavelet and the scale that makes it nearly orthonormal, times 2**16.
_LIFT = (-103949, -3472, 57862, 29066)
_LOW_GAIN, _HIGH_GAIN = 75340, 57008


def _scale(values: Integers, factor: int) -> Integers:
    return (values * factor + (1 << 15)) >> 16


def _neighbours_of_odd(even: Integers, count: int) -> Integers:
    """Sum of the even samples on both sides of each of `count` odd ones, mirrored at the end."""
    right = even[1 : count + 1]
    if len(right) < count:
        right = np.concatenate((right, even[-1:]))
    return even[:count] + right


def _neighbours_of_even(odd: Integers, count: int) -> Integers:
    """Sum of the odd samples on both sides of each of `count` even ones, mirrored at both ends."""
    left = np.concatenate((odd[:1], odd))[:count]
    right = odd if len(odd) == count else np.concatenate((odd, odd[-1:]))
    return left + right


def _analyse(samples: Integers) -> tuple[Integers, Integers]:
    """Split along axis 0 (at least 2 long) into the low band, ceil(n / 2) long, and the high band."""
    even, odd = samples[0::2].copy(), samples[1::2].copy()
    for step in (0, 2):
        odd += _scale(_neighbours_of_odd(even, len(odd)), _LIFT[step])
        even += _scale(_neighbours_of_even(odd, len(even)), _LIFT[step + 1])
    return _scale(even, _LOW_GAIN), _scale(odd, _HIGH_GAIN)


def _synthesise(low: Integers, high: Integers) -> Integers:
    """Undo `_analyse` along axis 0, but for the rounding of the last bit of the fraction."""
    even, odd = _scale(low, _HIGH_GAIN), _scale(high, _LOW_GAIN)
    for step in (2, 0):
        even -= _scale(_neighbours_of_even(odd, len(even)), _LIFT[step + 1])
        odd -= _scale(_neighbours_of_odd(even, len(odd)), _LIFT[step])
    samples = np.empty((len(even) + len(odd), *even.shape[1:]), dtype=np.int64)
    samples[0::2], samples[1::2] = even, odd
    return samples


@dataclass(frozen=True)
class Forest:
    """The coefficients of a picture size in one row, and the trees over them.

    Attributes:
        shapes: Height and width of the picture and of each low band, finest first.
        size: How many coefficients there are.
        roots: Those of the lowest band, which come first.
        bands: Where each detail band lies: start, height, width; HL, LH, HH, coarsest level first.
        parents: Parent of each coefficient, -1 for a root.
        children: Children of each coefficient.
    """

    shapes: tuple[tuple[int, int], ...]
    size: int
    roots: int
    bands: tuple[tuple[int, int, int], ...]
    parents: Integers
    children: tuple[tuple[int, ...], ...]


@lru_cache(maxsize=8)
def forest_of(height_px: int, width_px: int) -> Forest:
    """Return the trees of a picture size; the lowest band is one coefficient on its shorter side."""
    shapes = [(height_px, width_px)]
    while min(shapes[-1]) >= 2:
        shapes.append(((shapes[-1][0] + 1) // 2, (shapes[-1][1] + 1) // 2))
    low_h, low_w = shapes[-1]
    parents, bands, start = [np.full(low_h * low_w, -1, dtype=np.int64)], [], low_h * low_w
    above = [(0, low_h, low_w, 1)] * 3
    for (h, w), (half_h, half_w) in zip(reversed(shapes[:-1]), reversed(shapes[1:]), strict=True):
        level = []
        for (over, over_h, over_w, step), size in zip(
            above, ((half_h, w // 2), (h // 2, half_w), (h // 2, w // 2)), strict=True
        ):
            rows = np.minimum(np.arange(size[0]) // step, over_h - 1)
            columns = np.minimum(np.arange(size[1]) // step, over_w - 1)
            parents.append((over + rows[:, None] * over_w + columns).ravel())
            level.append((start, *size, 2))
            bands.append((start, *size))
            start += size[0] * size[1]
        above = level
    flat = np.concatenate(parents)
    order = np.argsort(flat, kind="stable")
    ends = np.searchsorted(flat[order], np.arange(start + 1)).tolist()
    listed = order.tolist()
    children = tuple(tuple(listed[a:b]) for a, b in pairwise(ends))
    return Forest(tuple(shapes), start, low_h * low_w, tuple(bands), flat, children)


def transform(image: Image, mean: int, forest: Forest) -> Integers:
    """Return the coefficients of the picture less `mean`, shape (forest.size,), in 2**-8 grey levels."""
    low = (image.astype(np.int64) - mean) << FRACTION_BITS
    flat = np.empty(forest.size, dtype=np.int64)
    for level in range(len(forest.shapes) - 1):
        top, bottom = _analyse(low)
        low, hl = (band.T for band in _analyse(top.T))
        lh, hh = (band.T for band in _analyse(bottom.T))
        first = len(forest.bands) - 3 * (level + 1)
        for (start, h, w), band in zip(forest.bands[first : first + 3], (hl, lh, hh), strict=True):
            flat[start : start + h * w] = band.ravel()
    flat[: forest.roots] = low.ravel()
    return flat


def inverse(flat: Integers, mean: int, forest: Forest) -> Image:
    """Return the picture, shape `forest.shapes[0]`, uint8."""
    low = flat[: forest.roots].reshape(forest.shapes[-1])
    for level in range(len(forest.shapes) - 1):
        hl, lh, hh = (
            flat[start : start + h * w].reshape(h, w) for start, h, w in forest.bands[3 * level : 3 * level + 3]
        )
        top, bottom = _synthesise(low.T, hl.T).T, _synthesise(lh.T, hh.T).T
        low = _synthesise(top, bottom)
    grey = ((low + (1 << (FRACTION_BITS - 1))) >> FRACTION_BITS) + mean
    return np.asarray(np.clip(grey, 0, 255), dtype=np.uint8)
