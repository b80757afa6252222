"""Contexts: what the networks know of a coefficient, as integers.

The features of a decision are magnitudes and signs around the coefficient, in eighths of the threshold, its place, and
the low-pass image decoded so far (docs/specifications/emb-stream.md). All arithmetic is on int32 and int64.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb.transform import (
    CHILD,
    COUSIN_1,
    HEIGHT,
    LEVEL,
    LL,
    LOW,
    NEXT_1,
    OFFSET,
    ORIENT,
    PARENT,
    SIBLING_1,
    SIBLING_2,
    STRIDE,
    WIDTH,
)
from sonarpost.codec.jit import inlined, jit

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]

FEATURES: Final = 54
BAND_FEATURES: Final = 44
"""Index of the first feature that is the same for a whole band."""
SIGN_ODD: Final = 51
"""Number of odd sign features, which change sign with the image. The even features after them do not."""
SIGN_FEATURES: Final = 61
MAX_EIGHTHS: Final = 48
"""Largest magnitude in a context: 6 thresholds, in eighths."""
INVERSE_BITS: Final = 54

int64: Final = cast(Callable[[Any], int], np.int64)
"""Conversion to int64. Compiled functions call one another with int64 only, so that each has one specialisation."""

# Neighbours of a coefficient: steps down and to the right.
_CROSS: Final = np.array([(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)], np.int64)
_SIDES: Final = np.array([(0, -1), (0, 1), (-1, 0), (1, 0)], np.int64)
_CORNERS: Final = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)], np.int64)
_DISTANT: Final = np.array([(0, -2), (0, 2), (-2, 0), (2, 0)], np.int64)
_AROUND: Final = np.array([(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)], np.int64)


@inlined
def clip(value: int, limit: int) -> int:
    """Return the value, limited to -limit..limit."""
    return min(max(value, -limit), limit)


@jit
def log2_eighths(value: int) -> int:
    """Return 8 log2(value) for value >= 1, linear between powers of two, as an integer."""
    power, rest = 0, value
    for step in (32, 16, 8, 4, 2, 1):
        if rest >> step:
            power += step
            rest >>= step
    return int(8 * power + ((value << 3) >> power) - 8)


@jit
def _sum_around(plane: I32, at: int, stride: int) -> int:
    """Return the sum of the eight neighbours."""
    up, down = at - stride, at + stride
    return int(
        plane[up - 1]
        + plane[up]
        + plane[up + 1]
        + plane[at - 1]
        + plane[at + 1]
        + plane[down - 1]
        + plane[down]
        + plane[down + 1]
    )


@jit
def _gather(f: I32, first: int, plane: I32, at: int, stride: int, places: I64) -> None:
    """Store neighbours of a cell in `f` from index `first`. `places` has shape (neighbours, 2): steps down and right.

    `first` is an int64, because a literal number gives a specialisation of its own.
    """
    for i in range(places.shape[0]):
        f[first + i] = plane[at + places[i, 0] * stride + places[i, 1]]


@jit
def _cell_index(bands: I32, row: int, y: int, x: int) -> int:
    """Return the flat index of a cell, clipped to the band; -1 for an empty band."""
    height, width = int64(bands[row, HEIGHT]), int64(bands[row, WIDTH])
    if height == 0 or width == 0:
        return -1
    return int(bands[row, OFFSET] + min(y, height - 1) * bands[row, STRIDE] + min(x, width - 1))


@inlined
def has_significant_neighbour(sizes: I32, bands: I32, row: int, y: int, x: int, at: int) -> bool:
    """Return whether a neighbour, the parent or a sibling is significant, or the band has no parent."""
    if bands[row, PARENT] < 0:
        return True
    if _sum_around(sizes, at, int64(bands[row, STRIDE])) > 0:
        return True
    parent = _cell_index(bands, int64(bands[row, PARENT]), y >> 1, x >> 1)
    if parent >= 0 and sizes[parent] > 0:
        return True
    for column in range(SIBLING_1, SIBLING_2 + 1):
        sibling = bands[row, column]
        if sibling >= 0 and sizes[bands[sibling, OFFSET] + y * bands[sibling, STRIDE] + x] > 0:
            return True
    return False


@inlined
def _quotient(size: int, threshold: int, inverse: int) -> int:
    """Return min(size // threshold, MAX_EIGHTHS) without a division; `inverse` is 2^54 // threshold + 1.

    The result is exact: the multiplied size is below 48 thresholds, and 48 times the largest threshold squared is below
    2^54.
    """
    return int((size * inverse) >> INVERSE_BITS) if size < MAX_EIGHTHS * threshold else MAX_EIGHTHS


@jit
def coefficient_context(  # noqa: C901, PLR0912, PLR0915  44 features, one after the other
    f: I32,
    sizes: I32,
    insignificant: I32,
    lows: I32,
    bands: I32,
    low_width: int,
    threshold: int,
    inverse: int,
    row: int,
    y: int,
    x: int,
    at: int,
) -> None:
    """Compute the features of one coefficient. The band features at the end of `f` are set already."""
    stride = int64(bands[row, STRIDE])
    f[0], f[1] = sizes[at - 1], sizes[at - stride]
    f[2], f[3] = sizes[at - stride - 1], sizes[at - stride + 1]
    f[4], f[5] = sizes[at + 1], sizes[at + stride]
    f[6], f[7] = sizes[at + stride - 1], sizes[at + stride + 1]
    f[8], f[9] = sizes[at - 2], sizes[at - 2 * stride]
    f[10], f[11] = sizes[at + 2], sizes[at + 2 * stride]
    f[12] = sizes[at]
    window = int64(0)
    for dy in range(-2, 3):
        line = at + dy * stride
        window += sizes[line - 2] + sizes[line - 1] + sizes[line] + sizes[line + 1] + sizes[line + 2]
    f[13] = (window - sizes[at]) >> 2
    for i in range(14, BAND_FEATURES):
        f[i] = 0
    f[40] = min(y, bands[row, HEIGHT] - 1 - y, 6) * 4
    f[41] = min(x, bands[row, WIDTH] - 1 - x, 6) * 4
    f[42] = _sum_around(insignificant, at, stride) * 6
    if bands[row, ORIENT] == LL:
        f[31], f[32] = min(y, 8) * 4, min(x, 8) * 4
        f[33] = 32 if y == 0 and x == 0 else 0
        return
    parent = int64(bands[row, PARENT])
    if parent >= 0:
        cell = _cell_index(bands, parent, y >> 1, x >> 1)
        if cell >= 0:
            width = int64(bands[parent, STRIDE])
            f[14], f[15] = sizes[cell], _sum_around(sizes, cell, width) >> 1
            f[43] += insignificant[cell] * 16
            f[16], f[17] = sizes[cell - 1] + sizes[cell + 1], sizes[cell - width] + sizes[cell + width]
            # The parent's neighbour on the side of this coefficient.
            f[18] = sizes[cell + (1 if x & 1 else -1)]
            f[19] = sizes[cell + (width if y & 1 else -width)]
        grand = int64(bands[parent, PARENT])
        if grand >= 0:
            cell = _cell_index(bands, grand, y >> 2, x >> 2)
            if cell >= 0:
                f[20], f[21] = sizes[cell], _sum_around(sizes, cell, int64(bands[grand, STRIDE])) >> 1
    for k in range(2):
        sibling = int64(bands[row, SIBLING_1 + k])
        if sibling >= 0:
            width = int64(bands[sibling, STRIDE])
            cell = bands[sibling, OFFSET] + y * width + x
            f[22 + 2 * k], f[23 + 2 * k] = sizes[cell], _sum_around(sizes, cell, width) >> 1
            f[43] += insignificant[cell] * 16
        following = int64(bands[row, NEXT_1 + k])
        if following >= 0:
            cell = _cell_index(bands, following, y, x)
            if cell >= 0:
                width = int64(bands[following, STRIDE])
                f[34 + 2 * k], f[35 + 2 * k] = sizes[cell], _sum_around(sizes, cell, width) >> 1
        cousin = int64(bands[row, COUSIN_1 + k])
        if cousin >= 0:
            cell = _cell_index(bands, cousin, y >> 1, x >> 1)
            if cell >= 0:
                f[38 + k] = (sizes[cell] + _sum_around(sizes, cell, int64(bands[cousin, STRIDE]))) >> 1
    child = bands[row, CHILD]
    if child >= 0:
        cell = bands[child, OFFSET] + 2 * y * bands[child, STRIDE] + 2 * x
        below = cell + bands[child, STRIDE]
        f[26] = (sizes[cell] + sizes[cell + 1] + sizes[below] + sizes[below + 1]) >> 1
    low_stride = low_width + 2
    here = bands[row, LOW] + (y + 1) * low_stride + x + 1
    level = int64(bands[row, LEVEL])
    middle, left, right = int64(lows[here]), int64(lows[here - 1]), int64(lows[here + 1])
    above, below = int64(lows[here - low_stride]), int64(lows[here + low_stride])
    total = left + right + above + below
    f[27] = min(log2_eighths(max(middle >> level, 256)), 120) - 80  # 1/64 grey, at least 4 grey
    f[28] = _quotient(abs(right - left) * 4, threshold, inverse)
    f[29] = _quotient(abs(below - above) * 4, threshold, inverse)
    f[30] = _quotient(abs(4 * middle - total) * 2, threshold, inverse)
    f[31] = min(log2_eighths(max(total >> (level + 2), 256)), 120) - 80


@jit
def sign_context(  # noqa: C901, PLR0912, PLR0915  61 features, one after the other
    f: I32, signed: I32, lows: I32, bands: I32, low_width: int, threshold: int, row: int, y: int, x: int, at: int
) -> None:
    """Compute the sign features of a coefficient: signed neighbours (odd features) and its position (even features)."""
    stride, level = int64(bands[row, STRIDE]), int64(bands[row, LEVEL])
    for i in range(SIGN_FEATURES):
        f[i] = 0
    _gather(f, int64(0), signed, at, stride, _SIDES)
    _gather(f, int64(11), signed, at, stride, _CORNERS)
    f[4], f[5] = f[11] - f[12], f[14] - f[13]
    _gather(f, int64(15), signed, at, stride, _DISTANT)
    f[SIGN_ODD], f[SIGN_ODD + 1] = (x & 1) * 16, (y & 1) * 16
    f[SIGN_ODD + 2], f[SIGN_ODD + 3] = min(y, 8) * 2, min(x, 8) * 2
    f[SIGN_ODD + 3 + min(level, 5)] = 16
    if bands[row, ORIENT] != LL:
        parent = int64(bands[row, PARENT])
        if parent >= 0:
            cell = _cell_index(bands, parent, y >> 1, x >> 1)
            if cell >= 0:
                width = int64(bands[parent, STRIDE])
                f[6] = signed[cell]
                _gather(f, int64(19), signed, cell, width, _SIDES)
                _gather(f, int64(23), signed, cell, width, _CORNERS)
        for k in range(2):
            # A band has either sibling k or following band k.
            beside, cell = int64(bands[row, SIBLING_1 + k]), int64(-1)
            if beside >= 0:
                cell = bands[beside, OFFSET] + y * bands[beside, STRIDE] + x
            if bands[row, NEXT_1 + k] >= 0:
                beside = int64(bands[row, NEXT_1 + k])
                cell = _cell_index(bands, beside, y, x)
            if cell >= 0:
                _gather(f, 27 + 5 * k, signed, cell, int64(bands[beside, STRIDE]), _CROSS)
            cousin = int64(bands[row, COUSIN_1 + k])
            if cousin >= 0:
                cell = _cell_index(bands, cousin, y >> 1, x >> 1)
                if cell >= 0:
                    f[37 + k] = signed[cell]
        child = bands[row, CHILD]
        if child >= 0:
            cell = bands[child, OFFSET] + 2 * y * bands[child, STRIDE] + 2 * x
            below = cell + bands[child, STRIDE]
            f[39], f[40], f[41], f[42] = signed[cell], signed[cell + 1], signed[below], signed[below + 1]
        low_stride = low_width + 2
        here = bands[row, LOW] + (y + 1) * low_stride + x + 1
        middle = int64(lows[here])
        for i in range(8):
            change = int64(lows[here + _AROUND[i, 0] * low_stride + _AROUND[i, 1]]) - middle
            f[43 + i] = clip(change * 4 // threshold, MAX_EIGHTHS)
        right, left = int64(lows[here + 1]), int64(lows[here - 1])
        below, above = int64(lows[here + low_stride]), int64(lows[here - low_stride])
        f[7] = clip((right - left) * 4 // threshold, MAX_EIGHTHS)
        f[8] = clip((below - above) * 4 // threshold, MAX_EIGHTHS)
        f[9] = clip((right + left - 2 * middle) * 4 // threshold, MAX_EIGHTHS)
        f[10] = clip((below + above - 2 * middle) * 4 // threshold, MAX_EIGHTHS)
    nonzero = 0
    for i in range(6):
        if f[i] != 0:
            nonzero += 4
    f[SIGN_ODD + 9] = nonzero
