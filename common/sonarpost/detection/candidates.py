"""Candidates: peaks of the matched filter, measured and scored by four further filters.

Each filter examines one property, so that their agreement is evidence:

* CFAR (constant false alarm rate): is the highlight brighter than a guarded ring of seabed around it?
* shadow: is the region behind the highlight dark, without echoes, and not much wider than the highlight?
* texture: does the texture differ from that of the seabed around? The Reed-Xiaoli anomaly detector (Reed and Yu, IEEE
  Trans. ASSP 38(10), 1990), with texture features in place of colour bands.
* geometry: do highlight and shadow have the proportions of a compact object?
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

Features = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

_MAX_PER_1000_PINGS: Final = 250
_MIN_RING_CELLS: Final = 30
_SHADOW_GAP_M: Final = 0.25
"""A gap of this length, caused by speckle, does not end a shadow."""
_SHADOW_START_M: Final = 0.5
"""A shadow begins within this distance of the outer edge of the highlight: the object rests on the seabed."""

_BLOCK_M: Final = 0.25
_WINDOW_BLOCKS: Final = 5
_GUARD_BLOCKS: Final = 8
_RING_BLOCKS: Final = 32
_RING_STEP_BLOCKS: Final = 3
_MIN_RING_WINDOWS: Final = 24
_NEAR_BLOCKS: Final = 1
_FEATURES: Final = 5
_RIDGE: Final = 0.05
"""Fraction of the variance of each feature over the image, added to the ring's covariance: a ring may be very even."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """Highlight and shadow of a candidate in grid cells, with the scores that follow from them.

    Attributes:
        row: Centre row of the highlight.
        cell: Centre cell of the highlight.
        rows: First and one-past-last row of the highlight.
        cells: First and one-past-last cell of the highlight.
        shadow_cells: Length of the shadow behind the outer edge of the highlight in cells; 0 without shadow.
        shadow_is_cut: True if the shadow extends to the end of the recording.
        matched: Matched-filter response in local noise units.
        cfar: Highlight above the median of the ring, in robust deviations of the ring.
        shadow: Depth of the shadow below the median of the ring, in the same unit, times its dark fraction.
        shadow_rows: Along-track extent of the dark region that contains the shadow, in rows; 0 without shadow.
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


@dataclass(frozen=True, slots=True)
class FilterScores:
    """The score of each filter at a place: 0 or more, greater for an object on the bottom.

    Attributes:
        matched: Highlight-and-shadow matched filter, in local noise units.
        cfar: Highlight above the ring of seabed around it, in robust deviations of the ring.
        shadow: Depth of the shadow below that ring, in the same unit, times its dark fraction.
        texture: Mahalanobis distance of the texture between highlight and shadow from that of the seabed around.
        geometry: 0 to 1, agreement with the proportions of a compact object, see `geometry_score`.
    """

    matched: float
    cfar: float
    shadow: float
    texture: float
    geometry: float


@dataclass(frozen=True, slots=True)
class Candidate:
    """A peak of the matched filter with its measurement and scores."""

    measurement: Measurement
    scores: FilterScores


def find_candidates(grid: LevelGrid, settings: DetectorSettings) -> list[Candidate]:
    """Return the candidates of one side of a survey, or of an image, in order of the matched-filter response."""
    limit = math.ceil(_MAX_PER_1000_PINGS * max(1.0, len(grid.level) / 1000))
    found = peaks(matched_response(grid, settings), grid, settings, settings.min_matched_response)[:limit]
    measurements = [m for m in (measure(grid, peak, settings) for peak in found) if m is not None]
    texture = TextureMap(grid)
    return [
        Candidate(
            m,
            FilterScores(
                matched=m.matched,
                cfar=m.cfar,
                shadow=m.shadow,
                texture=texture.anomaly(m.row, m.cells[1]),
                geometry=geometry_score(m, grid, settings),
            ),
        )
        for m in measurements
    ]


def geometry_score(measurement: Measurement, grid: LevelGrid, settings: DetectorSettings) -> float:
    """Return how well highlight and shadow have the proportions of a compact object, 0 to 1.

    The score is exp(-d). d is the sum of the natural logarithms by which these values exceed their limits: the longer
    side of the highlight (limit: the greatest length of a mine), its ratio to the shorter side (limit: 4), the
    along-track extent of the shadow (limits: half and twice the highlight's, at least 1 m). A missing shadow adds 1.
    """
    length_m = (measurement.rows[1] - measurement.rows[0]) * grid.row_along_m
    width_m = (measurement.cells[1] - measurement.cells[0]) * grid.cell_across_m
    longer, shorter = max(length_m, width_m), max(min(length_m, width_m), 1e-3)
    excess = max(0.0, math.log(longer / settings.mine_length_m[1])) + max(0.0, math.log(longer / shorter / 4.0))
    if measurement.shadow_rows == 0:
        return math.exp(-excess - 1.0)
    shadow_along_m = measurement.shadow_rows * grid.row_along_m
    excess += max(0.0, math.log(shadow_along_m / max(2.0 * length_m, 1.0)))
    excess += max(0.0, math.log(0.5 * length_m / shadow_along_m))
    return math.exp(-excess)


def measure(grid: LevelGrid, peak: Peak, settings: DetectorSettings) -> Measurement | None:
    """Measure highlight and shadow at a peak of the matched filter; None if too little seabed surrounds it."""
    ring = _ring_levels(grid, peak, settings)
    if ring.size < _MIN_RING_CELLS:
        return None
    seabed = float(np.median(ring))
    deviation = max(1.4826 * float(np.median(np.abs(ring - seabed))), 0.1)
    rows, cells = _highlight_extent(grid, peak, seabed, deviation)
    length, is_cut, depth, dark_fraction, shadow_rows = _shadow(grid, rows, cells, seabed, deviation)
    return Measurement(
        row=(rows[0] + rows[1] - 1) // 2,
        cell=(cells[0] + cells[1] - 1) // 2,
        rows=rows,
        cells=cells,
        shadow_cells=length,
        shadow_is_cut=is_cut,
        matched=peak.score,
        cfar=max(0.0, (_highlight_mean(grid.level, peak) - seabed) / deviation),
        shadow=max(0.0, depth) * dark_fraction,
        shadow_rows=shadow_rows,
    )


def _highlight_mean(level: FloatImage, peak: Peak) -> float:
    top = max(0, peak.row - peak.highlight_rows // 2)
    left = max(0, peak.cell - peak.highlight_cells // 2)
    return float(np.nanmean(level[top : top + peak.highlight_rows, left : left + peak.highlight_cells]))


def _ring_levels(grid: LevelGrid, peak: Peak, settings: DetectorSettings) -> FloatImage:
    """Return the levels of the seabed around the highlight, without a guard band and the strip of its shadow."""
    guard_rows = max(1, round(settings.guard_m / grid.row_along_m)) + peak.highlight_rows // 2
    guard_cells = max(1, round(settings.guard_m / grid.cell_across_m)) + peak.highlight_cells // 2
    far_rows = guard_rows + max(2, round(settings.ring_m / grid.row_along_m))
    far_cells = guard_cells + max(4, round(settings.ring_m / grid.cell_across_m))
    top, left = max(0, peak.row - far_rows), max(0, peak.cell - far_cells)
    patch = grid.level[top : peak.row + far_rows + 1, left : peak.cell + far_cells + 1]
    row = np.arange(top, top + patch.shape[0])[:, None] - peak.row
    cell = np.arange(left, left + patch.shape[1])[None, :] - peak.cell
    excluded = (np.abs(row) <= guard_rows) & (cell >= -guard_cells)  # guard band and everything behind it
    values: FloatImage = patch[~excluded & np.isfinite(patch)]
    return values


def _highlight_extent(
    grid: LevelGrid, peak: Peak, seabed: float, deviation: float
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the bounds of the connected cells around the peak that exceed half of its height above the seabed."""
    reach_rows = max(3, round(6.0 / grid.row_along_m))
    reach_cells = max(6, round(4.0 / grid.cell_across_m))
    top, left = max(0, peak.row - reach_rows), max(0, peak.cell - reach_cells)
    patch = grid.level[top : peak.row + reach_rows + 1, left : peak.cell + reach_cells + 1]
    # Smoothing over half the highlight size of the filter: speckle must not split a large highlight.
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
    region = labels == labels[row, cell]
    rows, cells = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    return (top + int(rows[0]), top + int(rows[-1]) + 1), (left + int(cells[0]), left + int(cells[-1]) + 1)


def _shadow(
    grid: LevelGrid, rows: tuple[int, int], cells: tuple[int, int], seabed: float, deviation: float
) -> tuple[int, bool, float, float, int]:
    """Return length in cells, whether it is cut, depth in deviations, dark fraction and rows of the shadow."""
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
    max_gap = max(1, round(_SHADOW_GAP_M / grid.cell_across_m))
    first, last = _dark_run(dark, round(_SHADOW_START_M / grid.cell_across_m), max_gap)
    if last <= first:
        return 0, False, 0.0, 0.0, 0
    depth = (seabed - float(behind[:, first:last].mean())) / deviation
    dark_fraction = float((behind[:, first:last] < seabed - 0.5 * deviation).mean())
    shadow_rows = _dark_rows(grid, middle, (cells[1] + first, cells[1] + last), seabed - deviation)
    return last, last == end, depth, dark_fraction, shadow_rows


def _dark_run(dark: Flags, start_within: int, max_gap: int) -> tuple[int, int]:
    """Return the first dark cell up to `start_within`, and one past the last before a gap above `max_gap`."""
    begin = np.flatnonzero(dark[: start_within + 1])
    if begin.size == 0:
        return 0, 0
    first = int(begin[0])
    places = np.flatnonzero(dark[first:]) + first
    breaks = np.flatnonzero(np.diff(places) > max_gap + 1)
    last = int(places[breaks[0]] if breaks.size else places[-1]) + 1
    return first, last


def _dark_rows(grid: LevelGrid, middle: int, cells: tuple[int, int], threshold: float) -> int:
    """Return the along-track extent, in rows, of the dark region of a shadow, within 6 m to either side.

    A trawl scar, a trench or the lee of a sand wave is also dark behind a bright edge, but it is long along-track.
    """
    reach_rows = max(3, round(6.0 / grid.row_along_m))
    reach_cells = max(4, round(3.0 / grid.cell_across_m))
    top, left = max(0, middle - reach_rows), max(0, cells[0] - reach_cells)
    patch = grid.level[top : middle + reach_rows + 1, left : cells[1] + reach_cells]
    smooth = ndimage.uniform_filter(np.nan_to_num(patch, nan=0.0), size=(3, 5), mode="nearest")
    labels, _ = ndimage.label(smooth < threshold)
    in_shadow = labels[middle - top, cells[0] - left : cells[1] - left]
    regions = np.unique(in_shadow[in_shadow > 0])
    if regions.size == 0:
        return 0
    rows = np.flatnonzero(np.isin(labels, regions).any(axis=1))
    return int(rows[-1] - rows[0]) + 1


class TextureMap:
    """Texture features of a level grid, for the anomaly score of single places.

    The grid is reduced to blocks of 0.25 m. A window of blocks has five features: mean, spread, mean step along-track,
    mean step across-track, and spread of the means of its blocks.
    """

    def __init__(self, grid: LevelGrid) -> None:
        self._rows = max(1, round(_BLOCK_M / grid.row_along_m))
        self._cells = max(1, round(_BLOCK_M / grid.cell_across_m))
        self._features = _window_features(grid.level, self._rows, self._cells)
        self._known: Flags = np.asarray(np.isfinite(self._features).all(axis=-1))
        known = self._features[self._known]
        self._variance = known.var(axis=0) if len(known) else np.ones(_FEATURES)

    def anomaly(self, row: int, cell: int) -> float:
        """Return the anomaly score at a cell of the grid; 0 if too little is known around it.

        The score is the Mahalanobis distance of the features from those of a ring around, divided by the square root
        of their number. It is about 1 on a seabed of uniform texture and above 3 for an anomaly.
        """
        top, left = row // self._rows, cell // self._cells
        local = self._features_near(top, left)
        ring = self._ring(top, left)
        if not len(local) or len(ring) < _MIN_RING_WINDOWS:
            return 0.0
        covariance = np.cov(ring, rowvar=False) + np.diag(_RIDGE * self._variance + 1e-6)
        offset = local - ring.mean(axis=0)
        squared = np.einsum("ij,ij->i", offset, np.linalg.solve(covariance, offset.T).T)
        return float(np.sqrt(max(float(squared.max()), 0.0) / _FEATURES))

    def _features_near(self, top: int, left: int) -> Features:
        rows = slice(max(0, top - _NEAR_BLOCKS), top + _NEAR_BLOCKS + 1)
        columns = slice(max(0, left - _NEAR_BLOCKS), left + _NEAR_BLOCKS + 1)
        near: Features = self._features[rows, columns][self._known[rows, columns]]
        return near

    def _ring(self, top: int, left: int) -> Features:
        first_row, first_column = max(0, top - _RING_BLOCKS), max(0, left - _RING_BLOCKS)
        rows = slice(first_row, top + _RING_BLOCKS + 1, _RING_STEP_BLOCKS)
        columns = slice(first_column, left + _RING_BLOCKS + 1, _RING_STEP_BLOCKS)
        usable = self._known[rows, columns].copy()
        far_rows = np.abs(first_row + _RING_STEP_BLOCKS * np.arange(usable.shape[0]) - top) > _GUARD_BLOCKS
        far_columns = np.abs(first_column + _RING_STEP_BLOCKS * np.arange(usable.shape[1]) - left) > _GUARD_BLOCKS
        usable &= far_rows[:, None] | far_columns[None, :]
        ring: Features = self._features[rows, columns][usable]
        return ring


def _window_features(level: FloatImage, rows: int, cells: int) -> Features:
    """Return the features of the window around each block, shape (rows, columns, 5), NaN where mostly unknown."""
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


def _block_sums(plane: FloatImage, rows: int, cells: int) -> Features:
    """Sum over blocks; an incomplete block at the end is padded with zeros."""
    padded = np.pad(plane, ((0, -plane.shape[0] % rows), (0, -plane.shape[1] % cells)))
    shape = (padded.shape[0] // rows, rows, padded.shape[1] // cells, cells)
    sums: Features = padded.reshape(shape).sum(axis=(1, 3), dtype=np.float64)
    return sums


def _window_sums(plane: Features) -> Features:
    sums: Features = ndimage.uniform_filter(plane, size=_WINDOW_BLOCKS, mode="constant") * _WINDOW_BLOCKS**2
    return sums
