"""The wavelet transform of `emb`, in integers, and the memory layout of its coefficients.

The transform is the 9/7 wavelet with a cosine transform of its lowest band. Lifting steps of Daubechies and Sweldens,
"Factoring wavelet transforms into lifting steps" (1998), with 14-bit constants and symmetric extension at the borders.
Any side from one pixel is possible. Both transforms are orthonormal to within a few per cent: an error in a coefficient
is the same error in the image. Values are 1/64 grey.

The layout stores all bands one after the other in one flat array. Each band has a border of `BORDER` zero cells, so a
neighbour outside the band reads as not significant without a test.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.jit import jit

I32 = npt.NDArray[np.int32]
Plane = npt.NDArray[np.int64]

UNIT: Final = 64
"""Steps of a grey level."""
FRACTION_BITS: Final = 14
_ROUND: Final = 1 << (FRACTION_BITS - 1)
# The constants times 2^14, rounded.
ALPHA: Final = -25987
BETA: Final = -868
GAMMA: Final = 14466
DELTA: Final = 7266
GAIN: Final = 18834  # 1.14954: the low-pass output is the mean of its input times sqrt(2)
GAIN_INVERSE: Final = 14253
# Gain of a coefficient's error in the image, in 1/1024, by level (the last for all above) and orientation LL, HL, LH,
# HH. Coefficients are multiplied by it, so that one threshold suits all of them.
BAND_GAINS: Final = (
    (1024, 1035, 1035, 1065),
    (1024, 1023, 1023, 990),
    (1024, 1071, 1071, 1065),
    (1243, 1097, 1097, 1109),
)

BORDER: Final = 2
LL, HL, LH, HH = 0, 1, 2, 3

# Columns of the band table.
OFFSET, STRIDE, HEIGHT, WIDTH, LEVEL, ORIENT = range(6)
PARENT, SIBLING_1, SIBLING_2, CHILD, LOW, NEXT_1, NEXT_2, COUSIN_1, COUSIN_2 = range(6, 15)
"""OFFSET: flat index of cell (0, 0). LEVEL: 1 is the finest. LOW: start of the level's low-pass image in the array of
low-pass images. The others are rows of the table, -1 for none: SIBLING_1, SIBLING_2, bands of the same level coded
earlier; NEXT_1, NEXT_2, bands of the same level coded later; COUSIN_1, COUSIN_2, siblings of the parent."""


def level_count(height_px: int, width_px: int) -> int:
    """Return the number of wavelet levels. The lowest band then has at most 10 cells a side."""
    longest = max(height_px, width_px)
    return 4 if longest <= 160 else 5 if longest <= 320 else 6


def cells_of(band: list[int]) -> Plane:
    """Return the flat index of each cell of a band, shape (height, width), from its row of the table."""
    return np.asarray(band[OFFSET] + np.arange(band[HEIGHT])[:, None] * band[STRIDE] + np.arange(band[WIDTH]), np.int64)


@dataclass(frozen=True, eq=False)
class Layout:
    """Memory layout of the coefficients of an image size.

    Attributes:
        height_px: Rows of the image.
        width_px: Columns of the image.
        levels: Number of wavelet levels.
        bands: Shape (1 + 3 * levels, 15), int32: the band table, in coding order (coarse to fine).
        cells: Length of the flat array of coefficients.
        position: Shape (height_px, width_px), int64: flat index of each cell of the usual square layout.
        sides: Shape (levels + 1, 2), int32: height and width of the low-pass image of each level; level 0 is the image.
        low_offsets: Shape (levels + 1,), int64: start of each low-pass image, which has a border of one cell.
        low_cells: Length of the array of low-pass images.
    """

    height_px: int
    width_px: int
    levels: int
    bands: I32
    cells: int
    position: Plane
    sides: I32
    low_offsets: Plane
    low_cells: int


@lru_cache(maxsize=8)
def layout_of(height_px: int, width_px: int) -> Layout:
    """Return the layout of an image size."""
    levels = level_count(height_px, width_px)
    sides = [(height_px, width_px)]
    for _ in range(levels):
        sides.append(((sides[-1][0] + 1) // 2, (sides[-1][1] + 1) // 2))
    low_offsets = np.zeros(levels + 1, np.int64)
    low_cells = 0
    for level in range(1, levels + 1):
        low_offsets[level] = low_cells
        low_cells += (sides[level][0] + 2) * (sides[level][1] + 2)
    table: list[tuple[int, ...]] = []
    position, cells = np.zeros((height_px, width_px), np.int64), 0
    for level, orient in [(levels, LL), *((lv, o) for lv in range(levels, 0, -1) for o in (HL, LH, HH))]:
        low_h, low_w = sides[level]
        height, width = sides[level - 1]
        top, left = (low_h if orient in (LH, HH) else 0), (low_w if orient in (HL, HH) else 0)
        rows = height - low_h if orient in (LH, HH) else low_h
        columns = width - low_w if orient in (HL, HH) else low_w
        stride = columns + 2 * BORDER
        offset = cells + BORDER * stride + BORDER
        cells += (rows + 2 * BORDER) * stride
        row = len(table)
        parent = -1 if orient == LL or level == levels else row - 3
        child = -1 if orient == LL or level == 1 else row + 3
        first = -1 if orient in (LL, HL) else row - (orient - 1)
        second = row - 1 if orient == HH else -1
        following = (-1, -1) if orient == LL else ((row + 1, row + 2), (row + 1, -1), (-1, -1))[orient - 1]
        cousins = (-1, -1) if parent < 0 else tuple(parent - orient + o for o in (HL, LH, HH) if o != orient)
        low = int(low_offsets[level])
        table.append(
            (offset, stride, rows, columns, level, orient, parent, first, second, child, low, *following, *cousins)
        )
        position[top : top + rows, left : left + columns] = cells_of(list(table[-1]))
    bands, sides_array = np.array(table, np.int32), np.array(sides, np.int32)
    return Layout(height_px, width_px, levels, bands, cells, position, sides_array, low_offsets, low_cells)


@jit
def _lift(line: Plane, n: int, first: int, constant: int) -> None:
    """Add to every second value, from `first`, its two neighbours times a constant; mirrored at the ends."""
    for i in range(first, n, 2):
        left = line[i - 1] if i > 0 else line[i + 1]
        right = line[i + 1] if i + 1 < n else line[i - 1]
        line[i] += ((left + right) * constant + _ROUND) >> FRACTION_BITS


@jit
def _lift_transposed(line: Plane, n: int, first: int, constant: int) -> None:
    """Transpose of `_lift`: every second value adds its share to its two neighbours."""
    for i in range(first, n, 2):
        share = (line[i] * constant + _ROUND) >> FRACTION_BITS
        line[i - 1 if i > 0 else i + 1] += share
        line[i + 1 if i + 1 < n else i - 1] += share


@jit
def _decompose_line(line: Plane, n: int, scratch: Plane, transposed: int) -> None:
    """Apply one level of the wavelet; `transposed`: the transpose of `synthesise_line` instead."""
    if n == 1:
        return
    if transposed:
        _lift_transposed(line, n, 1, -ALPHA)
        _lift_transposed(line, n, 0, -BETA)
        _lift_transposed(line, n, 1, -GAMMA)
        _lift_transposed(line, n, 0, -DELTA)
        even_gain, odd_gain = GAIN_INVERSE, GAIN
    else:
        _lift(line, n, 1, ALPHA)
        _lift(line, n, 0, BETA)
        _lift(line, n, 1, GAMMA)
        _lift(line, n, 0, DELTA)
        even_gain, odd_gain = GAIN, GAIN_INVERSE
    low = (n + 1) // 2
    for i in range(n):
        place, gain = (i // 2, even_gain) if i % 2 == 0 else (low + i // 2, odd_gain)
        scratch[place] = (line[i] * gain + _ROUND) >> FRACTION_BITS
    line[:n] = scratch[:n]


@jit
def synthesise_line(line: Plane, n: int, scratch: Plane) -> None:
    """Invert one level of the wavelet on the first `n` values of a line, in place. `scratch` is at least as long."""
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
def _decompose(plane: Plane, sides: I32, transposed: int) -> None:
    """Apply `_decompose_line` to the rows and then the columns of each level."""
    line = np.zeros(max(plane.shape), np.int64)
    scratch = np.zeros(max(plane.shape), np.int64)
    for level in range(sides.shape[0] - 1):
        height, width = sides[level, 0], sides[level, 1]
        for y in range(height):
            line[:width] = plane[y, :width]
            _decompose_line(line, width, scratch, transposed)
            plane[y, :width] = line[:width]
        for x in range(width):
            line[:height] = plane[:height, x]
            _decompose_line(line, height, scratch, transposed)
            plane[:height, x] = line[:height]


@jit
def _inverse(plane: Plane, sides: I32, down_to: int, lows: I32, offsets: Plane) -> None:
    """Invert the levels above `down_to`; store the low-pass image of each level, with repeated border."""
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
    """Return the orthonormal cosine transform of length `n`, rounded to 14 bits, by integer arithmetic only.

    Row k holds sqrt(2 / n) cos(pi (2 i + 1) k / 2n), row 0 sqrt(1 / n).
    """
    one = 1 << 60
    pi = 3622009729038561421  # round(pi * 2^60)
    matrix = np.zeros((n, n), np.int64)
    for k in range(n):
        # value = cos * sqrt(numerator / n). Squares are exact integers until the last step.
        numerator = 1 if k == 0 else 2
        for i in range(n):
            quarter_turns, rest = divmod((2 * i + 1) * k, n)
            cosine = _cos(pi * rest // (2 * n), one)
            sine = _cos(pi * (n - rest) // (2 * n), one)
            value = (cosine, -sine, -cosine, sine)[quarter_turns % 4]
            square = value * value * numerator // n
            matrix[k, i] = _rounded_root(square, 60 - FRACTION_BITS) * (1 if value > 0 else -1)
    return matrix


def _cos(angle: int, one: int) -> int:
    """Return the cosine of `angle` / `one` for 0..pi/2 by its series, scaled by `one`."""
    term = total = one
    for m in range(1, 14):
        term = -(term * angle // one) * angle // one // ((2 * m - 1) * (2 * m))
        total += term
    return max(total, 0)


def _rounded_root(square: int, drop_bits: int) -> int:
    """Return the square root without its last `drop_bits` bits, rounded."""
    return (math.isqrt(square) + (1 << (drop_bits - 1))) >> drop_bits


def _matrix_step(matrix: Plane, plane: Plane) -> Plane:
    return (matrix @ plane + _ROUND) >> FRACTION_BITS


def forward(image: Plane, layout: Layout) -> Plane:
    """Return the coefficients of an image in the usual square layout.

    Args:
        image: Shape (height_px, width_px), int64, in 1/64 grey, minus its mean level.
        layout: Layout of the image.
    """
    plane = np.array(image, np.int64, order="C")
    _decompose(plane, layout.sides, 0)
    return _with_cosines(plane, layout)


def correlate(image: Plane, layout: Layout) -> Plane:
    """Return the scalar product of an image with each synthesis wavelet, in the usual square layout.

    This is the transpose of `inverse`: each level takes the columns first.
    """
    turned = np.array(image.T, np.int64, order="C")
    _decompose(turned, np.ascontiguousarray(layout.sides[:, ::-1]), 1)
    return _with_cosines(turned.T, layout)


def _with_cosines(plane: Plane, layout: Layout) -> Plane:
    """Apply the cosine transform to the lowest band, in place."""
    height, width = (int(n) for n in layout.sides[layout.levels])
    low = _matrix_step(cosine_matrix(height), plane[:height, :width])
    plane[:height, :width] = _matrix_step(cosine_matrix(width), low.T).T
    return plane


def inverse(coefficients: Plane, layout: Layout, down_to: int = 0) -> tuple[Plane, I32]:
    """Return the image and its low-pass images.

    Args:
        coefficients: Shape (height_px, width_px), int64, in the usual square layout.
        layout: Layout of the image.
        down_to: Level of the result; 0 gives the image.

    Returns:
        The plane, with the low-pass image of level `down_to` at its top left; and all low-pass images from that level
        up, at `layout.low_offsets`, each with a border of one cell, int32.
    """
    plane = coefficients.astype(np.int64, copy=True)
    height, width = (int(n) for n in layout.sides[layout.levels])
    low = _matrix_step(cosine_matrix(width).T, plane[:height, :width].T).T
    plane[:height, :width] = _matrix_step(cosine_matrix(height).T, low)
    lows = np.zeros(layout.low_cells, np.int32)
    _inverse(plane, layout.sides, down_to, lows, layout.low_offsets)
    return plane, lows


@lru_cache(maxsize=8)
def gain_map(layout: Layout) -> Plane:
    """Return the gain of every coefficient in the flat layout, in 1/1024."""
    gains = np.full(layout.cells, 1024, np.int64)
    for offset, stride, rows, columns, level, orient, *_ in layout.bands.tolist():
        if rows and columns:
            gains[offset : offset + rows * stride] = BAND_GAINS[min(level, 4) - 1][orient]
    return gains


def to_flat(plane: Plane, layout: Layout) -> I32:
    """Return coefficients in the flat layout, multiplied by their gains, int32."""
    flat = np.zeros(layout.cells, np.int64)
    flat[layout.position] = plane
    return ((flat * gain_map(layout) + 512) >> 10).astype(np.int32)


def from_flat(flat: I32, layout: Layout) -> Plane:
    """Invert `to_flat`."""
    out = np.zeros(layout.position.shape, np.int64)
    _place(flat, gain_map(layout), layout.position, out)
    return out


@jit
def _place(flat: I32, gains: Plane, position: Plane, out: Plane) -> None:
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            at = position[y, x]
            value = np.int64(flat[at])
            out[y, x] = (value * 1024 + (gains[at] >> 1)) // gains[at] if value != 0 else 0
