"""Where every wavelet coefficient of a picture lies in memory, and who its relatives are.

All bands lie one after the other in one flat array, each surrounded by `BORDER` cells of zeros, so that a neighbour
outside the band reads as "not significant" without a test.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int32]
Index = npt.NDArray[np.int64]

BORDER: Final = 2
LL, HL, LH, HH = 0, 1, 2, 3

# Columns of the band table.
(
    OFFSET,
    STRIDE,
    HEIGHT,
    WIDTH,
    LEVEL,
    ORIENT,
    PARENT,
    SIBLING_1,
    SIBLING_2,
    CHILD,
    LOW,
    NEXT_1,
    NEXT_2,
    COUSIN_1,
    COUSIN_2,
) = range(15)
"""OFFSET: flat index of the band's cell (0, 0). LEVEL: 1 is the finest. PARENT, SIBLING_1, SIBLING_2, CHILD: rows of
the table, -1 for none; a sibling is a band of the same level that is coded earlier. LOW: where the level's low-pass
picture begins in the array of low-pass pictures."""


def level_count(height_px: int, width_px: int) -> int:
    """Number of wavelet levels: so many that the lowest band is at most 10 cells a side."""
    longest = max(height_px, width_px)
    return 4 if longest <= 160 else 5 if longest <= 320 else 6


def cells_of(band: list[int]) -> Index:
    """Return the flat index of every cell of a band, shape (its height, its width), of its row of the table."""
    return np.asarray(band[OFFSET] + np.arange(band[HEIGHT])[:, None] * band[STRIDE] + np.arange(band[WIDTH]), np.int64)


@dataclass(frozen=True, eq=False)
class Layout:
    """Memory layout for one picture size.

    Attributes:
        height_px: Rows of the picture.
        width_px: Columns.
        levels: Wavelet levels.
        bands: Shape (1 + 3 * levels, 11), int32: the table, in coding order (coarse to fine).
        cells: Length of the flat array of coefficients.
        position: Shape (height_px, width_px), int64: flat index of each cell of the transform's usual square layout.
        sides: Shape (levels + 1, 2), int32: height and width of the low-pass picture at each level; 0 is the picture.
        low_offsets: Shape (levels + 1,), int64: where each low-pass picture (with a border of one cell) begins.
        low_cells: Length of the array of low-pass pictures.
    """

    height_px: int
    width_px: int
    levels: int
    bands: Ints
    cells: int
    position: Index
    sides: Ints
    low_offsets: Index
    low_cells: int


@lru_cache(maxsize=8)
def layout(height_px: int, width_px: int) -> Layout:
    """Return the layout of a picture size."""
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
        number = len(table)
        parent = -1 if orient == LL or level == levels else number - 3
        child = -1 if orient == LL or level == 1 else number + 3
        first = -1 if orient in (LL, HL) else number - (orient - 1)
        second = number - 1 if orient == HH else -1
        following = (-1, -1) if orient == LL else ((number + 1, number + 2), (number + 1, -1), (-1, -1))[orient - 1]
        cousins = (-1, -1) if parent < 0 else tuple(parent - orient + o for o in (HL, LH, HH) if o != orient)
        low = int(low_offsets[level])
        table.append(
            (offset, stride, rows, columns, level, orient, parent, first, second, child, low, *following, *cousins)
        )
        position[top : top + rows, left : left + columns] = cells_of(list(table[-1]))
    return Layout(
        height_px,
        width_px,
        levels,
        np.array(table, np.int32),
        cells,
        position,
        np.array(sides, np.int32),
        low_offsets,
        low_cells,
    )
