"""Fit the weights of the detector's fusion to simulated surveys.

    python -m research.training.detection --cache /tmp/detect --out common/sonarpost/detection/fusion.json

48 surveys of 1000 pings, eight of each seabed, with four mine-like and six other objects each; range, altitude, speed
and sample type vary. Seeds 1000 to 1007; the evaluation (`python -m research.detection`) uses seeds from 5000 on. The
result is the same, number for number, on the same versions of numpy and scipy.

There are four rounds. In each, the candidates of every side are fused with the current weights, and the most confident
candidate of each place is kept. A logistic regression of "is an object" on the log scores and the clutter level gives
the next weights, none negative. Objects that are not mine-like have less weight, so that the order of the confidences
separates mines from seabed. Finally, scale and offset of the log odds are fitted with equal weight for all objects;
they make the confidence a share of objects.
"""

from __future__ import annotations

import argparse
import json
import pickle
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from research.detection.simulated import Scale, object_at
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.detection.candidates import Candidate, find_candidates
from sonarpost.detection.fusion import (
    FILTERS,
    FusionModel,
    clutter_levels,
    fused_confidences,
    log_scores,
    suppress_duplicates,
)
from sonarpost.detection.normalisation import LevelGrid, normalise_side
from sonarpost.detection.settings import DetectorSettings
from sonarpost.files import write_atomically
from sonarpost.simulation.seabed.survey import SimulatedSurvey, SurveySpec, TruthObject, simulate_survey
from sonarpost.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.bottom_track import altitudes_m

Floats = npt.NDArray[np.float64]

FIRST_SEED = 1000
SEEDS = 8
ROUNDS = 4
OTHER_OBJECT_WEIGHT = 0.3
RIDGE = 1e-4
FLOOR_PERCENTILE = 1.0
SETTINGS = DetectorSettings()
START = FusionModel(-6.0, (1.0,) * len(FILTERS), 0.0, -9.0)
_VARIATIONS: tuple[dict[str, Any], ...] = (
    {},
    {},
    {"range_m": 50.0, "altitude_m": 7.0, "ping_rate_hz": 10.0, "bits": 16},
    {"range_m": 20.0, "altitude_m": 3.0},
    {},
    {"range_m": 40.0, "altitude_m": 6.0, "speed_mps": 2.0, "bits": 16},
    {},
    {"altitude_m": 3.0},
)


@dataclass(frozen=True)
class SideCandidates:
    """The candidates of one side: its grid without the levels, the candidates, and the object of each, if any."""

    grid: LevelGrid
    candidates: list[Candidate]
    objects: list[TruthObject | None]


def simulated(seed: int, seabed: SeabedKind, cache: Path | None) -> SimulatedSurvey:
    """Simulate one training survey, or load it from the cache (pickles: use a private folder)."""
    cached = None if cache is None else cache / f"{seed}_{seabed}.pkl"
    if cached is not None and cached.is_file():
        found: SimulatedSurvey = pickle.loads(cached.read_bytes())
        return found
    changes = _VARIATIONS[(seed - FIRST_SEED) % len(_VARIATIONS)]
    simulated_survey = simulate_survey(replace(SurveySpec(seed=seed, seabed=seabed, targets=4, clutter=6), **changes))
    if cached is not None:
        cached.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(cached, pickle.dumps(simulated_survey))
    return simulated_survey


def side_candidates(simulated_survey: SimulatedSurvey) -> list[SideCandidates]:
    """Return the candidates of both sides with their true objects."""
    survey, found = simulated_survey.survey, []
    altitude_m = altitudes_m(survey)
    for side in survey.sides():
        grid = normalise_side(survey, side, SETTINGS, altitude_m)
        if grid is None:
            continue
        candidates = find_candidates(grid, SETTINGS)
        scale = Scale(grid.row_along_m, grid.cell_across_m / grid.samples_per_cell)
        objects = []
        for candidate in candidates:
            sample = (candidate.measurement.cell + 0.5) * grid.samples_per_cell
            index = object_at(simulated_survey.truth, side, candidate.measurement.row, sample, scale)
            objects.append(None if index is None else simulated_survey.truth[index])
        no_levels = np.broadcast_to(np.float32(0.0), grid.level.shape)
        found.append(SideCandidates(replace(grid, level=no_levels), candidates, objects))
    return found


def kept_rows(sides: list[SideCandidates], model: FusionModel) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return log scores with clutter level, shape (candidates, 6), and the kinds, of the candidates kept.

    A kind is 2 (mine-like), 1 (other object) or 0 (seabed). Only the most confident candidate of an object is kept;
    the others are neither objects nor false alarms.
    """
    rows: list[list[float]] = []
    kinds: list[int] = []
    for side in sides:
        evidence = np.array([model.evidence(p.scores) for p in side.candidates])
        levels = clutter_levels(
            [p.measurement for p in side.candidates], evidence, side.grid, SETTINGS, model.clutter_floor
        )
        assigned: set[int] = set()
        row_of = {id(p): i for i, p in enumerate(side.candidates)}
        fused = fused_confidences(side.candidates, side.grid, SETTINGS, model)
        for _, place in suppress_duplicates(list(zip(fused, side.candidates, strict=True)), side.grid, SETTINGS):
            index = row_of[id(place)]
            target = side.objects[index]
            if target is not None and id(target) in assigned:
                continue
            assigned.add(id(target))
            rows.append([*log_scores(place.scores), -levels[index]])
            kinds.append(0 if target is None else 2 if target.is_mine_like else 1)
    return np.array(rows), np.array(kinds)


def logistic(seen: Floats, is_object: npt.NDArray[np.bool_], weights: Floats) -> Floats:
    """Fit a logistic regression without negative slopes; return the slopes and the offset."""
    signs, shares = np.where(is_object, 1.0, -1.0), weights / weights.sum()

    def loss(parameters: Floats) -> tuple[float, Floats]:
        margins = signs * (seen @ parameters[:-1] + parameters[-1])
        value = shares @ np.logaddexp(0.0, -margins) + RIDGE * parameters[:-1] @ parameters[:-1]
        slope = -shares * signs / (1.0 + np.exp(np.clip(margins, -50.0, 50.0)))
        return float(value), np.append(seen.T @ slope + 2 * RIDGE * parameters[:-1], slope.sum())

    bounds = [(0.0, None)] * seen.shape[1] + [(None, None)]
    start = np.full(seen.shape[1] + 1, 0.1)
    found: Floats = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 2000}).x
    return found


def fitted(sides: list[SideCandidates]) -> tuple[FusionModel, npt.NDArray[np.int64]]:
    """Return the model, and the kinds of the candidates used for scale and offset."""
    model = START
    for _ in range(ROUNDS):
        evidence = [model.evidence(p.scores) for side in sides for p in side.candidates]
        model = replace(model, clutter_floor=float(np.percentile(evidence, FLOOR_PERCENTILE)))
        rows, kinds = kept_rows(sides, model)
        slopes = logistic(rows, kinds > 0, np.where(kinds == 1, OTHER_OBJECT_WEIGHT, 1.0))
        model = replace(
            model, offset=float(slopes[-1]), weights=tuple(slopes[:-2].tolist()), clutter_weight=float(slopes[-2])
        )
    evidence = [model.evidence(p.scores) for side in sides for p in side.candidates]
    model = replace(model, clutter_floor=float(np.percentile(evidence, FLOOR_PERCENTILE)))
    rows, kinds = kept_rows(sides, model)
    odds = rows[:, :-1] @ np.array(model.weights) + model.clutter_weight * rows[:, -1]
    scale, offset = logistic(odds[:, None], kinds > 0, np.ones(len(kinds))).tolist()
    weights = tuple(scale * w for w in model.weights)
    # The clutter level is in units of evidence and scales with it, so its weight does not change.
    return FusionModel(offset, weights, model.clutter_weight, scale * model.clutter_floor), kinds


def main() -> None:
    """Simulate the surveys, fit the model, write it."""
    parser = argparse.ArgumentParser(description="Fit the detector's fusion to simulated surveys.")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cache", type=Path, help="folder for the simulated surveys, to repeat the fit quickly")
    parsed = parser.parse_args()
    jobs = [(FIRST_SEED + i, kind) for i in range(SEEDS) for kind in SeabedKind]
    sides = [side for seed, kind in jobs for side in side_candidates(simulated(seed, kind, parsed.cache))]
    model, kinds = fitted(sides)
    text = json.dumps(
        {
            "fitted_by": "research/training/detection.py",
            "surveys": len(jobs),
            "seeds": [FIRST_SEED, FIRST_SEED + SEEDS - 1],
            "places": {
                "seabed": int((kinds == 0).sum()),
                "other": int((kinds == 1).sum()),
                "mine": int((kinds == 2).sum()),
            },
            "offset": round(model.offset, 4),
            "weights": {name: round(w, 4) for name, w in zip(FILTERS, model.weights, strict=True)},
            "clutter_weight": round(model.clutter_weight, 4),
            "clutter_floor": round(model.clutter_floor, 4),
        },
        indent=2,
    )
    write_atomically(parsed.out, (text + "\n").encode())
    print(text)


if __name__ == "__main__":
    with ProgressDisplay(step="training.detection"):
        main()
