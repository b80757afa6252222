"""Large structures: wrecks, walls and outcrops, found by their shadow or by their echo in the water column.

The filters for compact objects compare a place with the seabed around it, but a wreck fills that neighbourhood. Its
shadow is detectable: metres wide and without echo. Shadows of ripples, stones and rock are lit from other sides. Each
connected dark region of at least 7 m² whose near edge is bright for a good part of its length is a structure.

Outcrops of rock cast such shadows in large numbers: each distant region of comparable size reduces the confidence.
A structure that rises above the vehicle's first bottom return, such as a wall or a wreck near the track, echoes in the
water column, where the filters do not search. A connected region of such echoes of at least 5 m² is a structure.

The confidence of a structure is not a probability: 1.0 is a shadow of 30 m² with a bright edge along half of its
length, or 20 m² of echoes in the water, and it increases with the area.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sonarpost.detection.candidates import FilterScores, Measurement
from sonarpost.detection.normalisation import LevelGrid

_SMOOTH_M: Final = 0.4
_DARK_LEVEL: Final = -1.3
_BRIGHT_LEVEL: Final = 0.6
_MIN_AREA_M2: Final = 7.0
_USUAL_AREA_M2: Final = 30.0
"""Area of the shadow at which the confidence is 1.0."""
_EDGE_M: Final = 1.2
"""The highlight of a structure lies within this distance before its shadow."""
_EDGE_SHARE: Final = 0.5
_MIN_EDGE_SHARE: Final = 0.25
_WATER_ECHO: Final = 0.2
"""Echo in the water, as a share of the median echo of the seabed, that a structure exceeds."""
_MIN_WATER_AREA_M2: Final = 5.0
_USUAL_WATER_AREA_M2: Final = 20.0
_GAP_M: Final = (1.5, 2.0)
_MAX_LENGTH_M: Final = 150.0
_NEAR_M: Final = 2.0
_SEPARATE_M: Final = 20.0


@dataclass(frozen=True, slots=True)
class Structure:
    """A structure.

    Attributes:
        confidence: 0 to 2, see the module.
        measurement: Its highlight and shadow.
        area_m2: Area of its shadow in slant range.
    """

    confidence: float
    measurement: Measurement
    area_m2: float


def find_structures(grid: LevelGrid) -> list[Structure]:
    """Return the structures of one side, most confident first."""
    size = (max(1, round(_SMOOTH_M / grid.row_along_m)), max(1, round(_SMOOTH_M / grid.cell_across_m)))
    known = np.isfinite(grid.level)
    level = ndimage.uniform_filter(np.where(known, grid.level, 0.0).astype(np.float32), size=size, mode="nearest")
    found = []
    for box, dark, area_m2 in _regions(known & (level < _DARK_LEVEL), grid, _MIN_AREA_M2):
        if (box[0].stop - box[0].start) * grid.row_along_m > _MAX_LENGTH_M:
            continue
        structure = _structure(grid, level, dark, (box[0].start, box[1].start), area_m2)
        if structure is not None:
            found.append(structure)
    weighted = [replace(s, confidence=s.confidence / (1 + _comparable(s, found, grid))) for s in found]
    return sorted(weighted, key=lambda s: -s.confidence)


def find_water_structures(grid: LevelGrid) -> list[Structure]:
    """Return the structures in the water column of one side, most confident first."""
    if grid.water_echo is None:
        return []
    size = (max(1, round(1.0 / grid.row_along_m)), max(1, round(_SMOOTH_M / grid.cell_across_m)))
    echo = ndimage.uniform_filter(grid.water_echo, size=size, mode="constant")
    gap = (max(1, round(_GAP_M[0] / grid.row_along_m)), max(1, round(_GAP_M[1] / grid.cell_across_m)))
    # Posts and beams echo as separate dashes of one structure.
    closed = ndimage.binary_closing(echo > _WATER_ECHO, structure=np.ones(gap))
    found = []
    for box, inside, area_m2 in _regions(closed, grid, _MIN_WATER_AREA_M2):
        row, cell = (int(v) for v in np.unravel_index(np.argmax(np.where(inside, echo[box], -np.inf)), inside.shape))
        strength = float(echo[box][inside].mean()) / _WATER_ECHO
        measurement = Measurement(
            row=box[0].start + row,
            cell=box[1].start + cell,
            rows=(box[0].start, box[0].stop),
            cells=(box[1].start, box[1].stop),
            shadow_cells=0,
            shadow_is_cut=False,
            scores=FilterScores(0.0, strength, 0.0),
        )
        found.append(Structure(2.0 * area_m2 / (area_m2 + _USUAL_WATER_AREA_M2), measurement, area_m2))
    return sorted(found, key=lambda s: -s.confidence)


def _regions(
    mask: npt.NDArray[np.bool_], grid: LevelGrid, min_area_m2: float
) -> Iterator[tuple[tuple[slice, slice], npt.NDArray[np.bool_], float]]:
    """Yield bounding box, cells in it, and area in square metres of each connected region that is large enough."""
    labels, _ = ndimage.label(mask)
    areas_m2 = np.bincount(labels.ravel()) * (grid.row_along_m * grid.cell_across_m)
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        if box is not None and areas_m2[number] >= min_area_m2:
            yield box, labels[box] == number, float(areas_m2[number])


def is_part_of_structure(contact: Measurement, structure: Measurement, grid: LevelGrid) -> bool:
    """Return whether the centre of a contact lies in or within 2 m of a structure's highlight or shadow."""
    rows, cells = _NEAR_M / grid.row_along_m, _NEAR_M / grid.cell_across_m
    along = structure.rows[0] - rows <= contact.row < structure.rows[1] + rows
    return along and structure.cells[0] - cells <= contact.cell < structure.cells[1] + structure.shadow_cells + cells


def _comparable(one: Structure, found: list[Structure], grid: LevelGrid) -> int:
    """Return how many others of at least half the area are too far away to be parts of the same structure."""
    count = 0
    for other in found:
        along_m = abs(other.measurement.row - one.measurement.row) * grid.row_along_m
        across_m = abs(other.measurement.cell - one.measurement.cell) * grid.cell_across_m
        count += other.area_m2 >= one.area_m2 / 2 and max(along_m, across_m) > _SEPARATE_M
    return count


def _structure(
    grid: LevelGrid,
    level: npt.NDArray[np.float32],
    dark: npt.NDArray[np.bool_],
    corner: tuple[int, int],
    area_m2: float,
) -> Structure | None:
    """Return the structure that casts a shadow; None if less than a quarter of its near edge is bright.

    Args:
        grid: One side of a survey.
        level: Its smoothed levels.
        dark: The cells of the shadow within its bounding box.
        corner: First row and cell of that box.
        area_m2: Area of the shadow.
    """
    reach = max(2, round(_EDGE_M / grid.cell_across_m))
    rows = np.flatnonzero(dark.any(axis=1))
    near = corner[1] + dark[rows].argmax(axis=1)
    columns = near[:, None] - 1 - np.arange(reach)[None, :]
    strip = np.where(columns >= 0, level[corner[0] + rows[:, None], np.maximum(columns, 0)], -np.inf)
    bright = strip > _BRIGHT_LEVEL
    lit = bright.any(axis=1)
    share = float(lit.mean())
    if share < _MIN_EDGE_SHARE:
        return None
    lit_rows = rows[lit]
    middle = int(np.flatnonzero(lit)[np.argmax(strip[lit].max(axis=1))])
    cells = bright[middle].nonzero()[0]
    last, first = int(near[middle]) - int(cells[0]), int(near[middle]) - 1 - int(cells[-1])
    shadow_end = corner[1] + int(np.flatnonzero(dark[rows[middle]])[-1]) + 1
    confidence = 2.0 * area_m2 / (area_m2 + _USUAL_AREA_M2) * min(1.0, share / _EDGE_SHARE)
    patch = grid.level[corner[0] : corner[0] + dark.shape[0], corner[1] : corner[1] + dark.shape[1]]
    measurement = Measurement(
        row=corner[0] + int(rows[middle]),
        cell=(first + last) // 2,
        rows=(corner[0] + int(lit_rows[0]), corner[0] + int(lit_rows[-1]) + 1),
        cells=(max(first, 0), last),
        shadow_cells=shadow_end - last,
        shadow_is_cut=shadow_end >= grid.level.shape[1],
        scores=FilterScores(0.0, float(strip[lit].max(axis=1).mean()), float(-np.nanmean(patch[dark]))),
    )
    return Structure(confidence, measurement, area_m2)
