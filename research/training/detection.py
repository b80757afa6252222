"""Fit the weights of the detector's fusion to simulated surveys, and to nothing else.

    python -m research.training.detection --cache /tmp/detect --out common/sonarpost/detection/fusion.json

48 surveys of 1000 pings, eight of each seabed, with four mine-like and six other objects each; range, altitude, speed
and sample type vary. Seeds 1000 to 1007; the evaluation (`python -m research.detection`) uses seeds from 5000 on. The
result is the same, number for number, on the same versions of numpy and scipy.

Four rounds: with the weights at hand every side's places are fused, each place of the bottom keeps its best, and a
logistic regression of "is an object" on the logarithms of the scores and on the clutter's level gives the next weights
(none below 0). Other objects than mine-like ones weigh less, so that the order is set by mines against the bottom. Last
the scale and offset of the log odds are fitted with all objects weighing the same: that is what makes the confidence a
share.
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
class SideTable:
    """One side's places: its grid without the levels, the places, and the object that each is, if any."""

    grid: LevelGrid
    places: list[Candidate]
    objects: list[TruthObject | None]


def simulated(seed: int, seabed: SeabedKind, cache: Path | None) -> SimulatedSurvey:
    """Simulate one training survey, or take it from the cache of an earlier run (a folder of one's own)."""
    kept = None if cache is None else cache / f"{seed}_{seabed}.pkl"
    if kept is not None and kept.is_file():
        found: SimulatedSurvey = pickle.loads(kept.read_bytes())
        return found
    changes = _VARIATIONS[(seed - FIRST_SEED) % len(_VARIATIONS)]
    made = simulate_survey(replace(SurveySpec(seed=seed, seabed=seabed, targets=4, clutter=6), **changes))
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(kept, pickle.dumps(made))
    return made


def tables(made: SimulatedSurvey) -> list[SideTable]:
    """Find the places of both sides and what each truly is."""
    survey, found = made.survey, []
    altitude_m = altitudes_m(survey)
    for side in survey.sides():
        grid = normalise_side(survey, side, SETTINGS, altitude_m)
        if grid is None:
            continue
        places = find_candidates(grid, SETTINGS)
        scale = Scale(grid.row_along_m, grid.cell_across_m / grid.samples_per_cell)
        objects = []
        for place in places:
            sample = (place.measurement.cell + 0.5) * grid.samples_per_cell
            index = object_at(made.truth, side, place.measurement.row, sample, scale)
            objects.append(None if index is None else made.truth[index])
        nothing = np.broadcast_to(np.float32(0.0), grid.level.shape)
        found.append(SideTable(replace(grid, level=nothing, ratio=nothing), places, objects))
    return found


def kept_rows(sides: list[SideTable], model: FusionModel) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return logarithms of scores and the clutter's level, shape (places, 6), and the kinds, of the places kept.

    A kind is 2 (mine-like), 1 (other object) or 0 (bottom). Of an object's places only the most confident is its own;
    the others are left out, being neither the object nor a false alarm.
    """
    rows: list[list[float]] = []
    kinds: list[int] = []
    for side in sides:
        evidence = np.array([model.evidence(p.scores) for p in side.places])
        levels = clutter_levels(
            [p.measurement for p in side.places], evidence, side.grid, SETTINGS, model.clutter_floor
        )
        met: set[int] = set()
        row_of = {id(p): i for i, p in enumerate(side.places)}
        fused = fused_confidences(side.places, side.grid, SETTINGS, model)
        for _, place in suppress_duplicates(list(zip(fused, side.places, strict=True)), side.grid, SETTINGS):
            index = row_of[id(place)]
            thing = side.objects[index]
            if thing is not None and id(thing) in met:
                continue
            met.add(id(thing))
            rows.append([*log_scores(place.scores), -levels[index]])
            kinds.append(0 if thing is None else 2 if thing.is_mine_like else 1)
    return np.array(rows), np.array(kinds)


def logistic(seen: Floats, is_object: npt.NDArray[np.bool_], weights: Floats) -> Floats:
    """Fit a logistic regression with slopes of 0 or more; return the slopes and the offset."""
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


def fitted(sides: list[SideTable]) -> tuple[FusionModel, npt.NDArray[np.int64]]:
    """Return the model, and the kinds of the places that its scale and offset were fitted to."""
    model = START
    for _ in range(ROUNDS):
        evidence = [model.evidence(p.scores) for side in sides for p in side.places]
        model = replace(model, clutter_floor=float(np.percentile(evidence, FLOOR_PERCENTILE)))
        rows, kinds = kept_rows(sides, model)
        slopes = logistic(rows, kinds > 0, np.where(kinds == 1, OTHER_OBJECT_WEIGHT, 1.0))
        model = replace(
            model, offset=float(slopes[-1]), weights=tuple(slopes[:-2].tolist()), clutter_weight=float(slopes[-2])
        )
    evidence = [model.evidence(p.scores) for side in sides for p in side.places]
    model = replace(model, clutter_floor=float(np.percentile(evidence, FLOOR_PERCENTILE)))
    rows, kinds = kept_rows(sides, model)
    odds = rows[:, :-1] @ np.array(model.weights) + model.clutter_weight * rows[:, -1]
    scale, offset = logistic(odds[:, None], kinds > 0, np.ones(len(kinds))).tolist()
    weights = tuple(scale * w for w in model.weights)
    # The clutter's level is evidence too and scales with it, so its weight stays.
    return FusionModel(offset, weights, model.clutter_weight, scale * model.clutter_floor), kinds


def main() -> None:
    """Simulate, fit, write."""
    parser = argparse.ArgumentParser(description="Fit the detector's fusion to simulated surveys.")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cache", type=Path, help="folder for the simulated surveys, to fit again at once")
    parsed = parser.parse_args()
    jobs = [(FIRST_SEED + i, kind) for i in range(SEEDS) for kind in SeabedKind]
    sides = [side for seed, kind in jobs for side in tables(simulated(seed, kind, parsed.cache))]
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
    main()
