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

from sonarpost.detection.candidates import Candidate, FilterScores
from sonarpost.detection.clutter import Numbers, clutter_levels
from sonarpost.detection.measure import Measured
from sonarpost.detection.preprocess import LevelGrid
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
