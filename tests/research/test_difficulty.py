"""Fit and calibration of the expected probability of detection."""

import json
import math

import numpy as np
import pytest

from research.detection import difficulty as command
from research.detection.difficulty import FIRST_TRAINING_SEED, THRESHOLDS, Mine, calibration, fitted, mines_of_file
from research.detection.simulated import FIRST_SEED
from sonarpost.detection import difficulty as shipped
from sonarpost.detection.difficulty import Difficulty, PdModel
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind

WEIGHTS = {"clutter_weight": 0.8, "contrast_weight": 2.5, "ripple_weight": 0.0}
TRUE_MODEL = PdModel(thresholds=[0.0, 2.0], offsets=[7.0, 3.0], **WEIGHTS)


def drawn_mines(files, seed):
    """Return objects whose confidences are drawn from `TRUE_MODEL`, four in each file."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(files):
        kind = list(SeabedKind)[number % 2]
        clutter, contrast = rng.uniform(0, 60), rng.uniform(0.2, 1.5)
        for _ in range(4):
            # The greatest threshold at which the object is found, from the inverse of the model.
            share = rng.uniform()
            odds = math.log(share / (1 - share))
            offset = odds + 0.8 * math.log1p(clutter) + 2.5 * contrast
            confidence = min(max((7.0 - offset) / 2.0, 0.0), 2.0)
            rated = Difficulty(5000.0, clutter, rng.uniform(0, 0.3), contrast, 0.5)
            found.append(Mine(kind, f"{kind}-{number}", rated, confidence))
    return found


@pytest.fixture(scope="module")
def model():
    return fitted(drawn_mines(400, seed=1))


def test_fit_recovers_the_model(model):
    for clutter, contrast, threshold in ((2.0, 0.4, 1.0), (50.0, 1.2, 1.0), (30.0, 0.8, 0.3), (30.0, 0.8, 1.75)):
        expected = TRUE_MODEL.expected_pd(clutter, 0.1, contrast, threshold)
        assert model.expected_pd(clutter, 0.1, contrast, threshold) == pytest.approx(expected, abs=0.08)
    assert tuple(model.thresholds) == THRESHOLDS
    assert model.offsets == sorted(model.offsets, reverse=True)


def test_fit_without_an_influence_of_the_seabed() -> None:
    mines = [
        Mine(m.seabed, m.file, Difficulty(1.0, 60 - m.difficulty.clutter_per_1000_m2, 0.1, 1.0, 0.5), m.confidence)
        for m in drawn_mines(60, seed=2)
    ]
    assert fitted(mines).clutter_weight == 0.0
    mines = [Mine(SeabedKind.SAND, "a", Difficulty(1.0, 1.0, 0.1, 0.4, 0.5), 2.0) for _ in range(8)]
    assert fitted(mines).expected_pd(1.0, 0.1, 0.4, 1.0) > 0.9


def test_calibration_on_other_objects(model):
    rows = calibration(drawn_mines(200, seed=3), model)
    assert len(rows) == 2 * len(command.CALIBRATION_THRESHOLDS)
    for row in rows:
        assert row.objects == 400
        assert row.actual_interval is not None
        assert row.actual_interval[0] <= row.actual <= row.actual_interval[1]
        assert row.predicted == pytest.approx(row.actual, abs=0.1)


def test_objects_of_a_file_have_the_difficulty_of_their_side(monkeypatch):
    monkeypatch.setattr(command, "_VARIATIONS", ({"pings": 300, "samples": 400},))
    mines = mines_of_file(SeabedKind.SAND, 3)
    assert len(mines) == 4
    assert len({m.difficulty for m in mines}) <= 2
    assert all(m.difficulty.clutter_per_1000_m2 < 40 for m in mines)
    assert sum(m.confidence > 1.0 for m in mines) >= 3


def test_command_writes_a_model_and_prints_the_calibration(monkeypatch, tmp_path, capsys):
    seeds = []

    def simulated(first_seed, files):
        seeds.append(first_seed)
        return drawn_mines(20 * files, first_seed)

    monkeypatch.setattr(command, "simulated_mines", simulated)
    path = tmp_path / "model.json"
    assert command.main(["--files", "2", "--held-out", "1", "--out", str(path)]) == 0
    assert seeds == [FIRST_TRAINING_SEED, FIRST_SEED]
    output = capsys.readouterr().out
    assert "predicted Pd" in output
    written = json.loads(path.read_text("utf-8"))
    assert written["seeds"] == [FIRST_TRAINING_SEED, FIRST_TRAINING_SEED + 1]
    PdModel.model_validate_json(path.read_bytes(), strict=True)
    assert set(shipped.PdModel.model_fields) < set(written)
