"""`python -m research.detection.difficulty`: fit the expected probability of detection to simulated surveys.

    python -m research.detection.difficulty --files 16 --held-out 8 --out common/sonarpost/detection/difficulty.json

Each file has four mine-like and six other objects; range, altitude, speed and sample type vary. Training uses seeds
from 4000 on, the calibration seeds from 5000 on, as `python -m research.detection` does. Run the command again after
each change of the detector or of its confidence: it calls `search` only.

An object counts as found at a threshold if one of its contacts (`research.detection.simulated`) has at least that
confidence. The model is a logistic regression of "is found" for all thresholds together (proportional odds), with
weights of 0 or more and offsets that do not increase with the threshold.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from research.codecs.report import aligned
from research.common.command import command_parser, report_progress, run_command
from research.common.statistics import Interval, bootstrap_weights, interval, weighted_means
from research.detection.simulated import FIRST_SEED, Scale, object_at
from sonarpost.detection.detector import search
from sonarpost.detection.difficulty import Difficulty, PdModel
from sonarpost.detection.settings import DetectorSettings
from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.files import write_atomically
from sonarpost.sonar.options import SurveyOptions

Floats = npt.NDArray[np.float64]

FIRST_TRAINING_SEED: Final = 4000
MAX_FILES: Final = FIRST_SEED - FIRST_TRAINING_SEED
THRESHOLDS: Final = (0.1, 0.3, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 1.9)
CALIBRATION_THRESHOLDS: Final = (0.1, 0.5, 1.0, 1.5, 1.9)
_RIDGE: Final = 1e-5
_MAX_WEIGHT: Final = 100.0
_MAX_OFFSET: Final = 100.0
_ALL_CONTACTS: Final = DetectorSettings(confidence_threshold=0.01)
_VARIATIONS: Final[tuple[dict[str, Any], ...]] = (
    {},
    {"range_m": 50.0, "altitude_m": 7.0, "ping_rate_hz": 10.0, "bits": 16},
    {},
    {"range_m": 40.0, "altitude_m": 6.0, "speed_mps": 2.0, "bits": 16},
    {"altitude_m": 3.0},
)


@dataclass(frozen=True, slots=True)
class Mine:
    """A mine-like object of a simulated survey.

    Attributes:
        seabed: Kind of seabed.
        file: Name of the survey.
        difficulty: That of the seabed on its side of the vehicle.
        confidence: Greatest confidence of its contacts; 0 without a contact.
    """

    seabed: SeabedKind
    file: str
    difficulty: Difficulty
    confidence: float


def mines_of_file(seabed: SeabedKind, seed: int) -> list[Mine]:
    """Simulate a file of 1000 pings, detect, and return its mine-like objects on seabed of known difficulty."""
    changes = _VARIATIONS[seed % len(_VARIATIONS)]
    simulated = simulate_survey(replace(SurveySpec(seed=seed, seabed=seabed, targets=4, clutter=6), **changes))
    result = search(simulated.survey, _ALL_CONTACTS, SurveyOptions())
    confidences: dict[int, float] = {}
    for d in result.detections:
        scale = Scale(d.pixel_along_m or _ALL_CONTACTS.assumed_row_along_m, d.pixel_across_m)
        index = object_at(simulated.truth, d.side, d.ping_index, d.sample, scale)
        if index is not None:
            confidences[index] = max(confidences.get(index, 0.0), d.confidence)
    return [
        Mine(seabed, f"{seabed}-{seed}", difficulty, confidences.get(index, 0.0))
        for index, target in enumerate(simulated.truth)
        if target.is_mine_like and (difficulty := result.difficulties.get(target.side)) is not None
    ]


def simulated_mines(first_seed: int, files: int) -> list[Mine]:
    """Return the mine-like objects of `files` surveys of each seabed."""
    found: list[Mine] = []
    for number in range(files):
        for kind in SeabedKind:
            found += mines_of_file(kind, first_seed + number)
        report_progress(f"seed {first_seed + number}: {len(found)} objects")
    return found


def fitted(mines: Sequence[Mine]) -> PdModel:
    """Return the model with the greatest likelihood of what was found at `THRESHOLDS`."""
    count = len(THRESHOLDS)
    measured = [m.difficulty for m in mines]
    features = np.array([[np.log1p(d.clutter_per_1000_m2), d.contrast, d.ripple_strength] for d in measured])
    confidences = np.array([m.confidence for m in mines])
    signs = np.where(confidences[:, None] >= np.array(THRESHOLDS)[None, :], 1.0, -1.0)

    def loss(parameters: Floats) -> tuple[float, Floats]:
        # Parameters: the first offset, how far each further one is below the one before, the weights.
        offsets = parameters[0] - np.append(0.0, np.cumsum(parameters[1:count]))
        margins = signs * (offsets[None, :] - (features @ parameters[count:])[:, None])
        slopes = -signs / (1.0 + np.exp(np.clip(margins, -50.0, 50.0))) / margins.size
        by_offset = slopes.sum(axis=0)
        below = np.cumsum(by_offset[::-1])[::-1]
        gradient = np.concatenate(([below[0]], -below[1:], -features.T @ slopes.sum(axis=1)))
        value = np.logaddexp(0.0, -margins).mean() + _RIDGE * parameters @ parameters / 2
        return float(value), gradient + _RIDGE * parameters

    bounds = [(-_MAX_OFFSET, _MAX_OFFSET)] + [(0.0, _MAX_WEIGHT)] * (count - 1 + features.shape[1])
    start = np.full(count + features.shape[1], 0.1)
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 5000}).x
    offsets = np.round(found[0] - np.append(0.0, np.cumsum(found[1:count])), 4)
    weights = [round(float(w), 4) for w in found[count:]]
    return PdModel(
        thresholds=list(THRESHOLDS),
        offsets=offsets.tolist(),
        clutter_weight=weights[0],
        contrast_weight=weights[1],
        ripple_weight=weights[2],
    )


@dataclass(frozen=True, slots=True)
class Calibration:
    """Predicted and actual probability of detection of the objects on one seabed at one threshold.

    Attributes:
        seabed: Kind of seabed.
        threshold: Confidence threshold.
        objects: Number of mine-like objects.
        predicted: Mean of the expected probability of detection.
        actual: Share of the objects that were found.
        actual_interval: 95 % bootstrap interval of `actual` over the files; None with too few files.
    """

    seabed: SeabedKind
    threshold: float
    objects: int
    predicted: float
    actual: float
    actual_interval: Interval | None


def calibration(mines: Sequence[Mine], model: PdModel) -> list[Calibration]:
    """Return predicted and actual values of each seabed at each of `CALIBRATION_THRESHOLDS`."""
    rows = []
    for kind in SeabedKind:
        there = [m for m in mines if m.seabed is kind]
        if not there:
            continue
        weights = bootstrap_weights([m.file for m in there])
        for threshold in CALIBRATION_THRESHOLDS:
            predicted = [
                model.expected_pd(d.clutter_per_1000_m2, d.ripple_strength, d.contrast, threshold)
                for d in (m.difficulty for m in there)
            ]
            found = np.array([m.confidence >= threshold for m in there], dtype=np.float64)
            bounds = interval(weighted_means(found, weights))
            rows.append(
                Calibration(kind, threshold, len(there), float(np.mean(predicted)), float(found.mean()), bounds)
            )
    return rows


def calibration_text(rows: Sequence[Calibration]) -> str:
    """Return the calibration as a table."""
    table = [("seabed", "threshold", "objects", "predicted Pd", "actual Pd", "95 % interval")]
    for row in rows:
        bounds = "-" if row.actual_interval is None else "{:.2f}..{:.2f}".format(*row.actual_interval)
        figures = (f"{row.predicted:.2f}", f"{row.actual:.2f}", bounds)
        table.append((row.seabed.value, f"{row.threshold:g}", str(row.objects), *figures))
    return aligned(table)


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser(
        "detection.difficulty",
        description="Fit the expected probability of detection to simulated files of every seabed, print predicted and "
        "actual values on held-out files, and write the model.",
    )
    parser.add_argument(
        "--files", type=int, default=16, metavar="N", help="training files of each seabed (%(default)s)"
    )
    parser.add_argument(
        "--held-out", type=int, default=8, metavar="M", help="files of each seabed for the calibration (%(default)s)"
    )
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="write the model to this file")
    return parser


def run(args: argparse.Namespace) -> int:
    """Fit, print the calibration and the model; return 0.

    Raises:
        ConfigError: An option is out of range.
        OSError: The file cannot be written.
    """
    for option, value, low in (("--files", args.files, 1), ("--held-out", args.held_out, 0)):
        if not low <= value <= MAX_FILES:
            raise ConfigError("detection.difficulty", option, value, f"{low}..{MAX_FILES}")
    mines = simulated_mines(FIRST_TRAINING_SEED, args.files)
    if not mines:
        raise ConfigError("detection.difficulty", "--files", args.files, "files with seabed of known difficulty")
    model = fitted(mines)
    if args.held_out:
        print(calibration_text(calibration(simulated_mines(FIRST_SEED, args.held_out), model)))
    origin = {
        "fitted_by": "research/detection/difficulty.py",
        "seeds": [FIRST_TRAINING_SEED, FIRST_TRAINING_SEED + args.files - 1],
        "objects": len(mines),
    }
    text = json.dumps(origin | model.model_dump(), indent=2)
    if args.out is not None:
        write_atomically(args.out, f"{text}\n".encode())
    print(text)
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
