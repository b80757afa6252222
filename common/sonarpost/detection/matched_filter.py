"""Matched filter: a highlight followed, away from the vehicle, by a shadow.

An object on the seabed returns more than the seabed around it and hides the seabed behind it. For each highlight size
and shadow length the filter computes the mean level of a rectangle and of the rectangle behind it, both in units of
the local noise. It combines them by the geometric mean, so neither a bright patch without shadow nor a dark patch
without highlight responds. Integral images make the cost of a rectangle independent of its size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sonarpost.detection.normalisation import LevelGrid
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import FloatImage

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MatchedResponse:
    """The best response of the filter at every cell.

    Attributes:
        score: Shape (pings, cells), float32, in noise units, 0 without response; the cell is the highlight's centre.
        highlight_index: Same shape, index of the highlight size with the best response.
    """

    score: FloatImage
    highlight_index: npt.NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class Peak:
    """A local maximum of the matched filter, in grid cells."""

    row: int
    cell: int
    score: float
    highlight_rows: int
    highlight_cells: int


def matched_response(grid: LevelGrid, settings: DetectorSettings) -> MatchedResponse:
    """Run the matched filter for every highlight size and shadow length of the settings."""
    sizes = [highlight_size_cells(grid, size) for size in settings.highlight_sizes_m]
    lengths = [max(2, round(length / grid.cell_across_m)) for length in settings.shadow_lengths_m]
    reach = (max(h for h, _ in sizes), max(w for _, w in sizes) + max(lengths) + 1)
    integral = IntegralImage(grid.level, reach)
    half = (
        max(4, round(settings.noise_window_m[0] / grid.row_along_m / 2)),
        max(4, round(settings.noise_window_m[1] / grid.cell_across_m / 2)),
    )
    shape = grid.level.shape
    best = np.zeros(shape, dtype=np.float32)
    best_size = np.zeros(shape, dtype=np.int8)
    for i, (rows, cells) in enumerate(sizes):
        along = (-(rows // 2), rows - rows // 2)
        bright = in_noise_units(integral.mean(along, (-(cells // 2), cells - cells // 2)), half)
        bright = np.maximum(np.nan_to_num(bright), 0.0)
        start = cells - cells // 2
        for length in lengths:
            dark = -in_noise_units(integral.mean(along, (start, start + length)), half)
            joint = np.sqrt(bright * np.maximum(np.nan_to_num(dark), 0.0))
            better = joint > best
            best[better] = joint[better]
            best_size[better] = i
    best[~np.isfinite(grid.level)] = 0.0
    return MatchedResponse(best, best_size)


def highlight_size_cells(grid: LevelGrid, size_m: tuple[float, float]) -> tuple[int, int]:
    """Return a highlight size in rows and cells, at least one row by two cells."""
    return max(1, round(size_m[0] / grid.row_along_m)), max(2, round(size_m[1] / grid.cell_across_m))


def peaks(response: MatchedResponse, grid: LevelGrid, settings: DetectorSettings, min_score: float) -> tuple[Peak, ...]:
    """Return the local maxima of at least `min_score`, strongest first, at least half a metre apart."""
    size = [2 * max(1, round(0.5 / metres)) + 1 for metres in (grid.row_along_m, grid.cell_across_m)]
    score = response.score
    local_maximum = ndimage.maximum_filter(score, size=size, mode="constant", cval=-np.inf)
    rows, cells = np.nonzero((score >= min_score) & (score > 0) & (score >= local_maximum))
    order = np.argsort(-score[rows, cells], kind="stable")
    found = []
    for row, cell in zip(rows[order].tolist(), cells[order].tolist(), strict=True):
        highlight = highlight_size_cells(grid, settings.highlight_sizes_m[response.highlight_index[row, cell]])
        found.append(Peak(row, cell, float(score[row, cell]), *highlight))
    return tuple(found)


class IntegralImage:
    """Means over rectangles placed relative to every pixel of an image. NaN pixels are ignored.

    Args:
        image: Shape (rows, columns), float; NaN marks holes.
        reach: Maximum distance of a rectangle's edge from its pixel, in rows and columns.
    """

    def __init__(self, image: FloatImage, reach: tuple[int, int]) -> None:
        self._shape = image.shape
        self._reach = reach
        valid = np.isfinite(image)
        self._sums = _cumulative_sums(np.where(valid, image, 0.0), reach)
        self._counts = _cumulative_sums(valid.astype(np.float64), reach)

    def mean(self, rows: tuple[int, int], columns: tuple[int, int], min_fraction: float = 0.5) -> FloatImage:
        """Return the mean over pixels [r + rows[0], r + rows[1]) x [c + columns[0], c + columns[1]) for every (r, c).

        Returns:
            float32, shape of the image; NaN where fewer than `min_fraction` of the rectangle's pixels are valid
            (holes and pixels beyond the border are not).

        Raises:
            ValueError: The rectangle is empty or exceeds the reach.
        """
        reach_rows, reach_columns = self._reach
        if not (-reach_rows <= rows[0] < rows[1] <= reach_rows + 1):
            raise ValueError(f"rows: got {rows}, expected a non-empty span within {reach_rows} of the pixel")
        if not (-reach_columns <= columns[0] < columns[1] <= reach_columns + 1):
            raise ValueError(f"columns: got {columns}, expected a non-empty span within {reach_columns} of the pixel")
        area = (rows[1] - rows[0]) * (columns[1] - columns[0])
        count = self._box_sums(self._counts, rows, columns)
        total = self._box_sums(self._sums, rows, columns)
        out = np.full(self._shape, np.nan, dtype=np.float32)
        np.divide(total, count, out=out, where=count >= max(1.0, min_fraction * area), casting="same_kind")
        return out

    def _box_sums(self, plane: FloatArray, rows: tuple[int, int], columns: tuple[int, int]) -> FloatArray:
        height, width = self._shape
        top, bottom = (self._reach[0] + r for r in rows)
        left, right = (self._reach[1] + c for c in columns)
        box: FloatArray = plane[bottom : bottom + height, right : right + width].copy()
        box -= plane[top : top + height, right : right + width]
        box -= plane[bottom : bottom + height, left : left + width]
        box += plane[top : top + height, left : left + width]
        return box


def _cumulative_sums(image: npt.NDArray[np.floating], reach: tuple[int, int]) -> FloatArray:
    """Return running sums with a zero row and column first, extended by `reach` so that boxes end at the border."""
    rows, columns = image.shape
    plane = np.zeros((rows + 1 + 2 * reach[0], columns + 1 + 2 * reach[1]))
    inner = plane[reach[0] + 1 : reach[0] + 1 + rows, reach[1] + 1 : reach[1] + 1 + columns]
    np.cumsum(image, axis=0, out=inner, dtype=np.float64)
    np.cumsum(inner, axis=1, out=inner)
    plane[reach[0] + 1 + rows :, :] = plane[reach[0] + rows, :]
    plane[:, reach[1] + 1 + columns :] = plane[:, reach[1] + columns, None]
    return plane


def in_noise_units(response: FloatImage, half: tuple[int, int]) -> FloatImage:
    """Express a filter response in standard deviations of its neighbourhood.

    The neighbourhood is `2 * half + 1` pixels a side, divided into five by five parts. Its level is the median of the
    means of the parts. Its noise is the 40th percentile of their deviations: with an order statistic, a wreck or the
    edge of another seabed in some of the parts is not counted as noise. Both are computed from every fourth row and
    pixel. The response is first limited to three robust deviations of the whole image. The noise is limited to half
    to three times that deviation, so that a very even patch does not have zero noise.

    Returns:
        float32, shape of the response; NaN where the response is NaN.
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
    level = _neighbourhood_percentile(mean, 50.0, 0.0)
    noise = np.clip(_neighbourhood_percentile(deviation, 40.0, spread), 0.5 * spread, 3.0 * spread)
    units: FloatImage = response - np.float32(centre) - _upsampled(level, step, response.shape)
    units /= _upsampled(noise, step, response.shape)
    return units


def _neighbourhood_percentile(parts: FloatImage, percentile: float, fallback: float) -> FloatImage:
    """Return the percentile over five by five parts without NaN; `fallback` where all are NaN."""
    padded = np.pad(parts, 2, constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, (5, 5)).reshape(*parts.shape, 25)
    ordered = np.sort(around, axis=-1)  # NaN sorts last
    count = np.isfinite(ordered).sum(axis=-1)
    index = np.round((np.maximum(count, 1) - 1) * percentile / 100.0).astype(np.int64)
    ranked = np.take_along_axis(ordered, index[..., None], axis=-1)[..., 0]
    return np.where(count > 0, ranked, np.float32(fallback)).astype(np.float32)


def _upsampled(parts: FloatImage, step: tuple[int, int], shape: tuple[int, ...]) -> FloatImage:
    """Repeat each part over `4 * step` pixels of an image of `shape`; the last part extends to the border."""
    rows = np.minimum(np.arange(shape[0]) // (4 * step[0]), parts.shape[0] - 1)
    columns = np.minimum(np.arange(shape[1]) // (4 * step[1]), parts.shape[1] - 1)
    repeated: FloatImage = parts[rows][:, columns]
    return repeated
