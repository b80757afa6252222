"""The coding loop: contexts, networks, range coder. The same code encodes, decodes and collects training examples.

All arithmetic is on int32 and int64. docs/explanation/codecs.md describes the format. This is one long module because
numba recompiles cached machine code only when its own module changes (see `sonarpost.codec.jit`).
"""

from __future__ import annotations

from typing import Final

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
from sonarpost.codec.jit import jit

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
I16 = npt.NDArray[np.int16]
U8 = npt.NDArray[np.uint8]

WRITE, READ, COLLECT = 0, 1, 2
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

_NEIGHBOURS: Final = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))

# Words of the coder state.
CODER_LOW, CODER_RANGE, CODER_LENGTH, CODER_CODE, CODER_UNKNOWN, CODER_POSITION, CODER_STOP, CODER_EVENTS = range(8)
CODER_BEST_EVENTS, CODER_BEST_LENGTH, CODER_COST, CODER_ROWS, CODER_SIGN_ROWS, CODER_LIMIT, CODER_PREFIX = range(8, 15)
CODER_WORDS: Final = 15
_TOP: Final = 1 << 32
_BOTTOM: Final = 1 << 24


@jit
def start_reading(coder: I64, data: U8) -> None:
    """Load the first four bytes. Missing bytes are unknown."""
    coder[CODER_RANGE] = _TOP - 1
    for _ in range(4):
        _next_byte(coder, data)
    # Only a damaged stream has a code that is not below the range.
    coder[CODER_CODE] = min(coder[CODER_CODE], coder[CODER_RANGE] - 1)


@jit
def _next_byte(coder: I64, data: U8) -> None:
    position = coder[CODER_POSITION]
    if position < data.shape[0]:
        coder[CODER_CODE] = (coder[CODER_CODE] << 8) | data[position]
        coder[CODER_UNKNOWN] <<= 8
    else:
        coder[CODER_CODE] <<= 8
        coder[CODER_UNKNOWN] = (coder[CODER_UNKNOWN] << 8) | 255
    coder[CODER_POSITION] = position + 1


@jit
def _read_bit(coder: I64, data: U8, probability: int) -> int:
    """Read a bit with probability `probability` / 65536 of 1; -1 if the available bytes do not determine it."""
    bound = (coder[CODER_RANGE] >> 16) * probability
    code = coder[CODER_CODE]
    if code >= bound:
        bit = 0
        coder[CODER_CODE] = code - bound
        coder[CODER_RANGE] -= bound
    elif code + coder[CODER_UNKNOWN] < bound:
        bit = 1
        coder[CODER_RANGE] = bound
    else:
        coder[CODER_STOP] = 1
        return -1
    while coder[CODER_RANGE] < _BOTTOM:
        _next_byte(coder, data)
        coder[CODER_RANGE] <<= 8
    return bit


@jit
def _bit_with_prefix(coder: I64, data: U8, best: U8, bit: int, bound: int) -> int:
    """Return `bit`, or its opposite if only that gives a stream with the first CODER_PREFIX bytes of `best`.

    The final code value lies in [low, low + range). It must also lie in [first, first + size).
    """
    length, prefix = coder[CODER_LENGTH], coder[CODER_PREFIX]
    first, size = np.int64(0), np.int64(_TOP)
    for i in range(prefix, length):
        if data[i] != 255:  # no carry passes this byte
            return bit
    for i in range(min(length, prefix)):
        if data[i] != best[i]:
            first = np.int64(_TOP)  # only a carry makes them equal
    for i in range(min(prefix - length, 4)):
        size >>= 8
        first += np.int64(best[length + i]) * size
    low, split, end = coder[CODER_LOW], coder[CODER_LOW] + bound, coder[CODER_LOW] + coder[CODER_RANGE]
    if bit == 1 and split <= first:
        return 0
    if bit == 0 and split >= first + size and low < first + size and end > first:
        return 1
    return bit


@jit
def _write_bit(coder: I64, data: U8, best: U8, bit: int, probability: int) -> int:
    """Write a bit and return the bit written (see `_bit_with_prefix`).

    Stops when a stream of CODER_LIMIT bytes cannot distinguish it from its opposite.
    """
    bound = (coder[CODER_RANGE] >> 16) * probability
    if coder[CODER_PREFIX] > 0:
        bit = _bit_with_prefix(coder, data, best, bit, bound)
    if bit:
        coder[CODER_RANGE] = bound
    else:
        coder[CODER_LOW] += bound
        coder[CODER_RANGE] -= bound
    while coder[CODER_RANGE] < _BOTTOM:
        length = coder[CODER_LENGTH]
        if length >= coder[CODER_LIMIT]:
            coder[CODER_STOP] = 1
            return bit
        if coder[CODER_LOW] >> 32:
            _carry(data, length)
        data[length] = (coder[CODER_LOW] >> 24) & 255
        coder[CODER_LENGTH] = length + 1
        coder[CODER_LOW] = (coder[CODER_LOW] & 0xFFFFFF) << 8
        coder[CODER_RANGE] <<= 8
    coder[CODER_EVENTS] += 1
    _save_if_complete(coder, data, best)
    return bit


@jit
def _carry(data: U8, length: int) -> None:
    position = length - 1
    while data[position] == 255:
        data[position] = 0
        position -= 1
    data[position] += 1


@jit
def _save_if_complete(coder: I64, data: U8, best: U8) -> None:
    """Store a stream of CODER_LIMIT bytes that determines all bits so far in `best`, if there is one."""
    length = coder[CODER_LENGTH]
    left = coder[CODER_LIMIT] - length
    if left > 4:
        return
    cell = 1 << (32 - 8 * left)
    value = (coder[CODER_LOW] + cell - 1) // cell * cell
    if value + cell > coder[CODER_LOW] + coder[CODER_RANGE]:
        return
    best[:length] = data[:length]
    if value >> 32:
        _carry(best, length)
    for i in range(left):
        best[length + i] = (value >> (24 - 8 * i)) & 255
    coder[CODER_BEST_EVENTS] = coder[CODER_EVENTS]
    coder[CODER_BEST_LENGTH] = length + left


@jit
def finish_writing(coder: I64, data: U8, best: U8) -> None:
    """Store the shortest stream that determines all bits in `best`, unless the budget is used up."""
    if coder[CODER_STOP]:
        return
    limit = coder[CODER_LIMIT]
    coder[CODER_BEST_EVENTS] = -1
    for left in range(5):
        coder[CODER_LIMIT] = min(coder[CODER_LENGTH] + left, limit)
        if coder[CODER_BEST_EVENTS] < coder[CODER_EVENTS]:
            _save_if_complete(coder, data, best)


@jit
def code_bit(coder: I64, data: U8, best: U8, bit: int, probability: int, mode: int) -> int:
    """Write or read one bit of known probability; return it, or -1 at the end."""
    if mode == READ:
        return _read_bit(coder, data, probability)
    bit = _write_bit(coder, data, best, bit, probability)
    return -1 if coder[CODER_STOP] else bit


@jit
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
def _cell_index(bands: I32, row: int, y: int, x: int) -> int:
    """Return the flat index of a cell, clipped to the band; -1 for an empty band."""
    height, width = bands[row, HEIGHT], bands[row, WIDTH]
    if height == 0 or width == 0:
        return -1
    return int(bands[row, OFFSET] + min(y, height - 1) * bands[row, STRIDE] + min(x, width - 1))


@jit
def _has_significant_neighbour(sizes: I32, bands: I32, row: int, y: int, x: int, at: int) -> bool:
    """Return whether a neighbour, the parent or a sibling is significant, or the band has no parent."""
    if bands[row, PARENT] < 0:
        return True
    if _sum_around(sizes, at, bands[row, STRIDE]) > 0:
        return True
    parent = _cell_index(bands, bands[row, PARENT], y >> 1, x >> 1)
    if parent >= 0 and sizes[parent] > 0:
        return True
    for column in (SIBLING_1, SIBLING_2):
        sibling = bands[row, column]
        if sibling >= 0 and sizes[bands[sibling, OFFSET] + y * bands[sibling, STRIDE] + x] > 0:
            return True
    return False


@jit
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
    stride = bands[row, STRIDE]
    f[0], f[1] = sizes[at - 1], sizes[at - stride]
    f[2], f[3] = sizes[at - stride - 1], sizes[at - stride + 1]
    f[4], f[5] = sizes[at + 1], sizes[at + stride]
    f[6], f[7] = sizes[at + stride - 1], sizes[at + stride + 1]
    f[8], f[9] = sizes[at - 2], sizes[at - 2 * stride]
    f[10], f[11] = sizes[at + 2], sizes[at + 2 * stride]
    f[12] = sizes[at]
    window = 0
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
    parent = bands[row, PARENT]
    if parent >= 0:
        cell = _cell_index(bands, parent, y >> 1, x >> 1)
        if cell >= 0:
            width = bands[parent, STRIDE]
            f[14], f[15] = sizes[cell], _sum_around(sizes, cell, width) >> 1
            f[43] += insignificant[cell] * 16
            f[16], f[17] = sizes[cell - 1] + sizes[cell + 1], sizes[cell - width] + sizes[cell + width]
            # The parent's neighbour on the side of this coefficient.
            f[18] = sizes[cell + (1 if x & 1 else -1)]
            f[19] = sizes[cell + (width if y & 1 else -width)]
        grand = bands[parent, PARENT]
        if grand >= 0:
            cell = _cell_index(bands, grand, y >> 2, x >> 2)
            if cell >= 0:
                f[20], f[21] = sizes[cell], _sum_around(sizes, cell, bands[grand, STRIDE]) >> 1
    for k in range(2):
        sibling = bands[row, SIBLING_1 + k]
        if sibling >= 0:
            cell = bands[sibling, OFFSET] + y * bands[sibling, STRIDE] + x
            f[22 + 2 * k], f[23 + 2 * k] = sizes[cell], _sum_around(sizes, cell, bands[sibling, STRIDE]) >> 1
            f[43] += insignificant[cell] * 16
        following = bands[row, NEXT_1 + k]
        if following >= 0:
            cell = _cell_index(bands, following, y, x)
            if cell >= 0:
                f[34 + 2 * k], f[35 + 2 * k] = sizes[cell], _sum_around(sizes, cell, bands[following, STRIDE]) >> 1
        cousin = bands[row, COUSIN_1 + k]
        if cousin >= 0:
            cell = _cell_index(bands, cousin, y >> 1, x >> 1)
            if cell >= 0:
                f[38 + k] = (sizes[cell] + _sum_around(sizes, cell, bands[cousin, STRIDE])) >> 1
    child = bands[row, CHILD]
    if child >= 0:
        cell = bands[child, OFFSET] + 2 * y * bands[child, STRIDE] + 2 * x
        below = cell + bands[child, STRIDE]
        f[26] = (sizes[cell] + sizes[cell + 1] + sizes[below] + sizes[below + 1]) >> 1
    low_stride = low_width + 2
    here = bands[row, LOW] + (y + 1) * low_stride + x + 1
    level = bands[row, LEVEL]
    grey = max(lows[here] >> level, 256)  # 1/64 grey, at least 4 grey
    f[27] = min(log2_eighths(grey), 120) - 80
    across = abs(lows[here + 1] - lows[here - 1])
    along = abs(lows[here + low_stride] - lows[here - low_stride])
    f[28], f[29] = _quotient(across * 4, threshold, inverse), _quotient(along * 4, threshold, inverse)
    curvature = abs(
        4 * lows[here] - lows[here + 1] - lows[here - 1] - lows[here + low_stride] - lows[here - low_stride]
    )
    f[30] = _quotient(curvature * 2, threshold, inverse)
    neighbours = lows[here + 1] + lows[here - 1] + lows[here + low_stride] + lows[here - low_stride]
    f[31] = min(log2_eighths(max(neighbours >> (level + 2), 256)), 120) - 80


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
        h1[j] = min(max(h1[j] >> 6, 0), 4095)
    for i in range(0, HIDDEN_1, 8):
        p, q, r, s = h1[i], h1[i + 1], h1[i + 2], h1[i + 3]
        t, u, v, w = h1[i + 4], h1[i + 5], h1[i + 6], h1[i + 7]
        for j in range(HIDDEN_2):
            h2[j] += (
                p * w2[i, j] + q * w2[i + 1, j] + r * w2[i + 2, j] + s * w2[i + 3, j]
                + t * w2[i + 4, j] + u * w2[i + 5, j] + v * w2[i + 6, j] + w * w2[i + 7, j]
            )  # fmt: skip
    total = np.int64(last_layer[HIDDEN_2]) * 256
    for i in range(h2.shape[0]):
        h2[i] = min(max(h2[i] >> 12, 0), 4095)
        total += np.int64(h2[i]) * last_layer[i]
    return _clip(int(total >> 28), LOGIT_LIMIT)


@jit
def _adapt(last_layer: I64, h2: I32, bit: int, probability: int) -> None:
    """Update the weights of the last layer by gradient descent on the code length of the bit, at a rate of 1/256.

    Units: error 1/2^16, hidden units 1/2^8, weights 1/2^28.
    """
    error = np.int64((bit << 16) - probability)
    for i in range(h2.shape[0]):
        last_layer[i] = min(max(last_layer[i] + ((error * h2[i]) >> 4), -_LIVE_LIMIT), _LIVE_LIMIT)
    last_layer[HIDDEN_2] = min(max(last_layer[HIDDEN_2] + (error << 4), -_LIVE_LIMIT), _LIVE_LIMIT)


@jit
def band_base(f: I32, w1: I32, b1: I32, base: I32) -> None:
    """Compute the contribution of the band features to the first layer."""
    for j in range(base.shape[0]):
        base[j] = b1[j]
    for i in range(BAND_FEATURES, f.shape[0]):
        for j in range(base.shape[0]):
            base[j] += f[i] * w1[i, j]


@jit
def _cross(f: I32, first: int, signed: I32, at: int, stride: int) -> None:
    """Store a signed coefficient and its neighbours left, right, above, below."""
    f[first] = signed[at]
    f[first + 1], f[first + 2] = signed[at - 1], signed[at + 1]
    f[first + 3], f[first + 4] = signed[at - stride], signed[at + stride]


@jit
def _corners(f: I32, first: int, signed: I32, at: int, stride: int) -> None:
    """Store the four diagonal neighbours of a signed coefficient."""
    f[first], f[first + 1] = signed[at - stride - 1], signed[at - stride + 1]
    f[first + 2], f[first + 3] = signed[at + stride - 1], signed[at + stride + 1]


@jit
def _sign_context(  # noqa: C901, PLR0912  61 features, one after the other
    f: I32, signed: I32, lows: I32, bands: I32, low_width: int, threshold: int, row: int, y: int, x: int, at: int
) -> None:
    """Compute the sign features of a coefficient: signed neighbours (odd features) and its position (even features)."""
    stride, level = bands[row, STRIDE], bands[row, LEVEL]
    for i in range(SIGN_FEATURES):
        f[i] = 0
    f[0], f[1] = signed[at - 1], signed[at + 1]
    f[2], f[3] = signed[at - stride], signed[at + stride]
    _corners(f, 11, signed, at, stride)
    f[4], f[5] = f[11] - f[12], f[14] - f[13]
    f[15], f[16], f[17], f[18] = signed[at - 2], signed[at + 2], signed[at - 2 * stride], signed[at + 2 * stride]
    f[SIGN_ODD], f[SIGN_ODD + 1] = (x & 1) * 16, (y & 1) * 16
    f[SIGN_ODD + 2], f[SIGN_ODD + 3] = min(y, 8) * 2, min(x, 8) * 2
    f[SIGN_ODD + 3 + min(level, 5)] = 16
    if bands[row, ORIENT] != LL:
        parent = bands[row, PARENT]
        if parent >= 0:
            cell = _cell_index(bands, parent, y >> 1, x >> 1)
            if cell >= 0:
                width = bands[parent, STRIDE]
                f[6] = signed[cell]
                f[19], f[20] = signed[cell - 1], signed[cell + 1]
                f[21], f[22] = signed[cell - width], signed[cell + width]
                _corners(f, 23, signed, cell, width)
        for k in range(2):
            sibling, following, cousin = bands[row, SIBLING_1 + k], bands[row, NEXT_1 + k], bands[row, COUSIN_1 + k]
            if sibling >= 0:
                width = bands[sibling, STRIDE]
                _cross(f, 27 + 5 * k, signed, bands[sibling, OFFSET] + y * width + x, width)
            if following >= 0:
                cell = _cell_index(bands, following, y, x)
                if cell >= 0:
                    _cross(f, 27 + 5 * k, signed, cell, bands[following, STRIDE])
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
        for i in range(8):
            beside = here + _NEIGHBOURS[i][0] * low_stride + _NEIGHBOURS[i][1]
            f[43 + i] = _clip((lows[beside] - lows[here]) * 4 // threshold, MAX_EIGHTHS)
        f[7] = _clip((lows[here + 1] - lows[here - 1]) * 4 // threshold, MAX_EIGHTHS)
        f[8] = _clip((lows[here + low_stride] - lows[here - low_stride]) * 4 // threshold, MAX_EIGHTHS)
        f[9] = _clip((lows[here + 1] + lows[here - 1] - 2 * lows[here]) * 4 // threshold, MAX_EIGHTHS)
        f[10] = _clip(
            (lows[here + low_stride] + lows[here - low_stride] - 2 * lows[here]) * 4 // threshold, MAX_EIGHTHS
        )
    nonzero = 0
    for i in range(6):
        if f[i] != 0:
            nonzero += 4
    f[SIGN_ODD + 9] = nonzero


@jit
def _active(total: int) -> int:
    """Return the activation of a hidden unit of the sign network: 1/256, never negative."""
    return min(max(total >> 6, 0), 4095)


@jit
def _sign_logit(f: I32, base: I32, w1: I32, w2: I32, orient: int) -> int:
    """Return the logit of a positive sign, an odd function of the odd features. One network for each orientation."""
    odd, even = np.zeros(SIGN_HIDDEN, np.int32), base.copy()
    for i in range(SIGN_FEATURES):
        if f[i] != 0:
            target = odd if i < SIGN_ODD else even
            for j in range(SIGN_HIDDEN):
                target[j] += f[i] * w1[orient, i, j]
    total = np.int64(0)
    for j in range(SIGN_HIDDEN):
        total += np.int64(_active(even[j] + odd[j]) - _active(even[j] - odd[j])) * w2[orient, j]
    return _clip(int(total >> 12), LOGIT_LIMIT)


@jit
def _reconstruct(lower: int, width: int, logit: int, centres: I32) -> int:
    """Return the mean magnitude of coefficients in this interval with this logit. Unlikely ones are smaller."""
    size = min(lower // width, 4) - 1
    column = min(max((logit + _CENTRE_SHIFT) >> 7, 0), CENTRE_COLUMNS - 1)
    return int(lower + (width * centres[size, column] >> 8))


@jit
def reconstruct(lower: I32, widths: I32, signs: I32, logits: I32, centres: I32, out: I32) -> None:
    """Write the reconstruction value of every coefficient to `out`."""
    for at in range(lower.shape[0]):
        out[at] = signs[at] * _reconstruct(lower[at], widths[at], logits[at], centres) if lower[at] > 0 else 0


@jit
def update_sizes(lower: I32, widths: I32, signs: I32, sizes: I32, signed: I32, threshold: int) -> None:
    """Express the reconstruction of every coefficient in eighths of the threshold."""
    for at in range(lower.shape[0]):
        if lower[at] > 0:
            sizes[at] = min((lower[at] + (widths[at] >> 1)) * 8 // threshold, MAX_EIGHTHS)
            signed[at] = sizes[at] * signs[at]


@jit
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


@jit
def _collect_sign(rows: I16, coder: I64, f: I32, orient: int, sign: int) -> None:
    n = coder[CODER_SIGN_ROWS]
    if n >= rows.shape[0]:
        return
    for i in range(SIGN_FEATURES):
        rows[n, i] = f[i]
    rows[n, SIGN_FEATURES], rows[n, SIGN_FEATURES + 1] = orient, sign
    coder[CODER_SIGN_ROWS] = n + 1


@jit
def _transfer(mode: int, bit: int, logit: int, probabilities: I32, costs: I32, coder: I64, data: U8, best: U8) -> int:
    """Write `bit`, or read one; return it, or -1 at the end."""
    probability = probabilities[logit + LOGIT_LIMIT]
    if mode == READ:
        return _read_bit(coder, data, probability)
    bit = _write_bit(coder, data, best, bit, probability)
    coder[CODER_COST] += costs[(logit if bit else -logit) + LOGIT_LIMIT]
    return -1 if coder[CODER_STOP] else bit


@jit
def _is_worthwhile(magnitude: int, threshold: int, reconstruction: int, cost: int, price: int) -> bool:
    """Return whether a significant coefficient removes enough squared error for its bits and its sign bit."""
    size, decoded = magnitude * 16 // threshold, reconstruction * 16 // threshold
    return bool(decoded * (2 * size - decoded) >= (price * (cost + 256)) >> 8)


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
    bases: I32,
    state: tuple[I32, I32, I32, I32, I32, I32, I32, I32, I32],
    nets: tuple[I32, I32, I32, I64],
    sign_nets: tuple[I32, I32, I32],
    tables: tuple[I32, I32, I32],
    stream: tuple[I64, U8, U8, I64, I32],
    examples: tuple[I16, I16],
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
        bases: Shape (2, HIDDEN_1): contribution of the band features to the first layer; first axis as in `nets`.
        state: Arrays of `CoefficientState`: lower bound of the magnitude, 0 if not significant; width of the interval;
            sign; magnitude in eighths of the threshold, at most MAX_EIGHTHS; the same with sign; plane that decided
            last, or minus the plane that evaluated last; logit of the last decision or evaluation; 1 if this plane
            decided that the coefficient stays insignificant; scale, 1/256.
        nets: Weights w1, w2, b2, and the adapted weights w3 and b3, 1/2^28 (see `_adapt`). First axis: 0 significance,
            1 refinement.
        sign_nets: Weights w1, b1, w2; first axis: orientation of the band.
        tables: Probability of 1 in 1/65536 and cost of a 1 in 1/256 bit, by logit + LOGIT_LIMIT; reconstruction points
            in 1/256 of the interval, see `_reconstruct`.
        stream: State of the range coder; bytes; the best complete stream so far (WRITE); squared error by number of
            bytes; the original coefficients, flat, to which the error refers.
        examples: Training examples of decisions and of signs (COLLECT).
    """
    lower, widths, signs, sizes, signed, planes, logits, insignificant, scale = state
    w1, w2, b2, last_layer = nets
    sign_w1, sign_b1, sign_w2 = sign_nets
    probabilities, costs, centres = tables
    coder, data, best, curve, originals = stream
    stride, orient, level = bands[row, STRIDE], bands[row, ORIENT], bands[row, LEVEL]
    h1, h2 = np.zeros(HIDDEN_1, np.int32), np.zeros(HIDDEN_2, np.int32)
    sign_features = np.zeros(SIGN_FEATURES, np.int32)
    inverse = int((1 << _INVERSE_BITS) // np.int64(threshold) + 1)
    interval = 12 if level == 1 else 4 if level == 2 else 1
    net = 1 if kind == REFINE else 0
    for y in range(bands[row, HEIGHT]):
        for x in range(bands[row, WIDTH]):
            at = bands[row, OFFSET] + y * stride + x
            if planes[at] == plane or (lower[at] > 0) != (kind == REFINE):
                continue
            is_near = kind == REFINE or _has_significant_neighbour(sizes, bands, row, y, x, at)
            if kind == NEAR and not is_near:
                continue
            if kind == ALL and logits[at] < min_logit - (_SKIP_NEAR if planes[at] == -plane else _SKIP_FAR):
                continue
            magnitude = abs(targets[at])
            bit = 1 if magnitude >= lower[at] + threshold else 0
            _context(f, sizes, insignificant, lows, bands, low_width, threshold, inverse, row, y, x, at)
            logit = _logit(f, bases[net], w1[net], w2[net], b2[net], last_layer[net], h1, h2)
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
                _adapt(last_layer[net], h2, bit, probabilities[logit + LOGIT_LIMIT])
            before = _reconstruct(lower[at], widths[at], logits[at], centres) if lower[at] > 0 else 0
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
                    sign_logit = _sign_logit(sign_features, sign_b1[orient], sign_w1, sign_w2, orient)
                    sign = _transfer(mode, sign, sign_logit, probabilities, costs, coder, data, best)
                    if sign < 0:
                        planes[at] = -plane
                        return -1
                lower[at], widths[at], signs[at] = threshold, threshold, 2 * sign - 1
            if lower[at] > 0:
                sizes[at] = min((lower[at] + (widths[at] >> 1)) * 8 // threshold, MAX_EIGHTHS)
                signed[at] = sizes[at] * signs[at]
                after = _reconstruct(lower[at], widths[at], logits[at], centres)
                original, own_scale = np.int64(originals[at] * signs[at]), np.int64(scale[at])
                error_after, error_before = original - after * 256 // own_scale, original - before * 256 // own_scale
                curve[0] += error_after**2 - error_before**2
            else:
                insignificant[at] = 1
            if mode == WRITE:
                curve[min(1 + (coder[CODER_COST] >> 11), curve.shape[0] - 1)] = curve[0]
    return 0
