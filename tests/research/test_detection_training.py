"""Training of the classifier: specifications, labels, pasted objects, calibration."""

import numpy as np
import pytest

from research.training.detection.calibrate import fitted_calibration
from research.training.detection.examples import (
    FIRST_SEED,
    IGNORED,
    SURVEYS,
    Examples,
    ObjectWindow,
    label_of,
    pasted_chip,
    random_spec,
    simulated_examples,
)
from sonarpost.detection.chips import FINE_CENTRE, WINDOW_CENTRE, WINDOW_SHAPE, GroundPlane
from sonarpost.detection.classifier import MINE_LIKE_OBJECT, OTHER_OBJECT, SEABED
from sonarpost.detection.matched_filter import Peak
from sonarpost.extensions.simulation.seabed.objects import ObjectKind
from sonarpost.extensions.simulation.seabed.survey import TruthObject
from sonarpost.sonar.survey import Side


def truth(kind=ObjectKind.SPHERE, ping=100, sample=300, length_m=1.0, orientation_deg=0.0):
    mine = kind is ObjectKind.SPHERE
    return TruthObject(kind, mine, Side.PORT, ping, sample, 0.0, 0.0, 10.0, length_m, 1.0, 0.5, orientation_deg)


def test_every_specification_is_valid_and_differs():
    specs = [random_spec(FIRST_SEED + number) for number in range(SURVEYS)]
    assert len({(s.range_m, s.seabed, s.bits, s.samples) for s in specs}) > 40
    assert {s.seabed for s in specs} == set(type(specs[0].seabed))
    assert any(s.burial > 0 for s in specs)
    assert any(s.scour == 0 for s in specs)


@pytest.mark.parametrize(
    ("item", "along_m", "across_m", "expected"),
    [
        (truth(), 0.0, 0.0, MINE_LIKE_OBJECT),
        (truth(), 1.0, -1.0, MINE_LIKE_OBJECT),
        (truth(), 2.0, 0.0, IGNORED),
        (truth(), 4.0, 0.0, SEABED),
        (truth(ObjectKind.LOG, length_m=6.0), 2.5, 0.0, OTHER_OBJECT),
        (truth(ObjectKind.LOG, length_m=6.0), 0.0, 2.9, IGNORED),
        (truth(ObjectKind.LOG, length_m=6.0, orientation_deg=90.0), 0.0, 2.9, OTHER_OBJECT),
        (truth(ObjectKind.WRECK, length_m=30.0), 10.0, 8.0, IGNORED),
        (truth(ObjectKind.WRECK, length_m=30.0), 10.0, -8.0, SEABED),
    ],
)
def test_label_follows_the_distance_from_the_object(item, along_m, across_m, expected):
    assert label_of([item], Side.PORT, 100 + along_m / 0.1, 300 + across_m / 0.03, 0.1, 0.03) == expected
    assert label_of([item], Side.STARBOARD, 100, 300, 0.1, 0.03) == SEABED


def test_pasted_object_adds_highlight_and_shadow_to_the_known_seabed():
    rng = np.random.default_rng(0)
    change = np.zeros(WINDOW_SHAPE, np.float32)
    row, column = WINDOW_CENTRE
    change[row - 4 : row + 4, column - 6 : column + 4] = 1.5
    change[row - 4 : row + 4, column + 4 : column + 20] = -3.5
    level, known = (rng.standard_normal(WINDOW_SHAPE) * 0.3).astype(np.float32), np.ones(WINDOW_SHAPE, np.float32)
    known[:, column + 30 :] = 0.0
    plane = GroundPlane(level, known, np.zeros(100), 0.1, 0.06)
    chip = pasted_chip(level, known, ObjectWindow(change, MINE_LIKE_OBJECT), plane, Peak(50, 50, 1.0, 1, 1), rng)
    fine = chip.fine[0, ..., 0] * 2
    centre = FINE_CENTRE
    assert fine[centre[0], centre[1]] > 0.7
    assert fine[centre[0] - 1 : centre[0] + 2, centre[1] + 9 : centre[1] + 14].mean() < -1.2
    assert abs(fine[:5, :10].mean()) < 0.3
    assert (fine[:, centre[1] + 31 :] == 0).all()


def test_survey_gives_examples_of_every_class(tmp_path):
    found = simulated_examples(FIRST_SEED + 1)
    assert set(found.label.tolist()) == {SEABED, OTHER_OBJECT, MINE_LIKE_OBJECT}
    found.save(tmp_path / "examples.npz")
    again = Examples.load(tmp_path / "examples.npz")
    for name in Examples.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))
    assert len(Examples.joined([found, again]).label) == 2 * len(found.label)


def test_calibration_finds_slope_and_offsets():
    rng = np.random.default_rng(0)
    outputs = rng.standard_normal((20_000, 3)) * 3
    odds = np.exp(outputs * 0.5 + np.array([0.0, -1.0, 0.7]))
    labels = (rng.random((20_000, 1)) > np.cumsum(odds / odds.sum(axis=1, keepdims=True), axis=1)).sum(axis=1)
    slope, offsets = fitted_calibration(outputs, np.minimum(labels, 2))
    assert slope == pytest.approx(0.5, abs=0.03)
    assert offsets == pytest.approx((0.0, -1.0, 0.7), abs=0.1)
