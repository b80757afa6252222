"""The coding loop and the networks. The same code encodes, decodes and collects training examples.

All arithmetic is on int32 and int64. docs/specifications/emb-stream.md describes the format.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb.contexts import (
    BAND_FEATURES,
    FEATURES,
    INVERSE_BITS,
    MAX_EIGHTHS,
    SIGN_FEATURES,
    SIGN_ODD,
    clip,
    coefficient_context,
    has_significant_neighbour,
    int64,
    sign_context,
)
from sonarpost.codec.emb.range_coder import (
    CODER_CODE,
    CODER_COST,
    CODER_ROWS,
    CODER_SIGN_ROWS,
    COLLECT,
    WRITE,
    code_bit,
)
from sonarpost.codec.emb.transform import HEIGHT, LEVEL, OFFSET, ORIENT, STRIDE, WIDTH
from sonarpost.codec.jit import inlined, jit

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
I16 = npt.NDArray[np.int16]
U8 = npt.NDArray[np.uint8]

NEAR, REFINE, ALL = 0, 1, 2
"""Kinds of pass: insignificant coefficients with significant neighbours; significant ones; all insignificant ones."""

HIDDEN_1: Final = 32
HIDDEN_2: Final = 16
SIGN_HIDDEN: Final = 32
LOGIT_LIMIT: Final = 3071
"""Largest logit, in 1/256. The table of probabilities covers -LOGIT_LIMIT to LOGIT_LIMIT."""
CENTRE_COLUMNS: Final = 24
"""Columns of the table of reconstruction points: logits from -9 in steps of 1/2."""
_CENTRE_SHIFT: Final = 2304
_LIVE_LIMIT: Final = 1 << 34
# A pass skips a coefficient whose last logit is this far below the minimum of the pass. The first value is for logits
# of this plane, the second for earlier ones: the probability grows when the threshold is halved.
_SKIP_NEAR: Final = 384
_SKIP_FAR: Final = 896


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
        h1[j] = _active(int64(h1[j]), 6)
    for i in range(0, HIDDEN_1, 8):
        p, q, r, s = h1[i], h1[i + 1], h1[i + 2], h1[i + 3]
        t, u, v, w = h1[i + 4], h1[i + 5], h1[i + 6], h1[i + 7]
        for j in range(HIDDEN_2):
            h2[j] += (
                p * w2[i, j] + q * w2[i + 1, j] + r * w2[i + 2, j] + s * w2[i + 3, j]
                + t * w2[i + 4, j] + u * w2[i + 5, j] + v * w2[i + 6, j] + w * w2[i + 7, j]
            )  # fmt: skip
    total = int64(last_layer[HIDDEN_2]) * 256
    for i in range(h2.shape[0]):
        h2[i] = _active(int64(h2[i]), 12)
        total += int64(h2[i]) * last_layer[i]
    return clip(total >> 28, LOGIT_LIMIT)


@inlined
def _adapt(last_layer: I64, h2: I32, bit: int, probability: int) -> None:
    """Update the weights of the last layer by gradient descent on the code length of the bit, at a rate of 1/256.

    Units: error 1/2^16, hidden units 1/2^8, weights 1/2^28.
    """
    error = int64((bit << 16) - probability)
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
    total = int64(0)
    for j in range(SIGN_HIDDEN):
        odd, even = int64(sums[j]), int64(sums[SIGN_HIDDEN + j])
        total += (_active(even + odd, 6) - _active(even - odd, 6)) * w2[orient, j]
    return clip(total >> 12, LOGIT_LIMIT)


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
        value = int64(0)
        if lower[at] > 0:
            value = _reconstruct(int64(lower[at]), int64(widths[at]), int64(logits[at]), centres)
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
    coded = code_bit(coder, data, best, bit, int64(probabilities[logit + LOGIT_LIMIT]), mode)
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
    stride, orient, level = int64(bands[row, STRIDE]), int64(bands[row, ORIENT]), int64(bands[row, LEVEL])
    inverse = int((1 << INVERSE_BITS) // int64(threshold) + 1)
    interval = 12 if level == 1 else 4 if level == 2 else 1
    net = 1 if kind == REFINE else 0
    w1, b1, w2, b2, last_layer = nets[0][net], nets[1][net], nets[2][net], nets[3][net], nets[4][net]
    band_base(f, w1, b1, base)
    for y in range(int64(bands[row, HEIGHT])):
        for x in range(int64(bands[row, WIDTH])):
            at = bands[row, OFFSET] + y * stride + x
            if planes[at] == plane or (lower[at] > 0) != (kind == REFINE):
                continue
            is_near = kind == REFINE or has_significant_neighbour(sizes, bands, row, y, x, at)
            if kind == NEAR and not is_near:
                continue
            if kind == ALL and logits[at] < min_logit - (_SKIP_NEAR if planes[at] == -plane else _SKIP_FAR):
                continue
            magnitude = abs(int64(targets[at]))
            bit = 1 if magnitude >= lower[at] + threshold else 0
            coefficient_context(f, sizes, insignificant, lows, bands, low_width, threshold, inverse, row, y, x, at)
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
                before = _reconstruct(int64(lower[at]), int64(widths[at]), int64(logits[at]), centres)
            logits[at] = logit
            if kind == REFINE:
                # A plane halves the interval, unless its bounds were rescaled.
                widths[at] = max(widths[at] - threshold, threshold >> 1) if bit else min(widths[at], threshold)
                lower[at] += threshold * bit
            elif bit:
                sign = 1 if targets[at] > 0 else 0
                sign_context(sign_features, signed, lows, bands, low_width, threshold, row, y, x, at)
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
                after = _reconstruct(int64(lower[at]), int64(widths[at]), int64(logits[at]), centres)
                original, own_scale = int64(originals[at] * signs[at]), int64(scale[at])
                error_after, error_before = original - after * 256 // own_scale, original - before * 256 // own_scale
                curve[0] += error_after**2 - error_before**2
            else:
                insignificant[at] = 1
            if mode == WRITE:
                curve[min(1 + (coder[CODER_COST] >> 11), curve.shape[0] - 1)] = curve[0]
    return 0
