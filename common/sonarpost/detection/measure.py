"""What one candidate looks like up close: highlight, shadow, the seabed around, and two filters of their own.

The matched filter says where to look; these two look again, each at one property alone, so that their agreement means
something: the constant-false-alarm test compares the highlight with a guarded ring of seabed, the shadow test asks
whether the dark behind it is dark, begins at the highlight, is not riddled with echoes, and goes on along-track no
farther than the highlight suggests.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sonarpost.detection.highlight_shadow import Peak
from sonarpost.detection.preprocess import LevelGrid
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import FloatImage

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
