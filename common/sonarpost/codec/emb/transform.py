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


ANALYSIS, CORRELATION, SYNTHESIS = 0, 1, 2
"""Filters: one level of the wavelet, the transpose of its inverse, its inverse."""
_LIFTING: Final = np.array(
    [
        [[1, ALPHA], [0, BETA], [1, GAMMA], [0, DELTA]],
        [[1, -ALPHA], [0, -BETA], [1, -GAMMA], [0, -DELTA]],
        [[0, -DELTA], [1, -GAMMA], [0, -BETA], [1, -ALPHA]],
    ],
    np.int64,
)
"""Lifting steps of each filter: the first of every second value, and the constant."""


@jit
def _filter_lines(  # noqa: C901, PLR0912  one function compiles faster than several
    flat: Plane, count: int, pitch: int, n: int, step: int, kind: int, line: Plane
) -> None:
    """Filter `count` lines of `n` values in place.

    Value i of line k is `flat[k * pitch + i * step]`. `line` has at least n + 2 cells and is overwritten: the values
    from cell 1, and the mirrored values beyond both ends.
    """
    low, high = (n + 1) // 2, n // 2
    for k in range(count):
        start = k * pitch
        if kind == SYNTHESIS:
            for i in range(low):
                line[2 * i + 1] = (flat[start + i * step] * GAIN_INVERSE + _ROUND) >> FRACTION_BITS
            for i in range(high):
                line[2 * i + 2] = (flat[start + (low + i) * step] * GAIN + _ROUND) >> FRACTION_BITS
        else:
            for i in range(n):
                line[i + 1] = flat[start + i * step]
        for number in range(4):
            first, constant = _LIFTING[kind, number, 0] + 1, _LIFTING[kind, number, 1]
            if kind == CORRELATION:  # each second value adds its share to its two neighbours
                line[0], line[n + 1] = 0, 0
                for i in range(first, n + 1, 2):
                    share = (line[i] * constant + _ROUND) >> FRACTION_BITS
                    line[i - 1] += share
                    line[i + 1] += share
                line[2] += line[0]
                line[n - 1] += line[n + 1]
            else:  # the two neighbours of each second value are added to it
                line[0], line[n + 1] = line[2], line[n - 1]
                for i in range(first, n + 1, 2):
                    line[i] += ((line[i - 1] + line[i + 1]) * constant + _ROUND) >> FRACTION_BITS
        if kind == SYNTHESIS:
            for i in range(n):
                flat[start + i * step] = line[i + 1]
        else:
            even_gain, odd_gain = (GAIN, GAIN_INVERSE) if kind == ANALYSIS else (GAIN_INVERSE, GAIN)
            for i in range(low):
                flat[start + i * step] = (line[2 * i + 1] * even_gain + _ROUND) >> FRACTION_BITS
            for i in range(high):
                flat[start + (low + i) * step] = (line[2 * i + 2] * odd_gain + _ROUND) >> FRACTION_BITS


def _filter_rows(plane: Plane, height: int, width: int, kind: int) -> None:
    if width > 1:
        _filter_lines(plane.reshape(-1), height, plane.shape[1], width, 1, kind, np.empty(width + 2, np.int64))


def _filter_columns(plane: Plane, height: int, width: int, kind: int) -> None:
    if height > 1:
        _filter_lines(plane.reshape(-1), width, 1, height, plane.shape[1], kind, np.empty(height + 2, np.int64))


def synthesise_rows(plane: Plane) -> None:
    """Invert one level of the wavelet on each row, in place. The plane is C-contiguous."""
    _filter_rows(plane, plane.shape[0], plane.shape[1], SYNTHESIS)


@jit
def _store_low_pass(plane: Plane, height: int, width: int, lows: I32, start: int) -> None:
    """Store the low-pass image at the top left of the plane, with repeated border."""
    for y in range(-1, height + 1):
        from_y = min(max(y, 0), height - 1)
        at = start + (y + 1) * (width + 2)
        lows[at] = plane[from_y, 0]
        for x in range(width):
            lows[at + x + 1] = plane[from_y, x]
        lows[at + width + 1] = plane[from_y, width - 1]


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
    for height, width in layout.sides[:-1].tolist():
        _filter_rows(plane, height, width, ANALYSIS)
        _filter_columns(plane, height, width, ANALYSIS)
    return _with_cosines(plane, layout)


def correlate(image: Plane, layout: Layout) -> Plane:
    """Return the scalar product of an image with each synthesis wavelet, in the usual square layout.

    This is the transpose of `inverse`: each level takes the columns first.
    """
    plane = np.array(image, np.int64, order="C")
    for height, width in layout.sides[:-1].tolist():
        _filter_columns(plane, height, width, CORRELATION)
        _filter_rows(plane, height, width, CORRELATION)
    return _with_cosines(plane, layout)


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
    plane = np.array(coefficients, np.int64, order="C")
    height, width = (int(n) for n in layout.sides[layout.levels])
    low = _matrix_step(cosine_matrix(width).T, plane[:height, :width].T).T
    plane[:height, :width] = _matrix_step(cosine_matrix(height).T, low)
    lows = np.zeros(layout.low_cells, np.int32)
    for level in range(layout.levels, down_to - 1, -1):
        height, width = layout.sides[level].tolist()
        if level < layout.levels:
            _filter_columns(plane, height, width, SYNTHESIS)
            _filter_rows(plane, height, width, SYNTHESIS)
        if level > 0:
            _store_low_pass(plane, height, width, lows, int(layout.low_offsets[level]))
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
