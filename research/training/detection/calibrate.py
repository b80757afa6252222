"""Fit the calibration of a trained network to simulated surveys.

    python -m research.training.detection.calibrate --network network.npz --out classifier.npz

A slope for all outputs and an offset for each class are fitted by maximum likelihood to the contacts of surveys that
took no part in the training: seeds from 21,000 on, of every seabed, with four mine-like and six other objects each.
The most confident candidate of each place counts, as in the detector. The confidence is therefore a probability at
that density of objects and with equal shares of the seabeds.
"""

import argparse
import multiprocessing
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from research.detection.simulated import Scale, object_at
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.detection.candidates import classified_candidates, distinct_candidates
from sonarpost.detection.classifier import (
    MINE_LIKE_OBJECT,
    OTHER_OBJECT,
    SEABED,
    Classifier,
    load_classifier,
    weight_shapes,
)
from sonarpost.detection.matched_filter import matched_response
from sonarpost.detection.normalisation import normalise_side
from sonarpost.detection.settings import DetectorSettings
from sonarpost.extensions.simulation.seabed.spec import SurveySpec
from sonarpost.extensions.simulation.seabed.survey import simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.bottom_track import altitudes_m

Floats = npt.NDArray[np.float64]

FIRST_SEED: Final = 21_000
FILES: Final = 6
_LOWEST: Final = 0.01
_ROUNDS: Final = 2
_SETTINGS: Final = DetectorSettings()


def contact_outputs(work: tuple[Classifier, SeabedKind, int]) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return logarithms of the probabilities, shape (contacts, 3), and true classes of the contacts of one survey."""
    classifier, seabed, seed = work
    simulated = simulate_survey(SurveySpec(seed=seed, seabed=seabed, targets=4, clutter=6))
    survey, rows, labels = simulated.survey, [], []
    for side in survey.sides():
        grid = normalise_side(survey, side, _SETTINGS, altitudes_m(survey))
        if grid is None:
            continue
        candidates = classified_candidates(matched_response(grid, _SETTINGS), grid, _SETTINGS, classifier)
        scale = Scale(grid.row_along_m, grid.cell_across_m / grid.samples_per_cell)
        assigned: set[int] = set()
        for placed in distinct_candidates(candidates, grid, _SETTINGS, _LOWEST):
            sample = (placed.measurement.cell + 0.5) * grid.samples_per_cell
            index = object_at(simulated.truth, side, placed.measurement.row, sample, scale)
            if index in assigned:
                continue
            label = SEABED
            if index is not None:
                assigned.add(index)
                label = MINE_LIKE_OBJECT if simulated.truth[index].is_mine_like else OTHER_OBJECT
            one = placed.candidate
            p = np.array([1 - one.p_mine_like - one.p_other_object, one.p_other_object, one.p_mine_like])
            rows.append(np.log(np.maximum(p, 1e-7)))
            labels.append(label)
    return np.array(rows).reshape(-1, 3), np.array(labels, dtype=np.int64)


def fitted_calibration(outputs: Floats, labels: npt.NDArray[np.int64]) -> tuple[float, tuple[float, float, float]]:
    """Return slope and offsets of greatest likelihood; the offset of seabed is 0."""

    def loss(values: Floats) -> float:
        odds = outputs * values[0] + np.array([0.0, values[1], values[2]])
        odds -= odds.max(axis=1, keepdims=True)
        log_p = odds - np.log(np.exp(odds).sum(axis=1, keepdims=True))
        return -float(log_p[np.arange(len(labels)), labels].mean()) + 1e-3 * float((values[0] - 1) ** 2)

    found = minimize(loss, np.array([1.0, 0.0, 0.0]), method="Nelder-Mead", options={"maxiter": 2000}).x
    return float(found[0]), (0.0, float(found[1]), float(found[2]))


def calibrated(classifier: Classifier, files: int, workers: int) -> Classifier:
    """Return a classifier with the calibration that `files` surveys of each seabed give.

    The calibration decides which candidate of a place is the most confident one. So a second round fits the contacts
    of the first calibration.
    """
    slope, offsets = 1.0, (0.0, 0.0, 0.0)
    for _ in range(_ROUNDS):
        present = with_calibration(classifier, slope, offsets)
        work = [(present, kind, FIRST_SEED + n) for n in range(files) for kind in SeabedKind]
        parts = []
        with ProgressDisplay() as progress, multiprocessing.Pool(workers) as pool:
            for number, part in enumerate(pool.imap(contact_outputs, work), start=1):
                parts.append(part)
                progress.show("surveys", number, len(work))
        outputs, labels = (np.concatenate([part[n] for part in parts]) for n in (0, 1))
        factor, more = fitted_calibration(outputs, labels)
        slope = factor * slope
        offsets = (0.0, factor * offsets[1] + more[1], factor * offsets[2] + more[2])
    return with_calibration(classifier, slope, offsets)


def with_calibration(classifier: Classifier, slope: float, offsets: tuple[float, float, float]) -> Classifier:
    """Return the same network with another calibration."""
    return Classifier({**classifier.weights, "calibration": np.array([slope, *offsets], dtype=np.float32)})


def write_classifier(classifier: Classifier, path: Path) -> None:
    """Write a classifier as npz."""
    with path.open("wb") as file:  # `savez_compressed` would append a suffix to a path
        np.savez_compressed(file, **{name: classifier.weights[name] for name in weight_shapes()})  # type: ignore[arg-type]


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--files", type=int, default=FILES, help="surveys of each seabed (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    classifier = calibrated(load_classifier(arguments.network), arguments.files, arguments.workers)
    write_classifier(classifier, arguments.out)
    print(f"{arguments.out}: identity {classifier.identity}, calibration {classifier.weights['calibration'].tolist()}")


if __name__ == "__main__":
    main()
