"""Every place the matched filter points to, with what each filter says of it.

## sonarpost.detection.candidates
What one candidate looks like up close: highlight, shadow, the seabed around, and two filters of their own.

The matched filter says where to look; these two look again, each at one property alone, so that their agreement means
something: the constant-false-alarm test compares the highlight with a guarded ring of seabed, the shadow test asks
whether the dark behind it is dark, begins at the highlight, is not riddled with echoes, and goes on along-track no
farther than the highlight suggests.


## sonarpost.detection.candidates
Local texture anomaly: does the seabed look otherwise here than around?

The Reed-Xiaoli anomaly detector (Reed and Yu, IEEE Trans. ASSP 38(10), 1990) on texture instead of colour bands. The
level picture is reduced to blocks; a window of blocks has five numbers: mean, spread, mean step along-track, mean step
across-track, and the spread of its blocks' means. The score of a place is the Mahalanobis distance of its numbers from
those of the windows in a ring around it, per square root of the numbers: about 1 on a seabed of one texture whatever
that is, above 3 where something lies that the seabed around does not have.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sonarpost.detection.matched_filter import Peak, matched_response, peaks
from sonarpost.detection.normalisation import LevelGrid
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import FloatImage

_MOST_PER_KILOPING: Final = 250


@dataclass(frozen=True, slots=True)
class FilterScores:
    """What each filter says of a place; 0 or more, and more is more like an object on the bottom.

    Attributes:
        matched: Highlight-and-shadow matched filter, in deviations of the noise around.
        cfar: Highlight over the ring of seabed around it, in the ring's deviations.
        shadow: Depth of the shadow below that ring, in the same, times the part of it that is dark.
        texture: Distance of the texture, where highlight and shadow meet, from that of the seabed around
            (`sonarpost.detection.candidates`).
        geometry: 0 to 1, how well highlight and shadow have the proportions of a compact object, see `geometry_score`.
    """

    matched: float
    cfar: float
    shadow: float
    texture: float
    geometry: float


@dataclass(frozen=True, slots=True)
class Candidate:
    """A place and its scores."""

    measured: Measured
    scores: FilterScores


def candidates(grid: LevelGrid, settings: DetectorSettings) -> list[Candidate]:
    """Return the places on one side that the matched filter points to, strongest first.

    Args:
        grid: One side of a survey, or a piece of a picture.
        settings: How to look.
    """
    most = math.ceil(_MOST_PER_KILOPING * max(1.0, len(grid.level) / 1000))
    found = peaks(matched_response(grid, settings), grid, settings, settings.least_matched)[:most]
    measured = [m for m in (measure(grid, peak, settings) for peak in found) if m is not None]
    texture = TextureMap(grid)
    return [
        Candidate(
            one,
            FilterScores(
                matched=one.matched,
                cfar=one.cfar,
                shadow=one.shadow,
                texture=texture.anomaly(one.row, one.cells[1]),
                geometry=geometry_score(one, grid, settings),
            ),
        )
        for one in measured
    ]


def geometry_score(one: Measured, grid: LevelGrid, settings: DetectorSettings) -> float:
    """Return how well highlight and shadow have the proportions that a compact object's have, 0 to 1.

    The score is exp(-d), d the sum of how far, in natural logarithms, each of these lies beyond what is granted: the
    highlight's longer side beyond the greatest mine's length; its longer over its shorter side beyond 4; the shadow's
    extent along-track beyond twice the highlight's (or a metre) or below half of it; a missing shadow counts 1.
    """
    length_m = (one.rows[1] - one.rows[0]) * grid.row_along_m
    width_m = (one.cells[1] - one.cells[0]) * grid.cell_across_m
    longer, shorter = max(length_m, width_m), max(min(length_m, width_m), 1e-3)
    beyond = max(0.0, math.log(longer / settings.mine_length_m[1])) + max(0.0, math.log(longer / shorter / 4.0))
    if one.shadow_rows == 0:
        return math.exp(-beyond - 1.0)
    shadow_along_m = one.shadow_rows * grid.row_along_m
    beyond += max(0.0, math.log(shadow_along_m / max(2.0 * length_m, 1.0)))
    beyond += max(0.0, math.log(0.5 * length_m / shadow_along_m))
    return math.exp(-beyond)


# A shadow may be broken by speckle for this much of its own length before it ends.
_GAP_M = 0.25
# A shadow begins within this distance of the highlight's outer edge: an object does not float far off the seabed.
_START_M = 0.5


@dataclass(frozen=True, slots=True)
class Measured:
    """A candidate in grid cells, and what the two filters say of it.

    Attributes:
        row: Centre row of the highlight.
        cell: Centre cell of the highlight.
        rows: First and one-past-last row of the highlight.
        cells: First and one-past-last cell of the highlight.
        shadow_cells: Number of cells of shadow behind the highlight's outer edge (0: none found).
        shadow_is_cut: True when the shadow runs to the end of the recording.
        matched: Matched-filter response in local-noise units.
        cfar: Highlight over the ring's median, in the ring's deviations.
        shadow: Depth of the shadow below the ring's median, in the ring's deviations, times its dark part.
        shadow_rows: Along-track extent of the dark region that the shadow belongs to, in rows; 0 where none is.
    """

    row: int
    cell: int
    rows: tuple[int, int]
    cells: tuple[int, int]
    shadow_cells: int
    shadow_is_cut: bool
    matched: float
    cfar: float
    shadow: float
    shadow_rows: int = 0


def measure(grid: LevelGrid, peak: Peak, settings: DetectorSettings) -> Measured | None:
    """Measure one peak of the matched filter, or return None when too little seabed surrounds it to compare with."""
    ring = _ring(grid, peak, settings)
    if ring.size < 30:
        return None
    seabed = float(np.median(ring))
    deviation = max(1.4826 * float(np.median(np.abs(ring - seabed))), 0.1)
    rows, cells = _highlight_extent(grid, peak, seabed, deviation)
    bright = _core_mean(grid.level, peak)
    length, is_cut, depth, dark_part, spread_rows = _shadow(grid, rows, cells, seabed, deviation)
    return Measured(
        row=(rows[0] + rows[1] - 1) // 2,
        cell=(cells[0] + cells[1] - 1) // 2,
        rows=rows,
        cells=cells,
        shadow_cells=length,
        shadow_is_cut=is_cut,
        matched=peak.score,
        cfar=max(0.0, (bright - seabed) / deviation),
        shadow=max(0.0, depth) * dark_part,
        shadow_rows=spread_rows,
    )


def _core_mean(level: FloatImage, peak: Peak) -> float:
    top = max(0, peak.row - peak.highlight_rows // 2)
    left = max(0, peak.cell - peak.highlight_cells // 2)
    core = level[top : top + peak.highlight_rows, left : left + peak.highlight_cells]
    return float(np.nanmean(core))


def _ring(grid: LevelGrid, peak: Peak, settings: DetectorSettings) -> npt.NDArray[np.float32]:
    """Levels of the seabed around the highlight, without a guard band and the strip that its shadow falls on."""
    guard_rows = max(1, round(settings.guard_m / grid.row_along_m)) + peak.highlight_rows // 2
    guard_cells = max(1, round(settings.guard_m / grid.cell_across_m)) + peak.highlight_cells // 2
    far_rows = guard_rows + max(2, round(settings.ring_m / grid.row_along_m))
    far_cells = guard_cells + max(4, round(settings.ring_m / grid.cell_across_m))
    top, left = max(0, peak.row - far_rows), max(0, peak.cell - far_cells)
    patch = grid.level[top : peak.row + far_rows + 1, left : peak.cell + far_cells + 1]
    row = np.arange(top, top + patch.shape[0])[:, None] - peak.row
    cell = np.arange(left, left + patch.shape[1])[None, :] - peak.cell
    inside = (np.abs(row) <= guard_rows) & (cell >= -guard_cells)  # guard band and everything behind it
    values: npt.NDArray[np.float32] = patch[~inside & np.isfinite(patch)]
    return values


def _highlight_extent(
    grid: LevelGrid, peak: Peak, seabed: float, deviation: float
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Bounds of the connected bright cells that hold the peak, above half of the peak's height over the seabed."""
    reach_rows = max(3, round(6.0 / grid.row_along_m))
    reach_cells = max(6, round(4.0 / grid.cell_across_m))
    top, left = max(0, peak.row - reach_rows), max(0, peak.cell - reach_cells)
    patch = grid.level[top : peak.row + reach_rows + 1, left : peak.cell + reach_cells + 1]
    # Smoothed over half of the filter's size that answered best: speckle must not break a large highlight into cells.
    size = (max(1, peak.highlight_rows // 2), max(3, peak.highlight_cells // 2))
    smooth = ndimage.uniform_filter(np.nan_to_num(patch, nan=seabed), size=size, mode="nearest")
    row, cell = peak.row - top, peak.cell - left
    near = (slice(max(0, row - 1), row + 2), slice(max(0, cell - 2), cell + 3))
    start = np.unravel_index(int(np.argmax(smooth[near])), smooth[near].shape)
    row, cell = near[0].start + int(start[0]), near[1].start + int(start[1])
    threshold = seabed + max(0.5 * (float(smooth[row, cell]) - seabed), deviation)
    labels, _ = ndimage.label(smooth >= threshold)
    if labels[row, cell] == 0:
        return (peak.row, peak.row + 1), (peak.cell, peak.cell + 1)
    mine = labels == labels[row, cell]
    in_rows, in_cells = np.flatnonzero(mine.any(axis=1)), np.flatnonzero(mine.any(axis=0))
    return (
        (top + int(in_rows[0]), top + int(in_rows[-1]) + 1),
        (left + int(in_cells[0]), left + int(in_cells[-1]) + 1),
    )


def _shadow(
    grid: LevelGrid, rows: tuple[int, int], cells: tuple[int, int], seabed: float, deviation: float
) -> tuple[int, bool, float, float, int]:
    """Return the shadow's length in cells, whether it is cut, its depth in deviations, its dark part, its rows."""
    middle = (rows[0] + rows[1]) // 2
    half = max(0, (rows[1] - rows[0]) // 4)  # the middle half: a shadow narrows at its ends
    behind = grid.level[max(0, middle - half) : middle + half + 1, cells[1] :]
    valid = np.isfinite(behind).all(axis=0)
    end = int(np.argmin(valid)) if not valid.all() else valid.size
    if end < 2:
        return 0, False, 0.0, 0.0, 0
    behind = behind[:, :end]
    profile = ndimage.uniform_filter1d(behind.mean(axis=0), size=3, mode="nearest")
    dark = profile < seabed - deviation
    first, last = _run(dark, round(_START_M / grid.cell_across_m), max(1, round(_GAP_M / grid.cell_across_m)))
    if last <= first:
        return 0, False, 0.0, 0.0, 0
    depth = (seabed - float(behind[:, first:last].mean())) / deviation
    filled = float((behind[:, first:last] < seabed - 0.5 * deviation).mean())
    return (
        last,
        last == end,
        depth,
        filled,
        _dark_rows(grid, middle, (cells[1] + first, cells[1] + last), seabed - deviation),
    )


def _run(dark: npt.NDArray[np.bool_], start_within: int, gap: int) -> tuple[int, int]:
    """First dark cell within reach of the highlight, and one past the last before a gap longer than allowed."""
    begin = np.flatnonzero(dark[: start_within + 1])
    if begin.size == 0:
        return 0, 0
    first = int(begin[0])
    where = np.flatnonzero(dark[first:]) + first
    breaks = np.flatnonzero(np.diff(where) > gap + 1)
    last = int(where[breaks[0]] if breaks.size else where[-1]) + 1
    return first, last


def _dark_rows(grid: LevelGrid, middle: int, cells: tuple[int, int], threshold: float) -> int:
    """Along-track extent, in rows, of the dark region that the shadow belongs to, looked at for 6 m to either side.

    A trawl scar, a trench or the lee of a sand wave is dark behind something bright too, but goes on along-track.
    """
    reach_rows = max(3, round(6.0 / grid.row_along_m))
    reach_cells = max(4, round(3.0 / grid.cell_across_m))
    top, left = max(0, middle - reach_rows), max(0, cells[0] - reach_cells)
    patch = grid.level[top : middle + reach_rows + 1, left : cells[1] + reach_cells]
    smooth = ndimage.uniform_filter(np.nan_to_num(patch, nan=0.0), size=(3, 5), mode="nearest")
    labels, _ = ndimage.label(smooth < threshold)
    own = labels[middle - top, cells[0] - left : cells[1] - left]
    touched = np.unique(own[own > 0])
    if touched.size == 0:
        return 0
    rows = np.flatnonzero(np.isin(labels, touched).any(axis=1))
    return int(rows[-1] - rows[0]) + 1


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
