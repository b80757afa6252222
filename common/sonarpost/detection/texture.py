"""Local texture anomaly: does the seabed look otherwise here than around?

The Reed-Xiaoli anomaly detector (Reed and Yu, IEEE Trans. ASSP 38(10), 1990) on texture instead of colour bands. The
level picture is reduced to blocks; a window of blocks has five numbers: mean, spread, mean step along-track, mean step
across-track, and the spread of its blocks' means. The score of a place is the Mahalanobis distance of its numbers from
those of the windows in a ring around it, per square root of the numbers: about 1 on a seabed of one texture whatever
that is, above 3 where something lies that the seabed around does not have.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sonarpost.detection.preprocess import LevelGrid

Features = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

_BLOCK_M: Final = 0.25
_WINDOW_BLOCKS: Final = 5
_GUARD_BLOCKS: Final = 8
_REACH_BLOCKS: Final = 32
_STEP_BLOCKS: Final = 3
_LEAST_WINDOWS: Final = 24
_NEAR_BLOCKS: Final = 1
_COUNT: Final = 5
_RIDGE: Final = 0.05
"""Part of each number's own variance over the whole picture that is added to the ring's: a ring may be very even."""


class TextureMap:
    """The texture of a level grid, from which `anomaly` is asked place by place.

    Args:
        grid: One side of a survey, or a piece.
    """

    def __init__(self, grid: LevelGrid) -> None:
        self._rows = max(1, round(_BLOCK_M / grid.row_along_m))
        self._cells = max(1, round(_BLOCK_M / grid.cell_across_m))
        self._features = _window_features(grid.level, self._rows, self._cells)
        self._known: Flags = np.asarray(np.isfinite(self._features).all(axis=-1))
        known = self._features[self._known]
        self._spread = known.var(axis=0) if len(known) else np.ones(_COUNT)

    def anomaly(self, row: int, cell: int) -> float:
        """Return the score at a cell of the grid; 0 where too little is known around it."""
        top, left = row // self._rows, cell // self._cells
        own = self._around(top, left, _NEAR_BLOCKS)
        ring = self._ring(top, left)
        if not len(own) or len(ring) < _LEAST_WINDOWS:
            return 0.0
        centre = ring.mean(axis=0)
        covariance = np.cov(ring, rowvar=False) + np.diag(_RIDGE * self._spread + 1e-6)
        off = own - centre
        squared = np.einsum("ij,ij->i", off, np.linalg.solve(covariance, off.T).T)
        return float(np.sqrt(max(float(squared.max()), 0.0) / _COUNT))

    def _around(self, top: int, left: int, reach: int) -> Features:
        rows = slice(max(0, top - reach), top + reach + 1)
        columns = slice(max(0, left - reach), left + reach + 1)
        near: Features = self._features[rows, columns][self._known[rows, columns]]
        return near

    def _ring(self, top: int, left: int) -> Features:
        first_row, first_column = max(0, top - _REACH_BLOCKS), max(0, left - _REACH_BLOCKS)
        rows = slice(first_row, top + _REACH_BLOCKS + 1, _STEP_BLOCKS)
        columns = slice(first_column, left + _REACH_BLOCKS + 1, _STEP_BLOCKS)
        wanted = self._known[rows, columns].copy()
        far_rows = np.abs(first_row + _STEP_BLOCKS * np.arange(wanted.shape[0]) - top) > _GUARD_BLOCKS
        far_columns = np.abs(first_column + _STEP_BLOCKS * np.arange(wanted.shape[1]) - left) > _GUARD_BLOCKS
        wanted &= far_rows[:, None] | far_columns[None, :]
        ring: Features = self._features[rows, columns][wanted]
        return ring


def _window_features(level: npt.NDArray[np.float32], rows: int, cells: int) -> Features:
    """Return the numbers of the window around each block, shape (blocks, blocks, 5), NaN where mostly unknown."""
    known = np.isfinite(level)
    filled = np.where(known, level, 0.0).astype(np.float32)
    along = np.zeros_like(filled)
    along[1:] = np.where(known[1:] & known[:-1], np.abs(filled[1:] - filled[:-1]), 0.0)
    across = np.zeros_like(filled)
    across[:, 1:] = np.where(known[:, 1:] & known[:, :-1], np.abs(filled[:, 1:] - filled[:, :-1]), 0.0)
    count = _block_sums(known.astype(np.float32), rows, cells)
    sums = [_block_sums(plane, rows, cells) for plane in (filled, filled**2, along, across)]
    block_mean = np.divide(sums[0], count, out=np.zeros_like(sums[0]), where=count > 0)
    totals = [_window_sums(plane) for plane in (*sums, count * block_mean**2)]
    weight = _window_sums(count)
    enough = weight >= 0.5 * rows * cells * _WINDOW_BLOCKS**2
    weight = np.where(enough, weight, np.nan)
    mean, square, step_along, step_across, block_square = (total / weight for total in totals)
    spread = np.sqrt(np.maximum(square - mean**2, 0.0))
    structure = np.sqrt(np.maximum(block_square - mean**2, 0.0))
    return np.stack([mean, spread, step_along, step_across, structure], axis=-1)


def _block_sums(plane: npt.NDArray[np.float32], rows: int, cells: int) -> Features:
    """Sum over blocks; what is left of the last ones counts as a block of its own."""
    padded = np.pad(plane, ((0, -plane.shape[0] % rows), (0, -plane.shape[1] % cells)))
    shape = (padded.shape[0] // rows, rows, padded.shape[1] // cells, cells)
    sums: Features = padded.reshape(shape).sum(axis=(1, 3), dtype=np.float64)
    return sums


def _window_sums(plane: Features) -> Features:
    size = _WINDOW_BLOCKS
    sums: Features = ndimage.uniform_filter(plane, size=size, mode="constant") * size**2
    return sums
