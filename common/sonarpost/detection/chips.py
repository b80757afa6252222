"""Chips: the surroundings of a candidate, projected to the seabed, as input of the classifier.

The levels of one side are resampled to pixels of 0.125 m of seabed, so that an object has the same size in every
sonar, at every range and at every speed. Slant range becomes ground range over a flat seabed, with the range of the
first bottom return as altitude. Each pixel is the mean of the levels in its area.

A chip has two planes. The fine plane (5 m x 7.5 m) shows highlight and shadow; its pixels are levels. The coarse plane
(15 m x 22 m, pixels of 0.5 m) shows the seabed around them: mean and standard deviation of the levels. Range increases
with the column on both sides of the vehicle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.detection.matched_filter import Peak
from sonarpost.detection.normalisation import LevelGrid
from sonarpost.errors import SurveyFileError
from sonarpost.limits import limit
from sonarpost.sonar.survey import FloatImage

Chips = npt.NDArray[np.float32]
Indices = npt.NDArray[np.int64]

PIXEL_M: Final = 0.125
MAX_PIXELS: Final = limit(
    1 << 25, "pixels", "claims", "recording", "recording", "side of a strip, at 0.125 m", "the recording is refused"
)
FINE_SHAPE: Final = (40, 60)
"""Rows along-track and columns across-track of the fine plane."""
FINE_CENTRE: Final = (20, 16)
"""Pixel of the candidate in the fine plane: most of the plane lies behind it, where its shadow is."""
COARSE_SHAPE: Final = (30, 44)
COARSE_CENTRE: Final = (15, 14)
COARSE_STEP: Final = 4
"""Fine pixels along each side of a coarse pixel."""
WINDOW_SHAPE: Final = (COARSE_SHAPE[0] * COARSE_STEP, COARSE_SHAPE[1] * COARSE_STEP)
"""Fine pixels that a chip depends on."""
WINDOW_CENTRE: Final = (COARSE_CENTRE[0] * COARSE_STEP + 2, COARSE_CENTRE[1] * COARSE_STEP + 2)
FINE_PLANES: Final = 2
COARSE_PLANES: Final = 3
GEOMETRY_VALUES: Final = 5


@dataclass(frozen=True, slots=True)
class GroundPlane:
    """One side of a survey, or an image, on the seabed.

    Attributes:
        level: Shape (rows, columns), float32, mean level of each pixel; 0 where unknown.
        known: Same shape, float32, share of the pixel's area with a known level, 0 to 1.
        altitude_m: Altitude at each row of the level grid, shape (pings,); 0 where slant range is ground range.
        row_along_m: Distance between two rows of the level grid.
        cell_across_m: Slant range of one of its cells.
    """

    level: FloatImage
    known: FloatImage
    altitude_m: npt.NDArray[np.float64]
    row_along_m: float
    cell_across_m: float

    def pixel_of(self, row: int, cell: int) -> tuple[int, int]:
        """Return the pixel at the centre of a cell of the level grid."""
        slant_m = (cell + 0.5) * self.cell_across_m
        ground_m = max(slant_m**2 - float(self.altitude_m[row]) ** 2, 0.0) ** 0.5
        return int((row + 0.5) * self.row_along_m / PIXEL_M), int(ground_m / PIXEL_M)


@dataclass(frozen=True, slots=True)
class ChipBatch:
    """Inputs of the classifier for several candidates.

    Attributes:
        fine: Shape (candidates, 40, 60, 2), float32: level / 2 (0 where unknown), known share.
        coarse: Shape (candidates, 30, 44, 3), float32: mean level / 2, standard deviation / 2, known share.
        geometry: Shape (candidates, 5), float32, see `geometry_values`.
    """

    fine: Chips
    coarse: Chips
    geometry: Chips

    def __len__(self) -> int:
        return len(self.fine)

    def mirrored(self) -> ChipBatch:
        """Return the chips mirrored along-track, which show an equally likely scene."""
        return ChipBatch(self.fine[:, ::-1], self.coarse[:, ::-1], self.geometry)

    def selected(self, rows: Indices) -> ChipBatch:
        """Return the chips at these indices."""
        return ChipBatch(self.fine[rows], self.coarse[rows], self.geometry[rows])


def ground_plane(grid: LevelGrid) -> GroundPlane:
    """Project one side of a survey to the seabed. A grid without first returns (an image) is resampled only.

    Raises:
        SurveyFileError: The seabed has more than `MAX_PIXELS`.
    """
    pings, cells = grid.level.shape
    altitude_m = np.minimum(grid.first_return_cell, cells) * grid.cell_across_m
    finite = np.isfinite(grid.level)
    value, weight = np.where(finite, grid.level, np.float32(0.0)), finite.astype(np.float32)
    furthest_m = max(float((cells * grid.cell_across_m) ** 2 - np.min(altitude_m) ** 2), 0.0) ** 0.5
    columns, rows = max(1, int(furthest_m / PIXEL_M)), max(1, int(pings * grid.row_along_m / PIXEL_M))
    if max(pings, rows) * columns > MAX_PIXELS:
        raise SurveyFileError("seabed of a strip", "pixels", f"{rows} × {columns}", f"at most {MAX_PIXELS}")
    edges_m = np.arange(columns + 1) * PIXEL_M
    slant_cells = np.sqrt(edges_m[None, :] ** 2 + altitude_m[:, None] ** 2) / grid.cell_across_m
    value, weight = (_binned_across(plane, slant_cells) for plane in (value, weight))
    edges = np.minimum(np.arange(rows + 1) * (PIXEL_M / grid.row_along_m), pings)
    value, weight = (_binned_along(plane, edges) for plane in (value, weight))
    # A column covers a slant interval whose length depends on range; its share of known cells does not.
    widths = _binned_along(np.diff(slant_cells, axis=1).astype(np.float32), edges)
    level = np.divide(value, weight, out=np.zeros_like(value), where=weight > 1e-6)
    known = np.clip(weight / np.maximum(widths, 1e-6), 0.0, 1.0)
    return GroundPlane(
        level.astype(np.float32), known.astype(np.float32), altitude_m, grid.row_along_m, grid.cell_across_m
    )


def _binned_across(plane: FloatImage, edges: npt.NDArray[np.float64]) -> FloatImage:
    """Integrate each row between consecutive edges, which are cell coordinates of shape (rows, columns + 1)."""
    sums = np.zeros((plane.shape[0], plane.shape[1] + 2), dtype=np.float64)
    np.cumsum(plane, axis=1, out=sums[:, 1:-1])
    sums[:, -1] = sums[:, -2]
    at = np.minimum(edges, plane.shape[1])
    lower = at.astype(np.int64)
    below = np.take_along_axis(sums, lower, axis=1)
    above = np.take_along_axis(sums, lower + 1, axis=1)
    integral = below + (at - lower) * (above - below)
    return np.asarray(np.diff(integral, axis=1), dtype=np.float32)


def _binned_along(plane: FloatImage, edges: npt.NDArray[np.float64]) -> FloatImage:
    """Integrate each column between consecutive edges, which are row coordinates of shape (rows + 1,)."""
    sums = np.zeros((plane.shape[0] + 2, plane.shape[1]), dtype=np.float64)
    np.cumsum(plane, axis=0, out=sums[1:-1])
    sums[-1] = sums[-2]
    lower = edges.astype(np.int64)
    share = (edges - lower)[:, None]
    integral = sums[lower] * (1 - share) + sums[lower + 1] * share
    return np.asarray(np.diff(integral, axis=0), dtype=np.float32)


class ChipCutter:
    """Cuts chips out of one side of a survey, or of an image."""

    def __init__(self, grid: LevelGrid) -> None:
        self.plane = ground_plane(grid)
        margin = max(WINDOW_SHAPE)
        self._margin = margin
        level = np.pad(self.plane.level, margin)
        known = np.pad(self.plane.known, margin)
        self._fine = np.stack([level * np.float32(0.5), known], axis=-1)
        self._coarse = coarse_planes(level, known)

    def chips(self, peaks: Sequence[Peak]) -> ChipBatch:
        """Return the chips of candidates; what lies beyond the survey is unknown."""
        pixels = np.array([self.plane.pixel_of(p.row, p.cell) for p in peaks], dtype=np.int64).reshape(-1, 2)
        at = pixels + self._margin
        fine = self._fine[_windows(at, FINE_SHAPE, FINE_CENTRE, 1)]
        coarse = self._coarse[_windows(at, COARSE_SHAPE, COARSE_CENTRE, COARSE_STEP)]
        return ChipBatch(fine, coarse, geometry_values(self.plane, peaks))


def _windows(centres: Indices, shape: tuple[int, int], centre: tuple[int, int], step: int) -> tuple[Indices, Indices]:
    rows = centres[:, 0, None] + (np.arange(shape[0]) - centre[0]) * step
    columns = centres[:, 1, None] + (np.arange(shape[1]) - centre[1]) * step
    return rows[:, :, None], columns[:, None, :]


def coarse_planes(level: FloatImage, known: FloatImage) -> FloatImage:
    """Return the coarse pixel around every fine pixel: mean / 2, standard deviation / 2 and known share.

    Args:
        level: Shape (rows, columns), levels of the fine pixels.
        known: Same shape, known share.

    Returns:
        Shape (rows, columns, 3), float32. The pixel at (r, c) covers fine pixels r - 2 to r + 1 and c - 2 to c + 1.
    """
    weight = _box_sum(known)
    mean = np.divide(_box_sum(level * known), weight, out=np.zeros_like(weight), where=weight > 1e-3)
    square = np.divide(_box_sum(level * level * known), weight, out=np.zeros_like(weight), where=weight > 1e-3)
    deviation = np.sqrt(np.maximum(square - mean * mean, 0.0))
    planes = np.stack([mean * 0.5, deviation * 0.5, weight / COARSE_STEP**2], axis=-1)
    return planes.astype(np.float32)


def _box_sum(plane: FloatImage) -> FloatImage:
    """Return the sum over 4 x 4 pixels from (r - 2, c - 2) on, with zeros beyond the border."""
    before, after = COARSE_STEP // 2, COARSE_STEP - COARSE_STEP // 2 - 1
    padded = np.pad(plane.astype(np.float32), ((before, after), (before, after)))
    rows, columns = plane.shape
    along = np.sum([padded[k : k + rows] for k in range(COARSE_STEP)], axis=0)
    return np.asarray(np.sum([along[:, k : k + columns] for k in range(COARSE_STEP)], axis=0), dtype=np.float32)


def geometry_values(plane: GroundPlane, peaks: Sequence[Peak]) -> Chips:
    """Return range, altitude and resolution of candidates, scaled to about 0 to 1, shape (candidates, 5).

    The values are: whether the altitude is known, sine of the grazing angle, ground range / 50 m, altitude / 10 m,
    distance between pings / 0.25 m. The first four are 0 if the altitude is unknown, as in an image.
    """
    values = np.zeros((len(peaks), GEOMETRY_VALUES), dtype=np.float32)
    for index, peak in enumerate(peaks):
        altitude_m = float(plane.altitude_m[peak.row])
        slant_m = (peak.cell + 0.5) * plane.cell_across_m
        if altitude_m > 0:
            ground_m = max(slant_m**2 - altitude_m**2, 0.0) ** 0.5
            values[index, :4] = (1.0, altitude_m / max(slant_m, altitude_m), ground_m / 50.0, altitude_m / 10.0)
        values[index, 4] = min(plane.row_along_m / 0.25, 4.0)
    return values
