"""From independent scores to one calibrated confidence, and from many candidates to one a place.

Each filter's score s becomes x = ln(min(max(s, low), high)): an answer counts by ratios, and beyond `high` it is as
sure as it can be, so that one filter cannot outvote the rest. A logistic model joins them,

    evidence = sum of weight * x
    share = 1 / (1 + exp(-(offset + evidence - clutter_weight * clutter)))        confidence = 2 * share

where `clutter` is the evidence that places around reach by chance (module `clutter`). No weight is below 0,
so the confidence never falls when a score rises. The weights, in `fusion.json` beside this module, are fitted to
simulated surveys only (`research/training/detection.py`), so that `share` is about the share of contacts of that
confidence that truly are objects on the bottom: half of those at 1.0. The paper's confidence has the same range
(0.0 to 2.0, a fusion of several filters); its mapping is not published, so this one is ours.


## sonarpost.detection.fusion
How cluttered the seabed is around a place: what evidence other places reach there by chance.

On sand hardly anything looks like an object; on rock much does, and no threshold holds for both. As a constant false
alarm rate detector takes its threshold from the noise around, so the fusion takes its own from the evidence around:
among the other places within some distance, the one is looked up that has as many stronger ones as one in every
`clutter_area_m2` would give. Its evidence is the clutter's level. A few true objects do not reach it, a field of rock
does (an ordered-statistic CFAR, Rohling, IEEE Trans. AES 19(4), 1983, on places instead of cells).
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.detection.candidates import Candidate, FilterScores, Measured
from sonarpost.detection.normalisation import LevelGrid
from sonarpost.detection.settings import DetectorSettings

FILTERS: Final = ("matched", "cfar", "shadow", "texture", "geometry")
"""Names of the scores, in the order of the weights."""

LIMITS: Final = {
    "matched": (1.0, 5.0),
    "cfar": (0.2, 10.0),
    "shadow": (0.2, 4.0),
    "texture": (0.5, 8.0),
    "geometry": (0.05, 1.0),
}
"""Least and greatest value of each score that makes a difference."""

_TINY_ODDS: Final = -700.0


@dataclass(frozen=True, slots=True)
class FusionModel:
    """What the fusion is made of.

    Attributes:
        offset: Log odds where evidence and clutter are 0.
        weights: One for each of `FILTERS`, 0 or more.
        clutter_weight: How much of the clutter's level is taken off, 0 or more.
        clutter_floor: The clutter's level where nothing answers.
    """

    offset: float
    weights: tuple[float, ...]
    clutter_weight: float
    clutter_floor: float

    def __post_init__(self) -> None:
        """Refuse weights that are not one a filter, below 0, or not finite.

        Raises:
            ValueError: They are.
        """
        if len(self.weights) != len(FILTERS) or not all(math.isfinite(w) and w >= 0 for w in self.weights):
            raise ValueError(f"weights: got {self.weights}, expected {len(FILTERS)} numbers of 0 or more")
        if not (math.isfinite(self.clutter_weight) and self.clutter_weight >= 0):
            raise ValueError(f"clutter_weight: got {self.clutter_weight}, expected a number of 0 or more")
        if not (math.isfinite(self.offset) and math.isfinite(self.clutter_floor)):
            raise ValueError(f"offset, clutter_floor: got {self.offset}, {self.clutter_floor}, expected finite numbers")

    def evidence(self, scores: FilterScores) -> float:
        """Return what the filters together say."""
        return sum(w * x for w, x in zip(self.weights, log_scores(scores), strict=True))

    def confidence(self, evidence: float, clutter: float) -> float:
        """Return the confidence, 0 to 2, of evidence among clutter of a level."""
        odds = self.offset + evidence - self.clutter_weight * clutter
        return 2.0 / (1.0 + math.exp(-odds)) if odds > _TINY_ODDS else 0.0


def log_scores(scores: FilterScores) -> tuple[float, ...]:
    """Return the limited logarithm of each score, in the order of `FILTERS`."""
    return tuple(math.log(min(max(getattr(scores, name), LIMITS[name][0]), LIMITS[name][1])) for name in FILTERS)


@cache
def shipped_model() -> FusionModel:
    """Return the model that comes with the package."""
    table = json.loads(files("sonarpost.detection").joinpath("fusion.json").read_text("utf-8"))
    weights = tuple(float(table["weights"][name]) for name in FILTERS)
    return FusionModel(float(table["offset"]), weights, float(table["clutter_weight"]), float(table["clutter_floor"]))


def fused_confidences(
    found: Sequence[Candidate], grid: LevelGrid, settings: DetectorSettings, model: FusionModel | None = None
) -> list[float]:
    """Return the confidence, 0 to 2, of every place of one side.

    Args:
        found: All places of that side: each is judged among the others.
        grid: That side.
        settings: How far around clutter is looked for.
        model: The shipped one when None.
    """
    chosen = model if model is not None else shipped_model()
    evidence: Numbers = np.array([chosen.evidence(one.scores) for one in found], dtype=np.float64)
    levels = clutter_levels([one.measured for one in found], evidence, grid, settings, chosen.clutter_floor)
    return [chosen.confidence(e, level) for e, level in zip(evidence.tolist(), levels.tolist(), strict=True)]


def suppress(
    candidates: Sequence[tuple[float, Candidate]], grid: LevelGrid, settings: DetectorSettings
) -> list[tuple[float, Candidate]]:
    """Keep the most confident candidate of every place, most confident first.

    Two candidates are one place when their highlights lie within `separation_along_m` and `separation_across_m` of
    each other, or when one's highlight lies in the other's shadow.
    """
    kept: list[tuple[float, Candidate]] = []
    for confidence, one in sorted(candidates, key=lambda c: (-c[0], c[1].measured.row, c[1].measured.cell)):
        if not any(_same_place(one.measured, other.measured, grid, settings) for _, other in kept):
            kept.append((confidence, one))
    return kept


def _same_place(one: Measured, other: Measured, grid: LevelGrid, settings: DetectorSettings) -> bool:
    along_m = max(one.rows[0] - other.rows[1], other.rows[0] - one.rows[1], 0) * grid.row_along_m
    far_one, far_other = one.cells[1] + one.shadow_cells, other.cells[1] + other.shadow_cells
    if along_m == 0 and one.cells[0] < far_other and other.cells[0] < far_one:
        return True
    centre_along_m = abs(one.row - other.row) * grid.row_along_m
    centre_across_m = abs(one.cell - other.cell) * grid.cell_across_m
    return centre_along_m < settings.separation_along_m and centre_across_m < settings.separation_across_m


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
