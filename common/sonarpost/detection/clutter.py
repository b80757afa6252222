"""How cluttered the seabed is around a place: what evidence other places reach there by chance.

On sand hardly anything looks like an object; on rock much does, and no threshold holds for both. As a constant false
alarm rate detector takes its threshold from the noise around, so the fusion takes its own from the evidence around:
among the other places within some distance, the one is looked up that has as many stronger ones as one in every
`clutter_area_m2` would give. Its evidence is the clutter's level. A few true objects do not reach it, a field of rock
does (an ordered-statistic CFAR, Rohling, IEEE Trans. AES 19(4), 1983, on places instead of cells).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.detection.measure import Measured
from sonarpost.detection.preprocess import LevelGrid
from sonarpost.detection.settings import DetectorSettings

Numbers = npt.NDArray[np.float64]

_LEAST_RANK: Final = 3
"""However small the picture, two neighbours of an object may be objects too."""


def clutter_levels(
    found: Sequence[Measured], evidence: Numbers, grid: LevelGrid, settings: DetectorSettings, floor: float
) -> Numbers:
    """Return the clutter's level around each place, shape (places,), in units of evidence, at least `floor`.

    Places as near as `separation_along_m` and `separation_across_m` are parts of the same thing and left out.

    Args:
        found: The places of one side.
        evidence: What the filters together say of each, shape (places,).
        grid: That side.
        settings: Distances and areas.
        floor: The level where too few places answer at all.
    """
    if not found:
        return np.zeros(0)
    along_m = np.array([one.row for one in found]) * grid.row_along_m
    across_m = np.array([one.cell for one in found]) * grid.cell_across_m
    off_along = np.abs(along_m[:, None] - along_m[None, :])
    off_across = np.abs(across_m[:, None] - across_m[None, :])
    same = (off_along < settings.separation_along_m) & (off_across < settings.separation_across_m)
    reach_m = settings.clutter_radius_m
    around = (off_along <= reach_m) & (off_across <= reach_m) & ~same
    ordered = np.sort(np.where(around, evidence[None, :], -math.inf), axis=1)[:, ::-1]
    rows, cells = grid.level.shape
    first_m = float(np.median(grid.bottom_cell)) * grid.cell_across_m
    area_m2 = _span(along_m, reach_m, 0.0, rows * grid.row_along_m)
    area_m2 = area_m2 * _span(across_m, reach_m, first_m, cells * grid.cell_across_m)
    rank = np.maximum(np.ceil(area_m2 / settings.clutter_area_m2), _LEAST_RANK).astype(np.int64)
    reached = ordered[np.arange(len(found)), np.minimum(rank, len(found)) - 1]
    return np.asarray(np.maximum(np.where(rank <= len(found), reached, -math.inf), floor))


def _span(middle_m: Numbers, reach_m: float, first_m: float, last_m: float) -> Numbers:
    """Return how much of `reach_m` to both sides of each middle lies between first and last."""
    return np.asarray(np.maximum(np.minimum(middle_m + reach_m, last_m) - np.maximum(middle_m - reach_m, first_m), 0.0))
