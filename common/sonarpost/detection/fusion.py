"""Fusion of the filter scores into one calibrated confidence, with clutter normalisation.

Each score s becomes x = ln(min(max(s, low), high)): scores count by ratios, and the upper limit prevents one filter
from outweighing the others. A logistic model combines them:

    evidence = sum of weight * x
    share = 1 / (1 + exp(-(offset + evidence - clutter_weight * clutter)))        confidence = 2 * share

`clutter` is the evidence that other candidates around reach by chance (`clutter_levels`). No weight is negative, so
the confidence never decreases when a score increases. The weights in `fusion.json` are fitted to simulated surveys
only (`research/training/detection.py`). `share` is therefore about the share of contacts of that confidence that are
objects on the bottom: half of those at 1.0. The range 0.0 to 2.0 is the paper's, whose own mapping is not published.
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

from sonarpost.detection.candidates import Candidate, FilterScores, Measurement
from sonarpost.detection.normalisation import FloatVector, LevelGrid
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
"""Lower and upper limit of each score."""

_MIN_CLUTTER_RANK: Final = 3
"""Even in a small image, two neighbours of an object may be objects too."""
_MIN_LOG_ODDS: Final = -700.0


@dataclass(frozen=True, slots=True)
class FusionModel:
    """Parameters of the fusion.

    Attributes:
        offset: Log odds at zero evidence and zero clutter.
        weights: One for each of `FILTERS`, 0 or more.
        clutter_weight: Weight of the clutter level, 0 or more.
        clutter_floor: Clutter level where too few candidates exist.

    Raises:
        ValueError: A weight is missing, negative or not finite.
    """

    offset: float
    weights: tuple[float, ...]
    clutter_weight: float
    clutter_floor: float

    def __post_init__(self) -> None:
        if len(self.weights) != len(FILTERS) or not all(math.isfinite(w) and w >= 0 for w in self.weights):
            raise ValueError(f"weights: got {self.weights}, expected {len(FILTERS)} numbers of 0 or more")
        if not (math.isfinite(self.clutter_weight) and self.clutter_weight >= 0):
            raise ValueError(f"clutter_weight: got {self.clutter_weight}, expected a number of 0 or more")
        if not (math.isfinite(self.offset) and math.isfinite(self.clutter_floor)):
            raise ValueError(f"offset, clutter_floor: got {self.offset}, {self.clutter_floor}, expected finite numbers")

    def evidence(self, scores: FilterScores) -> float:
        """Return the weighted sum of the limited log scores."""
        return sum(w * x for w, x in zip(self.weights, log_scores(scores), strict=True))

    def confidence(self, evidence: float, clutter: float) -> float:
        """Return the confidence, 0 to 2, for an evidence and a clutter level."""
        odds = self.offset + evidence - self.clutter_weight * clutter
        return 2.0 / (1.0 + math.exp(-odds)) if odds > _MIN_LOG_ODDS else 0.0


def log_scores(scores: FilterScores) -> tuple[float, ...]:
    """Return the limited logarithm of each score, in the order of `FILTERS`."""
    return tuple(math.log(min(max(getattr(scores, name), LIMITS[name][0]), LIMITS[name][1])) for name in FILTERS)


@cache
def default_fusion_model() -> FusionModel:
    """Return the model of `fusion.json`."""
    table = json.loads(files("sonarpost.detection").joinpath("fusion.json").read_text("utf-8"))
    weights = tuple(float(table["weights"][name]) for name in FILTERS)
    return FusionModel(float(table["offset"]), weights, float(table["clutter_weight"]), float(table["clutter_floor"]))


def fused_confidences(
    candidates: Sequence[Candidate], grid: LevelGrid, settings: DetectorSettings, model: FusionModel | None = None
) -> list[float]:
    """Return the confidence, 0 to 2, of every candidate of one side.

    Args:
        candidates: All candidates of that side: each is normalised by the others around it.
        grid: That side.
        settings: Radius and area of the clutter normalisation.
        model: None for the default model.
    """
    model = model if model is not None else default_fusion_model()
    evidence: FloatVector = np.array([model.evidence(c.scores) for c in candidates], dtype=np.float64)
    levels = clutter_levels([c.measurement for c in candidates], evidence, grid, settings, model.clutter_floor)
    return [model.confidence(e, level) for e, level in zip(evidence.tolist(), levels.tolist(), strict=True)]


def clutter_levels(
    measurements: Sequence[Measurement],
    evidence: FloatVector,
    grid: LevelGrid,
    settings: DetectorSettings,
    floor: float,
) -> FloatVector:
    """Return the clutter level around each candidate, shape (candidates,), in units of evidence, at least `floor`.

    An ordered-statistic CFAR (Rohling, IEEE Trans. AES 19(4), 1983) on candidates in place of cells. The candidates
    within `clutter_radius_m` are sorted by evidence. The level is the evidence at the rank that corresponds to one
    candidate in every `clutter_area_m2`. A few true objects do not reach that rank, a field of rock does. Candidates
    within `separation_along_m` and `separation_across_m` belong to the same object and are excluded.
    """
    count = len(measurements)
    if not count:
        return np.zeros(0)
    along_m = np.array([m.row for m in measurements]) * grid.row_along_m
    across_m = np.array([m.cell for m in measurements]) * grid.cell_across_m
    distance_along_m = np.abs(along_m[:, None] - along_m[None, :])
    distance_across_m = np.abs(across_m[:, None] - across_m[None, :])
    same = (distance_along_m < settings.separation_along_m) & (distance_across_m < settings.separation_across_m)
    radius_m = settings.clutter_radius_m
    around = (distance_along_m <= radius_m) & (distance_across_m <= radius_m) & ~same
    ordered = np.sort(np.where(around, evidence[None, :], -math.inf), axis=1)[:, ::-1]
    rows, cells = grid.level.shape
    first_m = float(np.median(grid.bottom_cell)) * grid.cell_across_m
    area_m2 = _covered_m(along_m, radius_m, 0.0, rows * grid.row_along_m)
    area_m2 = area_m2 * _covered_m(across_m, radius_m, first_m, cells * grid.cell_across_m)
    rank = np.maximum(np.ceil(area_m2 / settings.clutter_area_m2), _MIN_CLUTTER_RANK).astype(np.int64)
    reached = ordered[np.arange(count), np.minimum(rank, count) - 1]
    return np.asarray(np.maximum(np.where(rank <= count, reached, -math.inf), floor))


def _covered_m(centre_m: FloatVector, radius_m: float, first_m: float, last_m: float) -> FloatVector:
    """Return the length of the interval `radius_m` around each centre that lies between first and last."""
    low, high = np.maximum(centre_m - radius_m, first_m), np.minimum(centre_m + radius_m, last_m)
    return np.asarray(np.maximum(high - low, 0.0))


def suppress_duplicates(
    scored: Sequence[tuple[float, Candidate]], grid: LevelGrid, settings: DetectorSettings
) -> list[tuple[float, Candidate]]:
    """Keep the most confident candidate of every object, most confident first (non-maximum suppression).

    Two candidates are one object if their highlights lie within `separation_along_m` and `separation_across_m` of
    each other, or if the highlight of one lies in the shadow of the other.
    """
    kept: list[tuple[float, Candidate]] = []
    for confidence, one in sorted(scored, key=lambda c: (-c[0], c[1].measurement.row, c[1].measurement.cell)):
        if not any(_is_same_object(one.measurement, other.measurement, grid, settings) for _, other in kept):
            kept.append((confidence, one))
    return kept


def _is_same_object(one: Measurement, other: Measurement, grid: LevelGrid, settings: DetectorSettings) -> bool:
    gap_along_m = max(one.rows[0] - other.rows[1], other.rows[0] - one.rows[1], 0) * grid.row_along_m
    end_of_one, end_of_other = one.cells[1] + one.shadow_cells, other.cells[1] + other.shadow_cells
    if gap_along_m == 0 and one.cells[0] < end_of_other and other.cells[0] < end_of_one:
        return True
    along_m = abs(one.row - other.row) * grid.row_along_m
    across_m = abs(one.cell - other.cell) * grid.cell_across_m
    return along_m < settings.separation_along_m and across_m < settings.separation_across_m
