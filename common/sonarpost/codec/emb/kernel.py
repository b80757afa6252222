"""The coding loop: contexts, network, range coder; the same code writes, reads and lists training examples.

Everything here is integer arithmetic on int32 and int64. See docs/explanation/codecs.md for the format in words. It is
one long module because machine code that is kept on disk is compiled anew only when its own module changes (see
`_jit`).
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb._jit import jit
from sonarpost.codec.emb.layout import (
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

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
I16 = npt.NDArray[np.int16]
U8 = npt.NDArray[np.uint8]

WRITE, READ, LIST = 0, 1, 2
NEAR, REFINE, ALL = 0, 1, 2
"""Kinds of pass: coefficients with something significant around them; those that are significant; all that are not."""

FEATURES: Final = 54
BAND_FEATURES: Final = 44
"""Features from this one on are the same for a whole band."""
SIGN_ODD: Final = 51
"""Features of a sign that turn with the picture's sign; the others do not."""
SIGN_FEATURES: Final = 61
HIDDEN_1: Final = 32
HIDDEN_2: Final = 16
SIGN_HIDDEN: Final = 32
CAP: Final = 48
"""Largest magnitude that a context shows: 6 thresholds, in eighths."""
LOGIT_LIMIT: Final = 3071
"""Logits are 1/256; the table of probabilities runs from -LOGIT_LIMIT to LOGIT_LIMIT."""
CENTRE_COLUMNS: Final = 24
"""Columns of the table of centres: logits from -9 up, in halves."""
_CENTRE_SHIFT: Final = 2304
_LIVE_LIMIT: Final = 1 << 34
_INVERSE_BITS: Final = 54
# A coefficient whose logit was so far below a pass's least when last looked at is not looked at again in that pass:
# one that this plane has looked at already, and one that it has not (its chance grows as the threshold is halved).
_SKIP_NEAR: Final = 384
_SKIP_FAR: Final = 896

_AROUND: Final = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))

# The coder's state.
CODER_LOW, CODER_RANGE, CODER_LENGTH, CODER_CODE, CODER_UNSURE, CODER_AT, CODER_STOP, CODER_EVENTS = range(8)
CODER_GOOD_EVENTS, CODER_GOOD_LENGTH, CODER_COST, CODER_ROWS, CODER_SIGN_ROWS, CODER_LIMIT, CODER_HELD = range(8, 15)
CODER_WORDS: Final = 15
_TOP: Final = 1 << 32
_BOTTOM: Final = 1 << 24


@jit
def start_reading(coder: I64, data: U8) -> None:
    """Load the first four bytes; bytes that are not there are unknown."""
    coder[CODER_RANGE] = _TOP - 1
    for _ in range(4):
        _next_byte(coder, data)
    # No encoder writes a code that is not below the range; a damaged stream may.
    coder[CODER_CODE] = min(coder[CODER_CODE], coder[CODER_RANGE] - 1)


@jit
def _next_byte(coder: I64, data: U8) -> None:
    at = coder[CODER_AT]
    if at < data.shape[0]:
        coder[CODER_CODE] = (coder[CODER_CODE] << 8) | data[at]
        coder[CODER_UNSURE] <<= 8
    else:
        coder[CODER_CODE] <<= 8
        coder[CODER_UNSURE] = (coder[CODER_UNSURE] << 8) | 255
    coder[CODER_AT] = at + 1


@jit
def _get(coder: I64, data: U8, chance: int) -> int:
    """Read a decision whose chance of being 1 is `chance` / 65536; -1 where the bytes that are there do not tell."""
    bound = (coder[CODER_RANGE] >> 16) * chance
    code = coder[CODER_CODE]
    if code >= bound:
        bit = 0
        coder[CODER_CODE] = code - bound
        coder[CODER_RANGE] -= bound
    elif code + coder[CODER_UNSURE] < bound:
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
def _held_bit(coder: I64, data: U8, good: U8, bit: int, bound: int) -> int:
    """Return `bit`, or its opposite where only that leads to bytes that begin with the CODER_HELD first ones of `good`.

    The number that the bytes write lies in [low, low + range); it must come to lie in [first, first + size).
    """
    length, held = coder[CODER_LENGTH], coder[CODER_HELD]
    first, size = np.int64(0), np.int64(_TOP)
    for i in range(held, length):
        if data[i] != 255:  # no carry goes past it
            return bit
    for i in range(min(length, held)):
        if data[i] != good[i]:
            first = np.int64(_TOP)  # only a carry makes them the same
    for i in range(min(held - length, 4)):
        size >>= 8
        first += np.int64(good[length + i]) * size
    low, split, end = coder[CODER_LOW], coder[CODER_LOW] + bound, coder[CODER_LOW] + coder[CODER_RANGE]
    if bit == 1 and split <= first:
        return 0
    if bit == 0 and split >= first + size and low < first + size and end > first:
        return 1
    return bit


@jit
def _put(coder: I64, data: U8, good: U8, bit: int, chance: int) -> int:
    """Write a decision, and return it as it was written (see `_held_bit`).

    Stops where no stream of CODER_LIMIT bytes could tell it from its opposite.
    """
    bound = (coder[CODER_RANGE] >> 16) * chance
    if coder[CODER_HELD] > 0:
        bit = _held_bit(coder, data, good, bit, bound)
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
    _keep_if_whole(coder, data, good)
    return bit


@jit
def _carry(data: U8, length: int) -> None:
    at = length - 1
    while data[at] == 255:
        data[at] = 0
        at -= 1
    data[at] += 1


@jit
def _keep_if_whole(coder: I64, data: U8, good: U8) -> None:
    """Keep the bytes of CODER_LIMIT length that tell everything so far, if there are such."""
    length = coder[CODER_LENGTH]
    left = coder[CODER_LIMIT] - length
    if left > 4:
        return
    cell = 1 << (32 - 8 * left)
    value = (coder[CODER_LOW] + cell - 1) // cell * cell
    if value + cell > coder[CODER_LOW] + coder[CODER_RANGE]:
        return
    good[:length] = data[:length]
    if value >> 32:
        _carry(good, length)
    for i in range(left):
        good[length + i] = (value >> (24 - 8 * i)) & 255
    coder[CODER_GOOD_EVENTS] = coder[CODER_EVENTS]
    coder[CODER_GOOD_LENGTH] = length + left


@jit
def finish_writing(coder: I64, data: U8, good: U8) -> None:
    """Keep the shortest bytes that tell everything, where the budget was not used up."""
    if coder[CODER_STOP]:
        return
    limit = coder[CODER_LIMIT]
    coder[CODER_GOOD_EVENTS] = -1
    for left in range(5):
        coder[CODER_LIMIT] = min(coder[CODER_LENGTH] + left, limit)
        if coder[CODER_GOOD_EVENTS] < coder[CODER_EVENTS]:
            _keep_if_whole(coder, data, good)


@jit
def code_plain(coder: I64, data: U8, good: U8, bit: int, chance: int, mode: int) -> int:
    """Write or read one decision of known chance; returns it, or -1 at the end."""
    if mode == READ:
        return _get(coder, data, chance)
    bit = _put(coder, data, good, bit, chance)
    return -1 if coder[CODER_STOP] else bit


@jit
def _clip(value: int, limit: int) -> int:
    return min(max(value, -limit), limit)


@jit
def _log2_eighths(value: int) -> int:
    """8 log2(value) for value >= 1, linear between powers of two."""
    power, rest = 0, value
    for step in (32, 16, 8, 4, 2, 1):
        if rest >> step:
            power += step
            rest >>= step
    return int(8 * power + ((value << 3) >> power) - 8)


@jit
def _box(seen: I32, at: int, stride: int) -> int:
    """Sum of the eight neighbours."""
    up, down = at - stride, at + stride
    return int(
        seen[up - 1]
        + seen[up]
        + seen[up + 1]
        + seen[at - 1]
        + seen[at + 1]
        + seen[down - 1]
        + seen[down]
        + seen[down + 1]
    )


@jit
def _relative(bands: I32, row: int, y: int, x: int) -> int:
    """Flat index of a cell, held inside the band; -1 where the band is empty."""
    height, width = bands[row, HEIGHT], bands[row, WIDTH]
    if height == 0 or width == 0:
        return -1
    return int(bands[row, OFFSET] + min(y, height - 1) * bands[row, STRIDE] + min(x, width - 1))


@jit
def _is_near(seen: I32, bands: I32, row: int, y: int, x: int, at: int) -> bool:
    """Whether anything around, above or beside a coefficient is significant, or the band is a coarse one."""
    if bands[row, PARENT] < 0:
        return True
    if _box(seen, at, bands[row, STRIDE]) > 0:
        return True
    parent = _relative(bands, bands[row, PARENT], y >> 1, x >> 1)
    if parent >= 0 and seen[parent] > 0:
        return True
    for column in (SIBLING_1, SIBLING_2):
        sibling = bands[row, column]
        if sibling >= 0 and seen[bands[sibling, OFFSET] + y * bands[sibling, STRIDE] + x] > 0:
            return True
    return False


@jit
def _thresholds(size: int, threshold: int, inverse: int) -> int:
    """min(size // threshold, CAP) without a division: `inverse` is 2^54 // threshold + 1.

    Exact, since what is multiplied is less than 48 thresholds, and 48 times the largest threshold squared is less than
    2^54.
    """
    return int((size * inverse) >> _INVERSE_BITS) if size < CAP * threshold else CAP


@jit
def _context(  # noqa: C901, PLR0912, PLR0915  a list of 44 features, one after the other
    f: I32,
    seen: I32,
    still: I32,
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
    """Fill in the features of one coefficient; those of its band stand already at the end."""
    stride = bands[row, STRIDE]
    f[0], f[1] = seen[at - 1], seen[at - stride]
    f[2], f[3] = seen[at - stride - 1], seen[at - stride + 1]
    f[4], f[5] = seen[at + 1], seen[at + stride]
    f[6], f[7] = seen[at + stride - 1], seen[at + stride + 1]
    f[8], f[9] = seen[at - 2], seen[at - 2 * stride]
    f[10], f[11] = seen[at + 2], seen[at + 2 * stride]
    f[12] = seen[at]
    ring = 0
    for dy in range(-2, 3):
        line = at + dy * stride
        ring += seen[line - 2] + seen[line - 1] + seen[line] + seen[line + 1] + seen[line + 2]
    f[13] = (ring - seen[at]) >> 2
    for i in range(14, BAND_FEATURES):
        f[i] = 0
    f[40] = min(y, bands[row, HEIGHT] - 1 - y, 6) * 4
    f[41] = min(x, bands[row, WIDTH] - 1 - x, 6) * 4
    f[42] = _box(still, at, stride) * 6
    if bands[row, ORIENT] == LL:
        f[31], f[32] = min(y, 8) * 4, min(x, 8) * 4
        f[33] = 32 if y == 0 and x == 0 else 0
        return
    parent = bands[row, PARENT]
    if parent >= 0:
        cell = _relative(bands, parent, y >> 1, x >> 1)
        if cell >= 0:
            width = bands[parent, STRIDE]
            f[14], f[15] = seen[cell], _box(seen, cell, width) >> 1
            f[43] += still[cell] * 16
            f[16], f[17] = seen[cell - 1] + seen[cell + 1], seen[cell - width] + seen[cell + width]
            # The parent's neighbour on the side this coefficient lies on.
            f[18] = seen[cell + (1 if x & 1 else -1)]
            f[19] = seen[cell + (width if y & 1 else -width)]
        grand = bands[parent, PARENT]
        if grand >= 0:
            cell = _relative(bands, grand, y >> 2, x >> 2)
            if cell >= 0:
                f[20], f[21] = seen[cell], _box(seen, cell, bands[grand, STRIDE]) >> 1
    for k in range(2):
        sibling = bands[row, SIBLING_1 + k]
        if sibling >= 0:
            cell = bands[sibling, OFFSET] + y * bands[sibling, STRIDE] + x
            f[22 + 2 * k], f[23 + 2 * k] = seen[cell], _box(seen, cell, bands[sibling, STRIDE]) >> 1
            f[43] += still[cell] * 16
        following = bands[row, NEXT_1 + k]
        if following >= 0:
            cell = _relative(bands, following, y, x)
            if cell >= 0:
                f[34 + 2 * k], f[35 + 2 * k] = seen[cell], _box(seen, cell, bands[following, STRIDE]) >> 1
        cousin = bands[row, COUSIN_1 + k]
        if cousin >= 0:
            cell = _relative(bands, cousin, y >> 1, x >> 1)
            if cell >= 0:
                f[38 + k] = (seen[cell] + _box(seen, cell, bands[cousin, STRIDE])) >> 1
    child = bands[row, CHILD]
    if child >= 0:
        cell = bands[child, OFFSET] + 2 * y * bands[child, STRIDE] + 2 * x
        below = cell + bands[child, STRIDE]
        f[26] = (seen[cell] + seen[cell + 1] + seen[below] + seen[below + 1]) >> 1
    low_stride = low_width + 2
    here = bands[row, LOW] + (y + 1) * low_stride + x + 1
    level = bands[row, LEVEL]
    grey = max(lows[here] >> level, 256)  # 1/64 grey, at least 4
    f[27] = min(_log2_eighths(grey), 120) - 80
    across = abs(lows[here + 1] - lows[here - 1])
    along = abs(lows[here + low_stride] - lows[here - low_stride])
    f[28], f[29] = _thresholds(across * 4, threshold, inverse), _thresholds(along * 4, threshold, inverse)
    bend = abs(4 * lows[here] - lows[here + 1] - lows[here - 1] - lows[here + low_stride] - lows[here - low_stride])
    f[30] = _thresholds(bend * 2, threshold, inverse)
    around = lows[here + 1] + lows[here - 1] + lows[here + low_stride] + lows[here - low_stride]
    f[31] = min(_log2_eighths(max(around >> (level + 2), 256)), 120) - 80


@jit
def _logit(f: I32, base: I32, w1: I32, w2: I32, b2: I32, live: I64, h1: I32, h2: I32) -> int:
    """Run the network: features, two hidden layers, one output in 1/256. Leaves the last hidden layer in `h2`."""
    for j in range(HIDDEN_1):
        h1[j] = base[j]
    for i in range(0, BAND_FEATURES, 4):  # several rows at a time: fewer loads and stores
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
    total = np.int64(live[HIDDEN_2]) * 256
    for i in range(h2.shape[0]):
        h2[i] = min(max(h2[i] >> 12, 0), 4095)
        total += np.int64(h2[i]) * live[i]
    return _clip(int(total >> 28), LOGIT_LIMIT)


@jit
def _learn(live: I64, h2: I32, bit: int, chance: int) -> None:
    """Move the last layer's weights down the gradient of the decision's code length, at a rate of 1/256.

    In units: the error is 1/2^16, hidden units 1/2^8, weights 1/2^28.
    """
    error = np.int64((bit << 16) - chance)
    for i in range(h2.shape[0]):
        live[i] = min(max(live[i] + ((error * h2[i]) >> 4), -_LIVE_LIMIT), _LIVE_LIMIT)
    live[HIDDEN_2] = min(max(live[HIDDEN_2] + (error << 4), -_LIVE_LIMIT), _LIVE_LIMIT)


@jit
def band_base(f: I32, w1: I32, b1: I32, base: I32) -> None:
    """The part of the first layer that is the same for a whole band."""
    for j in range(base.shape[0]):
        base[j] = b1[j]
    for i in range(BAND_FEATURES, f.shape[0]):
        for j in range(base.shape[0]):
            base[j] += f[i] * w1[i, j]


@jit
def _cross(f: I32, first: int, signed: I32, at: int, stride: int) -> None:
    """A signed coefficient and its neighbours left, right, above, below."""
    f[first] = signed[at]
    f[first + 1], f[first + 2] = signed[at - 1], signed[at + 1]
    f[first + 3], f[first + 4] = signed[at - stride], signed[at + stride]


@jit
def _corners(f: I32, first: int, signed: I32, at: int, stride: int) -> None:
    """The four diagonal neighbours of a signed coefficient."""
    f[first], f[first + 1] = signed[at - stride - 1], signed[at - stride + 1]
    f[first + 2], f[first + 3] = signed[at + stride - 1], signed[at + stride + 1]


@jit
def _sign_context(  # noqa: C901, PLR0912  a list of 61 features, one after the other
    f: I32, signed: I32, lows: I32, bands: I32, low_width: int, threshold: int, row: int, y: int, x: int, at: int
) -> None:
    """Signed surroundings of a coefficient, which turn with the picture's sign; and where it is, which does not."""
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
            cell = _relative(bands, parent, y >> 1, x >> 1)
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
                cell = _relative(bands, following, y, x)
                if cell >= 0:
                    _cross(f, 27 + 5 * k, signed, cell, bands[following, STRIDE])
            if cousin >= 0:
                cell = _relative(bands, cousin, y >> 1, x >> 1)
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
            beside = here + _AROUND[i][0] * low_stride + _AROUND[i][1]
            f[43 + i] = _clip((lows[beside] - lows[here]) * 4 // threshold, CAP)
        f[7] = _clip((lows[here + 1] - lows[here - 1]) * 4 // threshold, CAP)
        f[8] = _clip((lows[here + low_stride] - lows[here - low_stride]) * 4 // threshold, CAP)
        f[9] = _clip((lows[here + 1] + lows[here - 1] - 2 * lows[here]) * 4 // threshold, CAP)
        f[10] = _clip((lows[here + low_stride] + lows[here - low_stride] - 2 * lows[here]) * 4 // threshold, CAP)
    known = 0
    for i in range(6):
        if f[i] != 0:
            known += 4
    f[SIGN_ODD + 9] = known


@jit
def _active(total: int) -> int:
    """The sign network's hidden unit: 1/256, never negative."""
    return min(max(total >> 6, 0), 4095)


@jit
def _sign_logit(f: I32, base: I32, w1: I32, w2: I32, orient: int) -> int:
    """An odd function of the odd features: with all signs turned the logit turns. A network a band orientation."""
    turn, even = np.zeros(SIGN_HIDDEN, np.int32), base.copy()
    for i in range(SIGN_FEATURES):
        if f[i] != 0:
            into = turn if i < SIGN_ODD else even
            for j in range(SIGN_HIDDEN):
                into[j] += f[i] * w1[orient, i, j]
    total = np.int64(0)
    for j in range(SIGN_HIDDEN):
        total += np.int64(_active(even[j] + turn[j]) - _active(even[j] - turn[j])) * w2[orient, j]
    return _clip(int(total >> 12), LOGIT_LIMIT)


@jit
def _guess(value: int, width: int, odds: int, centres: I32) -> int:
    """Mean magnitude of significant coefficients that were as likely: the unlikely lie low in their interval."""
    size = min(value // width, 4) - 1
    column = min(max((odds + _CENTRE_SHIFT) >> 7, 0), CENTRE_COLUMNS - 1)
    return int(value + (width * centres[size, column] >> 8))


@jit
def most_likely(values: I32, widths: I32, signs: I32, odds: I32, centres: I32, out: I32) -> None:
    """Write the mean value of every coefficient, as far as it is known."""
    for at in range(values.shape[0]):
        out[at] = signs[at] * _guess(values[at], widths[at], odds[at], centres) if values[at] > 0 else 0


@jit
def refresh(values: I32, widths: I32, signs: I32, seen: I32, signed: I32, threshold: int) -> None:
    """Express what is known of every coefficient in thresholds."""
    for at in range(values.shape[0]):
        if values[at] > 0:
            seen[at] = min((values[at] + (widths[at] >> 1)) * 8 // threshold, CAP)
            signed[at] = seen[at] * signs[at]


@jit
def _list_decision(rows: I16, coder: I64, f: I32, bit: int, net: int, share: int) -> None:
    """Note an example, one out of `share` by a chance that repeats."""
    coder[CODER_CODE] = (coder[CODER_CODE] * 1103515245 + 12345) & 0x7FFFFFFF
    n = coder[CODER_ROWS]
    if (coder[CODER_CODE] >> 12) % share or n >= rows.shape[0]:
        return
    for i in range(FEATURES):
        rows[n, i] = f[i]
    rows[n, FEATURES], rows[n, FEATURES + 1], rows[n, FEATURES + 2] = bit, net, share
    coder[CODER_ROWS] = n + 1


@jit
def _list_sign(rows: I16, coder: I64, f: I32, orient: int, sign: int) -> None:
    n = coder[CODER_SIGN_ROWS]
    if n >= rows.shape[0]:
        return
    for i in range(SIGN_FEATURES):
        rows[n, i] = f[i]
    rows[n, SIGN_FEATURES], rows[n, SIGN_FEATURES + 1] = orient, sign
    coder[CODER_SIGN_ROWS] = n + 1


@jit
def _transfer(mode: int, bit: int, logit: int, chances: I32, costs: I32, coder: I64, data: U8, good: U8) -> int:
    """Write `bit`, or read one; returns it, or -1 at the end."""
    chance = chances[logit + LOGIT_LIMIT]
    if mode == READ:
        return _get(coder, data, chance)
    bit = _put(coder, data, good, bit, chance)
    coder[CODER_COST] += costs[(logit if bit else -logit) + LOGIT_LIMIT]
    return -1 if coder[CODER_STOP] else bit


@jit
def _is_worth(magnitude: int, threshold: int, guess: int, cost: int, price: int) -> bool:
    """Whether making a coefficient significant takes away enough error for its bits (its sign costs one more)."""
    size, shown = magnitude * 16 // threshold, guess * 16 // threshold
    return bool(shown * (2 * size - shown) >= (price * (cost + 256)) >> 8)


@jit
def code_band(  # noqa: C901, PLR0912, PLR0915  three modes and three passes share one loop, so that they cannot part
    mode: int,
    kind: int,
    plane: int,
    threshold: int,
    row: int,
    low_width: int,
    price: int,
    bar: int,
    bands: I32,
    targets: I32,
    lows: I32,
    f: I32,
    bases: I32,
    known: tuple[I32, I32, I32, I32, I32, I32, I32, I32, I32],
    nets: tuple[I32, I32, I32, I64],
    sign_nets: tuple[I32, I32, I32],
    tables: tuple[I32, I32, I32],
    stream: tuple[I64, U8, U8, I64, I32],
    lists: tuple[I16, I16],
) -> int:
    """Code one pass over one band. Returns 0, or -1 at the end of the stream or of its budget.

    Args:
        mode: WRITE, READ or LIST.
        kind: NEAR, REFINE or ALL.
        plane: Number of the plane, from 1.
        threshold: Of the plane, in coefficient units.
        row: The band's row in `bands`.
        low_width: Width of the low-pass picture of the band's level.
        price: Least error that a bit must take away to be spent on significance (WRITE), in 1/256 of the squared
            threshold; 0 to spend all.
        bar: Least logit that the pass takes.
        bands: The band table.
        targets: The coefficients to tell (WRITE, LIST), flat, multiplied.
        lows: Low-pass pictures known so far.
        f: Features; those from BAND_FEATURES on are filled in.
        bases: Shape (2, HIDDEN_1): first-layer sums that are the band's; first axis as in `nets`.
        known: Lower bounds of the magnitudes, 0 where not significant; how far above the magnitude may lie; signs;
            magnitudes in eighths of the threshold, at most CAP; the same with sign; the plane that decided last, or
            minus the plane that looked last; the logit of the last decision or look; 1 where this plane decided that
            a coefficient is still not significant; by what each coefficient is multiplied, 1/256.
        nets: Weights w1, w2, b2, and the last layer's w3 and b3 as they have been learned in this picture, 1/2^28
            (see `_learn`); first axis 0 for significance and 1 for refinement.
        sign_nets: Weights w1, b1, w2; first axis the band's orientation.
        tables: By logit + LOGIT_LIMIT: probability of 1 in 1/65536, and bits of a 1 in 1/256. And where in its
            interval a coefficient lies, in 1/256, see `_guess`.
        stream: The range coder's state, the bytes, the best whole stream so far (WRITE), squared error by bytes, and
            the picture's own coefficients, flat, that it is an error of.
        lists: Examples of decisions and of signs (LIST).
    """
    values, widths, signs, seen, signed, marks, odds, still, scale = known
    w1, w2, b2, live = nets
    sign_w1, sign_b1, sign_w2 = sign_nets
    chances, costs, centres = tables
    coder, data, good, curve, plain = stream
    stride, orient, level = bands[row, STRIDE], bands[row, ORIENT], bands[row, LEVEL]
    h1, h2, fs = np.zeros(HIDDEN_1, np.int32), np.zeros(HIDDEN_2, np.int32), np.zeros(SIGN_FEATURES, np.int32)
    inverse = int((1 << _INVERSE_BITS) // np.int64(threshold) + 1)
    share = 12 if level == 1 else 4 if level == 2 else 1
    net = 1 if kind == REFINE else 0
    for y in range(bands[row, HEIGHT]):
        for x in range(bands[row, WIDTH]):
            at = bands[row, OFFSET] + y * stride + x
            if marks[at] == plane or (values[at] > 0) != (kind == REFINE):
                continue
            near = kind == REFINE or _is_near(seen, bands, row, y, x, at)
            if kind == NEAR and not near:
                continue
            if kind == ALL and odds[at] < bar - (_SKIP_NEAR if marks[at] == -plane else _SKIP_FAR):
                continue
            magnitude = abs(targets[at])
            bit = 1 if magnitude >= values[at] + threshold else 0
            _context(f, seen, still, lows, bands, low_width, threshold, inverse, row, y, x, at)
            logit = _logit(f, bases[net], w1[net], w2[net], b2[net], live[net], h1, h2)
            if logit < bar:
                marks[at], odds[at] = -plane, logit
                continue
            marks[at] = plane
            if mode == LIST:
                _list_decision(lists[0], coder, f, bit, net, 1 if near else share)
            else:
                if mode == WRITE and bit and kind != REFINE:
                    guess = _guess(threshold, threshold, logit, centres)
                    bit = 1 if _is_worth(magnitude, threshold, guess, costs[logit + LOGIT_LIMIT], price) else 0
                bit = _transfer(mode, bit, logit, chances, costs, coder, data, good)
                if bit < 0:
                    marks[at] = -plane
                    return -1
                _learn(live[net], h2, bit, chances[logit + LOGIT_LIMIT])
            before = _guess(values[at], widths[at], odds[at], centres) if values[at] > 0 else 0
            odds[at] = logit
            if kind == REFINE:
                # A plane halves the interval, unless its bounds have been scaled anew.
                widths[at] = max(widths[at] - threshold, threshold >> 1) if bit else min(widths[at], threshold)
                values[at] += threshold * bit
            elif bit:
                sign = 1 if targets[at] > 0 else 0
                _sign_context(fs, signed, lows, bands, low_width, threshold, row, y, x, at)
                if mode == LIST:
                    _list_sign(lists[1], coder, fs, orient, sign)
                else:
                    slope = _sign_logit(fs, sign_b1[orient], sign_w1, sign_w2, orient)
                    sign = _transfer(mode, sign, slope, chances, costs, coder, data, good)
                    if sign < 0:
                        marks[at] = -plane
                        return -1
                values[at], widths[at], signs[at] = threshold, threshold, 2 * sign - 1
            if values[at] > 0:
                seen[at] = min((values[at] + (widths[at] >> 1)) * 8 // threshold, CAP)
                signed[at] = seen[at] * signs[at]
                after = _guess(values[at], widths[at], odds[at], centres)
                truth, whole = np.int64(plain[at] * signs[at]), np.int64(scale[at])
                curve[0] += (truth - after * 256 // whole) ** 2 - (truth - before * 256 // whole) ** 2
            else:
                still[at] = 1
            if mode == WRITE:
                curve[min(1 + (coder[CODER_COST] >> 11), curve.shape[0] - 1)] = curve[0]
    return 0
