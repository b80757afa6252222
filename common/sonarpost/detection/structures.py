"""Wrecks, walls and other structures that no mine's filter spans: a large deep shadow with a highlight before it.

The filters for compact objects compare a place with the seabed around, and a wreck is its own surroundings. What it
cannot hide is its shadow: metres wide and without echo, where ripples, stones and rock of the seabed leave the
shadow's floor lit from other sides. Each connected dark region of at least `_LEAST_AREA_M2` is taken whose near edge
is bright for a good part of its length. Outcrops of rock cast such shadows too, but by the dozen: every other one of
comparable size that is not near takes its share of the confidence. The simulator has no wrecks, so this confidence is
not a calibrated one: 1.0 stands for the least area with a bright edge along half of it, and it rises with both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sonarpost.detection.candidates import Candidate, FilterScores, Measured
from sonarpost.detection.normalisation import LevelGrid

_SMOOTH_M: Final = 0.4
_DARK_LEVEL: Final = -1.3
_BRIGHT_LEVEL: Final = 0.6
_LEAST_AREA_M2: Final = 7.0
_EDGE_M: Final = 1.2
"""A structure's highlight lies within this distance before its shadow."""
_EDGE_SHARE: Final = 0.5
_LEAST_EDGE_SHARE: Final = 0.25
_LONGEST_M: Final = 60.0
_NEAR_M: Final = 2.0
_APART_M: Final = 20.0


@dataclass(frozen=True, slots=True)
class Structure:
    """A structure as a candidate, how sure it is, and the area of its shadow on the slant-range picture."""

    confidence: float
    candidate: Candidate
    area_m2: float


def structures(grid: LevelGrid) -> list[Structure]:
    """Return the structures of one side, most confident first."""
    size = (max(1, round(_SMOOTH_M / grid.row_along_m)), max(1, round(_SMOOTH_M / grid.cell_across_m)))
    known = np.isfinite(grid.level)
    level = ndimage.uniform_filter(np.where(known, grid.level, 0.0).astype(np.float32), size=size, mode="nearest")
    labels, _ = ndimage.label(known & (level < _DARK_LEVEL))
    cell_m2 = grid.row_along_m * grid.cell_across_m
    areas_m2 = np.bincount(labels.ravel()) * cell_m2
    found = []
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        if box is None or areas_m2[number] < _LEAST_AREA_M2:
            continue
        if (box[0].stop - box[0].start) * grid.row_along_m > _LONGEST_M:
            continue
        one = _structure(grid, level, labels[box] == number, (box[0].start, box[1].start), float(areas_m2[number]))
        if one is not None:
            found.append(one)
    alone = [replace(s, confidence=s.confidence / (1 + _peers(s, found, grid))) for s in found]
    return sorted(alone, key=lambda s: -s.confidence)


def _peers(one: Structure, found: list[Structure], grid: LevelGrid) -> int:
    """Return how many others of at least half its area lie farther away than parts of one structure would."""
    peers = 0
    for other in found:
        along_m = abs(other.candidate.measured.row - one.candidate.measured.row) * grid.row_along_m
        across_m = abs(other.candidate.measured.cell - one.candidate.measured.cell) * grid.cell_across_m
        peers += other.area_m2 >= one.area_m2 / 2 and max(along_m, across_m) > _APART_M
    return peers


def is_within(small: Candidate, large: Candidate, grid: LevelGrid) -> bool:
    """Return whether a contact's middle lies in a structure's highlight or shadow, or within 2 m of them."""
    rows, cells = _NEAR_M / grid.row_along_m, _NEAR_M / grid.cell_across_m
    one, other = small.measured, large.measured
    along = other.rows[0] - rows <= one.row < other.rows[1] + rows
    return along and other.cells[0] - cells <= one.cell < other.cells[1] + other.shadow_cells + cells


def _structure(
    grid: LevelGrid,
    level: npt.NDArray[np.float32],
    dark: npt.NDArray[np.bool_],
    corner: tuple[int, int],
    area_m2: float,
) -> Structure | None:
    """Describe the structure that casts a dark region, or return None when hardly any of its near edge is bright."""
    reach = max(2, round(_EDGE_M / grid.cell_across_m))
    rows = np.flatnonzero(dark.any(axis=1))
    near = corner[1] + dark[rows].argmax(axis=1)
    columns = near[:, None] - 1 - np.arange(reach)[None, :]
    strip = np.where(columns >= 0, level[corner[0] + rows[:, None], np.maximum(columns, 0)], -np.inf)
    bright = strip > _BRIGHT_LEVEL
    lit = bright.any(axis=1)
    share = float(lit.mean())
    if share < _LEAST_EDGE_SHARE:
        return None
    lit_rows = rows[lit]
    middle = int(np.flatnonzero(lit)[np.argmax(strip[lit].max(axis=1))])
    cells = bright[middle].nonzero()[0]
    last, first = int(near[middle]) - int(cells[0]), int(near[middle]) - 1 - int(cells[-1])
    behind = np.flatnonzero(dark[rows[middle]])
    confidence = 2.0 * area_m2 / (area_m2 + _LEAST_AREA_M2) * min(1.0, share / _EDGE_SHARE)
    patch = grid.level[corner[0] : corner[0] + dark.shape[0], corner[1] : corner[1] + dark.shape[1]]
    shadow = float(-np.nanmean(patch[dark]))
    measured = Measured(
        row=corner[0] + int(rows[middle]),
        cell=(first + last) // 2,
        rows=(corner[0] + int(lit_rows[0]), corner[0] + int(lit_rows[-1]) + 1),
        cells=(max(first, 0), last),
        shadow_cells=corner[1] + int(behind[-1]) + 1 - last,
        shadow_is_cut=corner[1] + int(behind[-1]) + 1 >= grid.level.shape[1],
        matched=0.0,
        cfar=float(strip[lit].max(axis=1).mean()),
        shadow=shadow,
        shadow_rows=int(rows[-1] - rows[0]) + 1,
    )
    scores = FilterScores(0.0, measured.cfar, shadow, 0.0, min(1.0, share))
    return Structure(confidence, Candidate(measured, scores), area_m2)
