"""The matched filter: a highlight followed, away from the vehicle, by a shadow.

An object that stands on the seabed returns more than the seabed around it and hides the seabed behind it. For each
highlight size and shadow length the filter takes the mean level of a rectangle and of the rectangle behind it, both
in units of their own local noise, and joins them by the geometric mean, so that neither a bright patch without shadow
nor a dark patch without highlight responds.


## sonarpost.detection.matched_filter
Box sums over a picture with holes, by integral images: every box costs the same, whatever its size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarpost.detection.normalisation import LevelGrid
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


Plane = npt.NDArray[np.float64]


class IntegralImage:
    """Means over rectangles placed relative to every pixel of a picture; NaN pixels do not count.

    Args:
        image: Shape (rows, columns), float; NaN marks holes.
        reach: The farthest that a rectangle may extend from its pixel, in pixels, along rows and columns.
    """

    def __init__(self, image: FloatImage, reach: tuple[int, int]) -> None:
        self._shape = image.shape
        self._reach = reach
        valid = np.isfinite(image)
        self._sums = _integral(np.where(valid, image, 0.0), reach)
        self._counts = _integral(valid.astype(np.float64), reach)

    def mean(self, rows: tuple[int, int], columns: tuple[int, int], least_fraction: float = 0.5) -> FloatImage:
        """Return the mean over pixels [r + rows[0], r + rows[1]) x [c + columns[0], c + columns[1]) for every (r, c).

        Returns:
            float32, shape of the picture; NaN where fewer than `least_fraction` of the rectangle's pixels count
            (holes and pixels beyond the border do not).

        Raises:
            ValueError: When the rectangle is empty or reaches farther than allowed.
        """
        reach_rows, reach_columns = self._reach
        if not (-reach_rows <= rows[0] < rows[1] <= reach_rows + 1):
            raise ValueError(f"rows: got {rows}, expected a non-empty span within {reach_rows} of the pixel")
        if not (-reach_columns <= columns[0] < columns[1] <= reach_columns + 1):
            raise ValueError(f"columns: got {columns}, expected a non-empty span within {reach_columns} of the pixel")
        area = (rows[1] - rows[0]) * (columns[1] - columns[0])
        count = self._box(self._counts, rows, columns)
        total = self._box(self._sums, rows, columns)
        out = np.full(self._shape, np.nan, dtype=np.float32)
        enough = count >= max(1.0, least_fraction * area)
        np.divide(total, count, out=out, where=enough, casting="same_kind")
        return out

    def _box(self, plane: Plane, rows: tuple[int, int], columns: tuple[int, int]) -> Plane:
        height, width = self._shape
        top, bottom = (self._reach[0] + r for r in rows)
        left, right = (self._reach[1] + c for c in columns)
        box: Plane = plane[bottom : bottom + height, right : right + width].copy()
        box -= plane[top : top + height, right : right + width]
        box -= plane[bottom : bottom + height, left : left + width]
        box += plane[top : top + height, left : left + width]
        return box


def _integral(image: npt.NDArray[np.floating], reach: tuple[int, int]) -> Plane:
    """Running sums with a zero row and column first, extended on all sides so that boxes clip at the border."""
    rows, columns = image.shape
    plane = np.zeros((rows + 1 + 2 * reach[0], columns + 1 + 2 * reach[1]))
    inner = plane[reach[0] + 1 : reach[0] + 1 + rows, reach[1] + 1 : reach[1] + 1 + columns]
    np.cumsum(image, axis=0, out=inner, dtype=np.float64)
    np.cumsum(inner, axis=1, out=inner)
    plane[reach[0] + 1 + rows :, :] = plane[reach[0] + rows, :]
    plane[:, reach[1] + 1 + columns :] = plane[:, reach[1] + columns, None]
    return plane


def in_noise_units(response: FloatImage, half: tuple[int, int]) -> FloatImage:
    """Express a filter's response in standard deviations of its own neighbourhood.

    The neighbourhood is `2 * half + 1` pixels a side, cut into five by five parts. Its level is the median of the
    parts' means, its noise the 40th percentile of their deviations (an order statistic, so that a wreck or the edge
    of another seabed, which fills some of the parts, does not pass for noise). Both change slowly and are taken from
    every fourth row and pixel. Responses are first limited to three robust deviations of the whole picture, and the
    noise is held between half and three times that deviation: a mirror-flat patch is not infinitely quiet.

    Returns:
        float32, shape of the response; NaN where the response is.
    """
    coarse = response[::4, ::4]
    finite = coarse[np.isfinite(coarse)]
    if finite.size == 0:
        return np.full(response.shape, np.nan, dtype=np.float32)
    centre = float(np.median(finite))
    spread = max(1.4826 * float(np.median(np.abs(finite - centre))), 1e-3)
    limited = np.clip(coarse - np.float32(centre), -3 * spread, 3 * spread)
    reach = (max(1, half[0] // 20), max(1, half[1] // 20))
    rows, columns = (-reach[0], reach[0] + 1), (-reach[1], reach[1] + 1)
    step = (2 * reach[0] + 1, 2 * reach[1] + 1)
    picked = (slice(reach[0], None, step[0]), slice(reach[1], None, step[1]))
    if limited[picked].size == 0:
        picked = (slice(0, None, step[0]), slice(0, None, step[1]))
    mean = IntegralImage(limited, reach).mean(rows, columns, 0.3)[picked]
    square = IntegralImage(limited * limited, reach).mean(rows, columns, 0.3)[picked]
    deviation = np.sqrt(np.maximum(square - mean * mean, 0.0))
    level = _rank(mean, 50.0, 0.0)
    noise = np.clip(_rank(deviation, 40.0, spread), 0.5 * spread, 3.0 * spread)
    units: FloatImage = response - np.float32(centre) - _fine(level, step, response.shape)
    units /= _fine(noise, step, response.shape)
    return units


def _rank(parts: FloatImage, percentile: float, fallback: float) -> FloatImage:
    """Percentile over five by five parts, those that are NaN left out; `fallback` where all are."""
    padded = np.pad(parts, 2, constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, (5, 5)).reshape(*parts.shape, 25)
    ordered = np.sort(around, axis=-1)  # NaN sorts last
    count = np.isfinite(ordered).sum(axis=-1)
    index = np.round((np.maximum(count, 1) - 1) * percentile / 100.0).astype(np.int64)
    ranked = np.take_along_axis(ordered, index[..., None], axis=-1)[..., 0]
    return np.where(count > 0, ranked, np.float32(fallback)).astype(np.float32)


def _fine(parts: FloatImage, step: tuple[int, int], shape: tuple[int, ...]) -> FloatImage:
    """Repeat values of parts of `4 * step` pixels back to a picture of `shape`; the last part runs to the border."""
    rows = np.minimum(np.arange(shape[0]) // (4 * step[0]), parts.shape[0] - 1)
    columns = np.minimum(np.arange(shape[1]) // (4 * step[1]), parts.shape[1] - 1)
    fine: FloatImage = parts[rows][:, columns]
    return fine
