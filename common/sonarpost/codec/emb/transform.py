"""The 9/7 wavelet and a cosine transform of its lowest band, in integers.

Lifting steps of Daubechies and Sweldens, "Factoring wavelet transforms into lifting steps" (1998), with 14-bit
constants and symmetric extension at the borders; any side from one pixel up. Scaled so that both transforms are
orthonormal to within a few per cent: an error in a coefficient is the same error in the picture. Values are 1/64 grey.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb._jit import jit
from sonarpost.codec.emb.layout import Layout

Plane = npt.NDArray[np.int64]

UNIT: Final = 64
"""Steps of a grey value."""
FRACTION_BITS: Final = 14
_ROUND: Final = 1 << (FRACTION_BITS - 1)
# The constants times 2^14, rounded.
ALPHA: Final = -25987
BETA: Final = -868
GAMMA: Final = 14466
DELTA: Final = 7266
GAIN: Final = 18834  # 1.14954: makes a low-pass output as strong as its input's mean times sqrt(2)
GAIN_INVERSE: Final = 14253


# Strength in the picture of a coefficient's error, by level (the last for all above) and orientation LL, HL, LH, HH, in
# 1/1024; coefficients are multiplied by it, so that one threshold is right for all.
STRENGTHS: Final = (
    (1024, 1035, 1035, 1065),
    (1024, 1023, 1023, 990),
    (1024, 1071, 1071, 1065),
    (1243, 1097, 1097, 1109),
)


@jit
def _lift(line: Plane, n: int, first: int, constant: int) -> None:
    """Add to every second value, from `first` on, its two neighbours times a constant; mirrored at the ends."""
    for i in range(first, n, 2):
        left = line[i - 1] if i > 0 else line[i + 1]
        right = line[i + 1] if i + 1 < n else line[i - 1]
        line[i] += ((left + right) * constant + _ROUND) >> FRACTION_BITS


@jit
def _analyse(line: Plane, n: int, scratch: Plane) -> None:
    if n == 1:
        return
    _lift(line, n, 1, ALPHA)
    _lift(line, n, 0, BETA)
    _lift(line, n, 1, GAMMA)
    _lift(line, n, 0, DELTA)
    low = (n + 1) // 2
    for i in range(n):
        if i % 2 == 0:
            scratch[i // 2] = (line[i] * GAIN + _ROUND) >> FRACTION_BITS
        else:
            scratch[low + i // 2] = (line[i] * GAIN_INVERSE + _ROUND) >> FRACTION_BITS
    line[:n] = scratch[:n]


@jit
def synthesise_line(line: Plane, n: int, scratch: Plane) -> None:
    """Undo one level of the wavelet on the first `n` values of a line, in place; `scratch` is at least as long."""
    if n == 1:
        return
    low = (n + 1) // 2
    for i in range(n):
        if i % 2 == 0:
            scratch[i] = (line[i // 2] * GAIN_INVERSE + _ROUND) >> FRACTION_BITS
        else:
            scratch[i] = (line[low + i // 2] * GAIN + _ROUND) >> FRACTION_BITS
    _lift(scratch, n, 0, -DELTA)
    _lift(scratch, n, 1, -GAMMA)
    _lift(scratch, n, 0, -BETA)
    _lift(scratch, n, 1, -ALPHA)
    line[:n] = scratch[:n]


@jit
def _forward(plane: Plane, sides: npt.NDArray[np.int32]) -> None:
    line = np.zeros(max(plane.shape), np.int64)
    scratch = np.zeros(max(plane.shape), np.int64)
    for level in range(sides.shape[0] - 1):
        height, width = sides[level, 0], sides[level, 1]
        for y in range(height):
            line[:width] = plane[y, :width]
            _analyse(line, width, scratch)
            plane[y, :width] = line[:width]
        for x in range(width):
            line[:height] = plane[:height, x]
            _analyse(line, height, scratch)
            plane[:height, x] = line[:height]


@jit
def _inverse(
    plane: Plane, sides: npt.NDArray[np.int32], down_to: int, lows: npt.NDArray[np.int32], offsets: Plane
) -> None:
    """Undo the levels above `down_to`; keep the low-pass picture of every level met, its border repeated."""
    line = np.zeros(max(plane.shape), np.int64)
    scratch = np.zeros(max(plane.shape), np.int64)
    for level in range(sides.shape[0] - 1, down_to - 1, -1):
        height, width = sides[level, 0], sides[level, 1]
        if level < sides.shape[0] - 1:
            for x in range(width):
                line[:height] = plane[:height, x]
                synthesise_line(line, height, scratch)
                plane[:height, x] = line[:height]
            for y in range(height):
                line[:width] = plane[y, :width]
                synthesise_line(line, width, scratch)
                plane[y, :width] = line[:width]
        if level > 0:
            for y in range(-1, height + 1):
                from_y = min(max(y, 0), height - 1)
                at = offsets[level] + (y + 1) * (width + 2)
                for x in range(-1, width + 1):
                    lows[at + x + 1] = plane[from_y, min(max(x, 0), width - 1)]


@lru_cache(maxsize=64)
def cosine_matrix(n: int) -> Plane:
    """Return the orthonormal cosine transform of length `n`, rounded to 14 bits, by integer arithmetic alone.

    Row k holds sqrt(2 / n) cos(pi (2 i + 1) k / 2n), row 0 sqrt(1 / n).
    """
    one = 1 << 60
    pi = 3622009729038561421  # round(pi * 2^60)
    matrix = np.zeros((n, n), np.int64)
    for k in range(n):
        # Norm as a rational square: value = cos * sqrt(c / n); both squares are exact integers until the last step.
        share = 1 if k == 0 else 2
        for i in range(n):
            quarter_turns, rest = divmod((2 * i + 1) * k, n)
            cosine = _cos(pi * rest // (2 * n), one)
            sine = _cos(pi * (n - rest) // (2 * n), one)
            value = (cosine, -sine, -cosine, sine)[quarter_turns % 4]
            square = value * value * share // n
            matrix[k, i] = _rounded_root(square, 60 - FRACTION_BITS) * (1 if value > 0 else -1)
    return matrix


def _cos(angle: int, one: int) -> int:
    """Cosine of `angle` / `one` for 0..pi/2 by its series, scaled by `one`."""
    term = total = one
    for m in range(1, 14):
        term = -(term * angle // one) * angle // one // ((2 * m - 1) * (2 * m))
        total += term
    return max(total, 0)


def _rounded_root(square: int, drop_bits: int) -> int:
    """Square root, without its last `drop_bits` bits, rounded."""
    root = _integer_root(square)
    return (root + (1 << (drop_bits - 1))) >> drop_bits


def _integer_root(square: int) -> int:
    guess = 1 << ((square.bit_length() + 1) // 2)
    while True:
        better = (guess + square // guess) // 2 if guess else 0
        if better >= guess:
            return guess
        guess = better


def _matrix_step(matrix: Plane, plane: Plane) -> Plane:
    return (matrix @ plane + _ROUND) >> FRACTION_BITS


def forward(picture: Plane, lay: Layout) -> Plane:
    """Return the coefficients of a picture in the usual square layout.

    Args:
        picture: Shape (height_px, width_px), int64, in 1/64 grey, with its mean level taken off.
        lay: The picture's layout.
    """
    plane = np.ascontiguousarray(picture, np.int64).copy()
    _forward(plane, lay.sides)
    height, width = (int(n) for n in lay.sides[lay.levels])
    low = _matrix_step(cosine_matrix(height), plane[:height, :width])
    plane[:height, :width] = _matrix_step(cosine_matrix(width), low.T).T
    return plane


def inverse(coefficients: Plane, lay: Layout, down_to: int = 0) -> tuple[Plane, npt.NDArray[np.int32]]:
    """Return the picture and the low-pass pictures on the way to it.

    Args:
        coefficients: Shape (height_px, width_px), int64, in the usual square layout.
        lay: The picture's layout.
        down_to: The level to stop at; 0 gives the picture.

    Returns:
        The plane, of which the top left holds the low-pass picture of level `down_to`; and all low-pass pictures from
        that level up, at `lay.low_offsets`, each with a border of one cell, int32.
    """
    plane = coefficients.astype(np.int64, copy=True)
    height, width = (int(n) for n in lay.sides[lay.levels])
    low = _matrix_step(cosine_matrix(width).T, plane[:height, :width].T).T
    plane[:height, :width] = _matrix_step(cosine_matrix(height).T, low)
    lows = np.zeros(lay.low_cells, np.int32)
    _inverse(plane, lay.sides, down_to, lows, lay.low_offsets)
    return plane, lows


@lru_cache(maxsize=8)
def strength_map(lay: Layout) -> Plane:
    """Return the strength of every coefficient in the flat layout, in 1/1024."""
    strengths = np.full(lay.cells, 1024, np.int64)
    for offset, stride, rows, columns, level, orient, *_ in lay.bands.tolist():
        if rows and columns:
            strengths[offset : offset + rows * stride] = STRENGTHS[min(level, 4) - 1][orient]
    return strengths


def to_flat(plane: Plane, lay: Layout) -> npt.NDArray[np.int32]:
    """Return coefficients in the flat layout, weighted by their strength, int32."""
    flat = np.zeros(lay.cells, np.int64)
    flat[lay.position] = plane
    return ((flat * strength_map(lay) + 512) >> 10).astype(np.int32)


def from_flat(flat: npt.NDArray[np.int32], lay: Layout) -> Plane:
    """Undo `to_flat`."""
    out = np.zeros(lay.position.shape, np.int64)
    _place(flat, strength_map(lay), lay.position, out)
    return out


@jit
def _place(flat: npt.NDArray[np.int32], strengths: Plane, position: Plane, out: Plane) -> None:
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            at = position[y, x]
            value = np.int64(flat[at])
            out[y, x] = (value * 1024 + (strengths[at] >> 1)) // strengths[at] if value != 0 else 0
