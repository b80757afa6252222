"""The coding loop: contexts and networks. The same code encodes, decodes and collects training examples.

All arithmetic is on int32 and int64. docs/explanation/codecs.md describes the format.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb.range_coder import (
    CODER_CODE,
    CODER_COST,
    CODER_ROWS,
    CODER_SIGN_ROWS,
    COLLECT,
    WRITE,
    code_bit,
)
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
I16 = npt.NDArray[np.int16]
U8 = npt.NDArray[np.uint8]

NEAR, REFINE, ALL = 0, 1, 2
"""Kinds of pass: insignificant coefficients with significant neighbours; significant ones; all insignificant ones."""

FEATURES: Final = 54
BAND_FEATURES: Final = 44
"""Index of the first feature that is the same for a whole band."""
SIGN_ODD: Final = 51
"""Number of odd sign features, which change sign with the image. The even features after them do not."""
SIGN_FEATURES: Final = 61
HIDDEN_1: Final = 32
HIDDEN_2: Final = 16
SIGN_HIDDEN: Final = 32
MAX_EIGHTHS: Final = 48
"""Largest magnitude in a context: 6 thresholds, in eighths."""
LOGIT_LIMIT: Final = 3071
"""Largest logit, in 1/256. The table of probabilities covers -LOGIT_LIMIT to LOGIT_LIMIT."""
CENTRE_COLUMNS: Final = 24
"""Columns of the table of reconstruction points: logits from -9 in steps of 1/2."""
_CENTRE_SHIFT: Final = 2304
_LIVE_LIMIT: Final = 1 << 34
_INVERSE_BITS: Final = 54
# A pass skips a coefficient whose last logit is this far below the minimum of the pass. The first value is for logits
# of this plane, the second for earlier ones: the probability grows when the threshold is halved.
_SKIP_NEAR: Final = 384
_SKIP_FAR: Final = 896

_int64: Final = cast(Callable[[Any], int], np.int64)
"""Conversion to int64. Compiled functions call one another with int64 only, so that each has one specialisation."""

# Neighbours of a coefficient: steps down and to the right.
_CROSS: Final = np.array([(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)], np.int64)
_SIDES: Final = np.array([(0, -1), (0, 1), (-1, 0), (1, 0)], np.int64)
_CORNERS: Final = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)], np.int64)
_DISTANT: Final = np.array([(0, -2), (0, 2), (-2, 0), (2, 0)], np.int64)
_AROUND: Final = np.array([(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)], np.int64)


@inlined
def _clip(value: int, limit: int) -> int:
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
    height, width = _int64(bands[row, HEIGHT]), _int64(bands[row, WIDTH])
    if height == 0 or width == 0:
        return -1
    return int(bands[row, OFFSET] + min(y, height - 1) * bands[row, STRIDE] + min(x, width - 1))


@inlined
def _has_significant_neighbour(sizes: I32, bands: I32, row: int, y: int, x: int, at: int) -> bool:
    """Return whether a neighbour, the parent or a sibling is significant, or the band has no parent."""
    if bands[row, PARENT] < 0:
        return True
    if _sum_around(sizes, at, _int64(bands[row, STRIDE])) > 0:
        return True
    parent = _cell_index(bands, _int64(bands[row, PARENT]), y >> 1, x >> 1)
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
    return int((size * inverse) >> _INVERSE_BITS) if size < MAX_EIGHTHS * threshold else MAX_EIGHTHS


@jit
def _context(  # noqa: C901, PLR0912, PLR0915  44 features, one after the other
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
    stride = _int64(bands[row, STRIDE])
    f[0], f[1] = sizes[at - 1], sizes[at - stride]
    f[2], f[3] = sizes[at - stride - 1], sizes[at - stride + 1]
    f[4], f[5] = sizes[at + 1], sizes[at + stride]
    f[6], f[7] = sizes[at + stride - 1], sizes[at + stride + 1]
    f[8], f[9] = sizes[at - 2], sizes[at - 2 * stride]
    f[10], f[11] = sizes[at + 2], sizes[at + 2 * stride]
    f[12] = sizes[at]
    window = _int64(0)
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
    parent = _int64(bands[row, PARENT])
    if parent >= 0:
        cell = _cell_index(bands, parent, y >> 1, x >> 1)
        if cell >= 0:
            width = _int64(bands[parent, STRIDE])
            f[14], f[15] = sizes[cell], _sum_around(sizes, cell, width) >> 1
            f[43] += insignificant[cell] * 16
            f[16], f[17] = sizes[cell - 1] + sizes[cell + 1], sizes[cell - width] + sizes[cell + width]
            # The parent's neighbour on the side of this coefficient.
            f[18] = sizes[cell + (1 if x & 1 else -1)]
            f[19] = sizes[cell + (width if y & 1 else -width)]
        grand = _int64(bands[parent, PARENT])
        if grand >= 0:
            cell = _cell_index(bands, grand, y >> 2, x >> 2)
            if cell >= 0:
                f[20], f[21] = sizes[cell], _sum_around(sizes, cell, _int64(bands[grand, STRIDE])) >> 1
    for k in range(2):
        sibling = _int64(bands[row, SIBLING_1 + k])
        if sibling >= 0:
            width = _int64(bands[sibling, STRIDE])
            cell = bands[sibling, OFFSET] + y * width + x
            f[22 + 2 * k], f[23 + 2 * k] = sizes[cell], _sum_around(sizes, cell, width) >> 1
            f[43] += insignificant[cell] * 16
        following = _int64(bands[row, NEXT_1 + k])
        if following >= 0:
            cell = _cell_index(bands, following, y, x)
            if cell >= 0:
                width = _int64(bands[following, STRIDE])
                f[34 + 2 * k], f[35 + 2 * k] = sizes[cell], _sum_around(sizes, cell, width) >> 1
        cousin = _int64(bands[row, COUSIN_1 + k])
        if cousin >= 0:
            cell = _cell_index(bands, cousin, y >> 1, x >> 1)
            if cell >= 0:
                f[38 + k] = (sizes[cell] + _sum_around(sizes, cell, _int64(bands[cousin, STRIDE]))) >> 1
    child = bands[row, CHILD]
    if child >= 0:
        cell = bands[child, OFFSET] + 2 * y * bands[child, STRIDE] + 2 * x
        below = cell + bands[child, STRIDE]
        f[26] = (sizes[cell] + sizes[cell + 1] + sizes[below] + sizes[below + 1]) >> 1
    low_stride = low_width + 2
    here = bands[row, LOW] + (y + 1) * low_stride + x + 1
    level = _int64(bands[row, LEVEL])
    middle, left, right = _int64(lows[here]), _int64(lows[here - 1]), _int64(lows[here + 1])
    above, below = _int64(lows[here - low_stride]), _int64(lows[here + low_stride])
    total = left + right + above + below
    f[27] = min(log2_eighths(max(middle >> level, 256)), 120) - 80  # 1/64 grey, at least 4 grey
    f[28] = _quotient(abs(right - left) * 4, threshold, inverse)
    f[29] = _quotient(abs(below - above) * 4, threshold, inverse)
    f[30] = _quotient(abs(4 * middle - total) * 2, threshold, inverse)
    f[31] = min(log2_eighths(max(total >> (level + 2), 256)), 120) - 80


@inlined
def _active(total: int, shift: int) -> int:
    """Return the activation of a hidden unit: 1/256, never negative."""
    return min(max(total >> shift, 0), 4095)


@jit
def _logit(f: I32, base: I32, w1: I32, w2: I32, b2: I32, last_layer: I64, h1: I32, h2: I32) -> int:
    """Evaluate the network: features, two hidden layers, one logit in 1/256. `h2` receives the last hidden layer."""
    for j in range(HIDDEN_1):
        h1[j] = base[j]
    for i in range(0, BAND_FEATURES, 4):  # four rows at a time: fewer loads and stores
        p, q, r, s = f[i], f[i + 1], f[i + 2], f[i + 3]
        if (p | q | r | s) != 0:
            for j in range(HIDDEN_1):
                h1[j] += p * w1[i, j] + q * w1[i + 1, j] + r * w1[i + 2, j] + s * w1[i + 3, j]
    for j in range(HIDDEN_2):
        h2[j] = b2[j]
    for j in range(HIDDEN_1):
        h1[j] = _active(_int64(h1[j]), 6)
    for i in range(0, HIDDEN_1, 8):
        p, q, r, s = h1[i], h1[i + 1], h1[i + 2], h1[i + 3]
        t, u, v, w = h1[i + 4], h1[i + 5], h1[i + 6], h1[i + 7]
        for j in range(HIDDEN_2):
            h2[j] += (
                p * w2[i, j] + q * w2[i + 1, j] + r * w2[i + 2, j] + s * w2[i + 3, j]
                + t * w2[i + 4, j] + u * w2[i + 5, j] + v * w2[i + 6, j] + w * w2[i + 7, j]
            )  # fmt: skip
    total = _int64(last_layer[HIDDEN_2]) * 256
    for i in range(h2.shape[0]):
        h2[i] = _active(_int64(h2[i]), 12)
        total += _int64(h2[i]) * last_layer[i]
    return _clip(total >> 28, LOGIT_LIMIT)


@inlined
def _adapt(last_layer: I64, h2: I32, bit: int, probability: int) -> None:
    """Update the weights of the last layer by gradient descent on the code length of the bit, at a rate of 1/256.

    Units: error 1/2^16, hidden units 1/2^8, weights 1/2^28.
    """
    error = _int64((bit << 16) - probability)
    for i in range(h2.shape[0]):
        last_layer[i] = min(max(last_layer[i] + ((error * h2[i]) >> 4), -_LIVE_LIMIT), _LIVE_LIMIT)
    last_layer[HIDDEN_2] = min(max(last_layer[HIDDEN_2] + (error << 4), -_LIVE_LIMIT), _LIVE_LIMIT)


@inlined
def band_base(f: I32, w1: I32, b1: I32, base: I32) -> None:
    """Compute the contribution of the band features to the first layer."""
    for j in range(base.shape[0]):
        base[j] = b1[j]
    for i in range(BAND_FEATURES, f.shape[0]):
        for j in range(base.shape[0]):
            base[j] += f[i] * w1[i, j]


@jit
def _sign_context(  # noqa: C901, PLR0912, PLR0915  61 features, one after the other
    f: I32, signed: I32, lows: I32, bands: I32, low_width: int, threshold: int, row: int, y: int, x: int, at: int
) -> None:
    """Compute the sign features of a coefficient: signed neighbours (odd features) and its position (even features)."""
    stride, level = _int64(bands[row, STRIDE]), _int64(bands[row, LEVEL])
    for i in range(SIGN_FEATURES):
        f[i] = 0
    _gather(f, _int64(0), signed, at, stride, _SIDES)
    _gather(f, _int64(11), signed, at, stride, _CORNERS)
    f[4], f[5] = f[11] - f[12], f[14] - f[13]
    _gather(f, _int64(15), signed, at, stride, _DISTANT)
    f[SIGN_ODD], f[SIGN_ODD + 1] = (x & 1) * 16, (y & 1) * 16
    f[SIGN_ODD + 2], f[SIGN_ODD + 3] = min(y, 8) * 2, min(x, 8) * 2
    f[SIGN_ODD + 3 + min(level, 5)] = 16
    if bands[row, ORIENT] != LL:
        parent = _int64(bands[row, PARENT])
        if parent >= 0:
            cell = _cell_index(bands, parent, y >> 1, x >> 1)
            if cell >= 0:
                width = _int64(bands[parent, STRIDE])
                f[6] = signed[cell]
                _gather(f, _int64(19), signed, cell, width, _SIDES)
                _gather(f, _int64(23), signed, cell, width, _CORNERS)
        for k in range(2):
            # A band has either sibling k or following band k.
            beside, cell = _int64(bands[row, SIBLING_1 + k]), _int64(-1)
            if beside >= 0:
                cell = bands[beside, OFFSET] + y * bands[beside, STRIDE] + x
            if bands[row, NEXT_1 + k] >= 0:
                beside = _int64(bands[row, NEXT_1 + k])
                cell = _cell_index(bands, beside, y, x)
            if cell >= 0:
                _gather(f, 27 + 5 * k, signed, cell, _int64(bands[beside, STRIDE]), _CROSS)
            cousin = _int64(bands[row, COUSIN_1 + k])
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
        middle = _int64(lows[here])
        for i in range(8):
            change = _int64(lows[here + _AROUND[i, 0] * low_stride + _AROUND[i, 1]]) - middle
            f[43 + i] = _clip(change * 4 // threshold, MAX_EIGHTHS)
        right, left = _int64(lows[here + 1]), _int64(lows[here - 1])
        below, above = _int64(lows[here + low_stride]), _int64(lows[here - low_stride])
        f[7] = _clip((right - left) * 4 // threshold, MAX_EIGHTHS)
        f[8] = _clip((below - above) * 4 // threshold, MAX_EIGHTHS)
        f[9] = _clip((right + left - 2 * middle) * 4 // threshold, MAX_EIGHTHS)
        f[10] = _clip((below + above - 2 * middle) * 4 // threshold, MAX_EIGHTHS)
    nonzero = 0
    for i in range(6):
        if f[i] != 0:
            nonzero += 4
    f[SIGN_ODD + 9] = nonzero


@jit
def _sign_logit(f: I32, b1: I32, w1: I32, w2: I32, orient: int, sums: I32) -> int:
    """Return the logit of a positive sign, an odd function of the odd features. One network for each orientation.

    `sums` has 2 * SIGN_HIDDEN cells and is overwritten: sums over the odd features, sums over the others.
    """
    for j in range(SIGN_HIDDEN):
        sums[j], sums[SIGN_HIDDEN + j] = 0, b1[orient, j]
    for i in range(SIGN_FEATURES):
        if f[i] != 0:
            start = 0 if i < SIGN_ODD else SIGN_HIDDEN
            for j in range(SIGN_HIDDEN):
                sums[start + j] += f[i] * w1[orient, i, j]
    total = _int64(0)
    for j in range(SIGN_HIDDEN):
        odd, even = _int64(sums[j]), _int64(sums[SIGN_HIDDEN + j])
        total += (_active(even + odd, 6) - _active(even - odd, 6)) * w2[orient, j]
    return _clip(total >> 12, LOGIT_LIMIT)


@inlined
def _reconstruct(lower: int, width: int, logit: int, centres: I32) -> int:
    """Return the mean magnitude of coefficients in this interval with this logit. Unlikely ones are smaller."""
    size = min(lower // width, 4) - 1
    column = min(max((logit + _CENTRE_SHIFT) >> 7, 0), CENTRE_COLUMNS - 1)
    return int(lower + (width * centres[size, column] >> 8))


@jit
def reconstruct(lower: I32, widths: I32, signs: I32, logits: I32, centres: I32, out: I32) -> None:
    """Write the reconstruction value of every coefficient to `out`."""
    for at in range(lower.shape[0]):
        value = _int64(0)
        if lower[at] > 0:
            value = _reconstruct(_int64(lower[at]), _int64(widths[at]), _int64(logits[at]), centres)
        out[at] = signs[at] * value


@jit
def update_sizes(lower: I32, widths: I32, signs: I32, sizes: I32, signed: I32, threshold: int) -> None:
    """Express the reconstruction of every coefficient in eighths of the threshold."""
    for at in range(lower.shape[0]):
        if lower[at] > 0:
            sizes[at] = min((lower[at] + (widths[at] >> 1)) * 8 // threshold, MAX_EIGHTHS)
            signed[at] = sizes[at] * signs[at]


@inlined
def _collect_decision(rows: I16, coder: I64, f: I32, bit: int, net: int, interval: int) -> None:
    """Store a training example, one of `interval` on average, chosen by a reproducible random number."""
    coder[CODER_CODE] = (coder[CODER_CODE] * 1103515245 + 12345) & 0x7FFFFFFF
    n = coder[CODER_ROWS]
    if (coder[CODER_CODE] >> 12) % interval or n >= rows.shape[0]:
        return
    for i in range(FEATURES):
        rows[n, i] = f[i]
    rows[n, FEATURES], rows[n, FEATURES + 1], rows[n, FEATURES + 2] = bit, net, interval
    coder[CODER_ROWS] = n + 1


@inlined
def _collect_sign(rows: I16, coder: I64, f: I32, orient: int, sign: int) -> None:
    n = coder[CODER_SIGN_ROWS]
    if n >= rows.shape[0]:
        return
    for i in range(SIGN_FEATURES):
        rows[n, i] = f[i]
    rows[n, SIGN_FEATURES], rows[n, SIGN_FEATURES + 1] = orient, sign
    coder[CODER_SIGN_ROWS] = n + 1


@inlined
def _transfer(mode: int, bit: int, logit: int, probabilities: I32, costs: I32, coder: I64, data: U8, best: U8) -> int:
    """Write `bit`, or read one; return it, or -1 at the end."""
    coded = code_bit(coder, data, best, bit, _int64(probabilities[logit + LOGIT_LIMIT]), mode)
    if mode == WRITE and coded >= 0:
        coder[CODER_COST] += costs[(logit if coded else -logit) + LOGIT_LIMIT]
    return coded


@inlined
def _is_worthwhile(magnitude: int, threshold: int, reconstruction: int, cost: int, price: int) -> bool:
    """Return whether a significant coefficient removes enough squared error for its bits and its sign bit."""
    size, decoded = magnitude * 16 // threshold, reconstruction * 16 // threshold
    return bool(decoded * (2 * size - decoded) >= (price * (cost + 256)) >> 8)


def scratch_arrays() -> tuple[I32, I32, I32, I32, I32]:
    """Return arrays for `code_band`: base, h1 and h2 of `_logit`, sign features, sums of `_sign_logit`."""
    base, h1, h2 = (np.zeros(size, np.int32) for size in (HIDDEN_1, HIDDEN_1, HIDDEN_2))
    return base, h1, h2, np.zeros(SIGN_FEATURES, np.int32), np.zeros(2 * SIGN_HIDDEN, np.int32)


@jit
def code_band(  # noqa: C901, PLR0912, PLR0915  one loop keeps modes and passes consistent
    mode: int,
    kind: int,
    plane: int,
    threshold: int,
    row: int,
    low_width: int,
    price: int,
    min_logit: int,
    bands: I32,
    targets: I32,
    lows: I32,
    f: I32,
    state: tuple[I32, I32, I32, I32, I32, I32, I32, I32, I32],
    nets: tuple[I32, I32, I32, I32, I64],
    sign_nets: tuple[I32, I32, I32],
    tables: tuple[I32, I32, I32],
    stream: tuple[I64, U8, U8, I64, I32],
    examples: tuple[I16, I16],
    scratch: tuple[I32, I32, I32, I32, I32],
) -> int:
    """Code one pass over one band. Returns 0, or -1 at the end of the stream or of the budget.

    Args:
        mode: WRITE, READ or COLLECT.
        kind: NEAR, REFINE or ALL.
        plane: Number of the bit plane, from 1.
        threshold: Threshold of the plane, in coefficient units.
        row: Row of the band in `bands`.
        low_width: Width of the low-pass image of the band's level.
        price: Lagrange multiplier (WRITE): least squared error that a bit of significance must remove, in 1/256 of the
            squared threshold. 0: no minimum.
        min_logit: The pass codes coefficients with at least this logit of significance.
        bands: The band table.
        targets: The coefficients to code (WRITE, COLLECT), flat, scaled.
        lows: Low-pass images reconstructed so far.
        f: Features. The band features, from BAND_FEATURES, are set.
        state: Arrays of `CoefficientState`: lower bound of the magnitude, 0 if not significant; width of the interval;
            sign; magnitude in eighths of the threshold, at most MAX_EIGHTHS; the same with sign; plane that decided
            last, or minus the plane that evaluated last; logit of the last decision or evaluation; 1 if this plane
            decided that the coefficient stays insignificant; scale, 1/256.
        nets: Weights w1, b1, w2, b2, and the adapted weights w3 and b3, 1/2^28 (see `_adapt`). First axis: 0
            significance, 1 refinement.
        sign_nets: Weights w1, b1, w2; first axis: orientation of the band.
        tables: Probability of 1 in 1/65536 and cost of a 1 in 1/256 bit, by logit + LOGIT_LIMIT; reconstruction points
            in 1/256 of the interval, see `_reconstruct`.
        stream: State of the range coder; bytes; the best complete stream so far (WRITE); squared error by number of
            bytes; the original coefficients, flat, to which the error refers.
        examples: Training examples of decisions and of signs (COLLECT).
        scratch: Arrays for intermediate results; see `scratch_arrays`.
    """
    lower, widths, signs, sizes, signed, planes, logits, insignificant, scale = state
    sign_w1, sign_b1, sign_w2 = sign_nets
    probabilities, costs, centres = tables
    coder, data, best, curve, originals = stream
    base, h1, h2, sign_features, sums = scratch
    stride, orient, level = _int64(bands[row, STRIDE]), _int64(bands[row, ORIENT]), _int64(bands[row, LEVEL])
    inverse = int((1 << _INVERSE_BITS) // _int64(threshold) + 1)
    interval = 12 if level == 1 else 4 if level == 2 else 1
    net = 1 if kind == REFINE else 0
    w1, b1, w2, b2, last_layer = nets[0][net], nets[1][net], nets[2][net], nets[3][net], nets[4][net]
    band_base(f, w1, b1, base)
    for y in range(_int64(bands[row, HEIGHT])):
        for x in range(_int64(bands[row, WIDTH])):
            at = bands[row, OFFSET] + y * stride + x
            if planes[at] == plane or (lower[at] > 0) != (kind == REFINE):
                continue
            is_near = kind == REFINE or _has_significant_neighbour(sizes, bands, row, y, x, at)
            if kind == NEAR and not is_near:
                continue
            if kind == ALL and logits[at] < min_logit - (_SKIP_NEAR if planes[at] == -plane else _SKIP_FAR):
                continue
            magnitude = abs(_int64(targets[at]))
            bit = 1 if magnitude >= lower[at] + threshold else 0
            _context(f, sizes, insignificant, lows, bands, low_width, threshold, inverse, row, y, x, at)
            logit = _logit(f, base, w1, w2, b2, last_layer, h1, h2)
            if logit < min_logit:
                planes[at], logits[at] = -plane, logit
                continue
            planes[at] = plane
            if mode == COLLECT:
                _collect_decision(examples[0], coder, f, bit, net, 1 if is_near else interval)
            else:
                if mode == WRITE and bit and kind != REFINE:
                    decoded = _reconstruct(threshold, threshold, logit, centres)
                    bit = 1 if _is_worthwhile(magnitude, threshold, decoded, costs[logit + LOGIT_LIMIT], price) else 0
                bit = _transfer(mode, bit, logit, probabilities, costs, coder, data, best)
                if bit < 0:
                    planes[at] = -plane
                    return -1
                _adapt(last_layer, h2, bit, probabilities[logit + LOGIT_LIMIT])
            before = 0
            if lower[at] > 0:
                before = _reconstruct(_int64(lower[at]), _int64(widths[at]), _int64(logits[at]), centres)
            logits[at] = logit
            if kind == REFINE:
                # A plane halves the interval, unless its bounds were rescaled.
                widths[at] = max(widths[at] - threshold, threshold >> 1) if bit else min(widths[at], threshold)
                lower[at] += threshold * bit
            elif bit:
                sign = 1 if targets[at] > 0 else 0
                _sign_context(sign_features, signed, lows, bands, low_width, threshold, row, y, x, at)
                if mode == COLLECT:
                    _collect_sign(examples[1], coder, sign_features, orient, sign)
                else:
                    sign_logit = _sign_logit(sign_features, sign_b1, sign_w1, sign_w2, orient, sums)
                    sign = _transfer(mode, sign, sign_logit, probabilities, costs, coder, data, best)
                    if sign < 0:
                        planes[at] = -plane
                        return -1
                lower[at], widths[at], signs[at] = threshold, threshold, 2 * sign - 1
            if lower[at] > 0:
                sizes[at] = min((lower[at] + (widths[at] >> 1)) * 8 // threshold, MAX_EIGHTHS)
                signed[at] = sizes[at] * signs[at]
                after = _reconstruct(_int64(lower[at]), _int64(widths[at]), _int64(logits[at]), centres)
                original, own_scale = _int64(originals[at] * signs[at]), _int64(scale[at])
                error_after, error_before = original - after * 256 // own_scale, original - before * 256 // own_scale
                curve[0] += error_after**2 - error_before**2
            else:
                insignificant[at] = 1
            if mode == WRITE:
                curve[min(1 + (coder[CODER_COST] >> 11), curve.shape[0] - 1)] = curve[0]
    return 0
