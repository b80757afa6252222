"""The matched filter: a highlight followed, away from the vehicle, by a shadow.

An object that stands on the seabed returns more than the seabed around it and hides the seabed behind it. For each
highlight size and shadow length the filter takes the mean level of a rectangle and of the rectangle behind it, both
in units of their own local noise, and joins them by the geometric mean, so that neither a bright patch without shadow
nor a dark patch without highlight responds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarpost.detection.integral_image import IntegralImage, in_noise_units
from sonarpost.detection.preprocess import LevelGrid
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import FloatImage


@dataclass(frozen=True, slots=True)
class MatchedResponse:
    """The filter's best answer at every cell.

    Attributes:
        score: Shape (pings, cells), float32, noise units, 0 where there is no response; the cell is the highlight's
            centre.
        highlight_index: Same shape, which of the settings' highlight sizes answered best.
        shadow_index: Same shape, which of the settings' shadow lengths did.
    """

    score: FloatImage
    highlight_index: npt.NDArray[np.int8]
    shadow_index: npt.NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class Peak:
    """A local maximum of the matched filter, in grid cells."""

    row: int
    cell: int
    score: float
    highlight_rows: int
    highlight_cells: int
    shadow_cells: int


def matched_response(grid: LevelGrid, settings: DetectorSettings) -> MatchedResponse:
    """Run the matched filter at every highlight size and shadow length of the settings."""
    sizes = [highlight_size_cells(grid, size) for size in settings.highlight_sizes_m]
    lengths = [max(2, round(length / grid.cell_across_m)) for length in settings.shadow_lengths_m]
    reach = (max(h for h, _ in sizes), max(w for _, w in sizes) + max(lengths) + 1)
    boxes = IntegralImage(grid.level, reach)
    half = (
        max(4, round(settings.noise_window_m[0] / grid.row_along_m / 2)),
        max(4, round(settings.noise_window_m[1] / grid.cell_across_m / 2)),
    )
    shape = grid.level.shape
    best = np.zeros(shape, dtype=np.float32)
    which_size = np.zeros(shape, dtype=np.int8)
    which_length = np.zeros(shape, dtype=np.int8)
    for i, (rows, cells) in enumerate(sizes):
        along = (-(rows // 2), rows - rows // 2)
        bright = in_noise_units(boxes.mean(along, (-(cells // 2), cells - cells // 2)), half)
        bright = np.maximum(np.nan_to_num(bright), 0.0)
        start = cells - cells // 2
        for j, length in enumerate(lengths):
            dark = -in_noise_units(boxes.mean(along, (start, start + length)), half)
            joint = np.sqrt(bright * np.maximum(np.nan_to_num(dark), 0.0))
            better = joint > best
            best[better] = joint[better]
            which_size[better] = i
            which_length[better] = j
    best[~np.isfinite(grid.level)] = 0.0
    return MatchedResponse(best, which_size, which_length)


def highlight_size_cells(grid: LevelGrid, size_m: tuple[float, float]) -> tuple[int, int]:
    """Return a highlight's size in rows and cells, at least one row by two cells."""
    return max(1, round(size_m[0] / grid.row_along_m)), max(2, round(size_m[1] / grid.cell_across_m))


def peaks(response: MatchedResponse, grid: LevelGrid, settings: DetectorSettings, least: float) -> tuple[Peak, ...]:
    """Return the local maxima of at least `least`, strongest first, no two within half a metre of each other."""
    reach = (max(1, round(0.5 / grid.row_along_m)), max(1, round(0.5 / grid.cell_across_m)))
    score = response.score
    is_peak = (score >= least) & (score > 0) & (score >= _box_maximum(score, reach))
    rows, cells = np.nonzero(is_peak)
    order = np.argsort(-score[rows, cells], kind="stable")
    found = []
    for row, cell in zip(rows[order].tolist(), cells[order].tolist(), strict=True):
        size = highlight_size_cells(grid, settings.highlight_sizes_m[response.highlight_index[row, cell]])
        length_m = settings.shadow_lengths_m[response.shadow_index[row, cell]]
        found.append(
            Peak(row, cell, float(score[row, cell]), size[0], size[1], max(2, round(length_m / grid.cell_across_m)))
        )
    return tuple(found)


def _box_maximum(image: FloatImage, reach: tuple[int, int]) -> FloatImage:
    out = image
    for axis in (0, 1):
        span = reach[axis]
        padding = [(span, span) if a == axis else (0, 0) for a in (0, 1)]
        padded = np.pad(out, padding, constant_values=-np.inf)
        size = out.shape[axis]
        # Doubling: after each step every element is the maximum over twice the window.
        window, width = padded, 1
        target = 2 * span + 1
        while width < target:
            shift = min(width, target - width)
            first = np.take(window, range(window.shape[axis] - shift), axis=axis)
            second = np.take(window, range(shift, window.shape[axis]), axis=axis)
            window, width = np.maximum(first, second), width + shift
        out = np.take(window, range(size), axis=axis)
    return out
