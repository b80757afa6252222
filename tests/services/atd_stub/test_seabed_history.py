"""Difficulty of the seabed in the health of atd_stub."""

import pytest
from builders.common import eventually
from builders.joined_surveys import Box, split, survey_of

from sonarpost.detection.difficulty import Difficulty
from sonarpost.services.atd_stub.seabed_history import WORST_OF_S, SeabedHistory
from sonarpost.services.atd_stub.survey_detection import detect_in_survey

SAND = Difficulty(5000.0, 4.0, 0.1, 0.4, 0.95)
ROCK = Difficulty(5000.0, 50.0, 0.14, 1.2, 0.31)
GAUGES = ("expected_pd", "clutter_per_1000_m2", "ripple_strength", "worst_expected_pd")


def test_last_file_and_worst_of_the_last_hour():
    history = SeabedHistory()
    assert history.gauges(0.0) == {}
    assert history.warning() == ""
    history.add(ROCK, 10.0)
    history.add(SAND, 20.0)
    assert history.gauges(30.0) == dict(zip(GAUGES, (0.95, 4.0, 0.1, 0.31), strict=True))
    assert history.warning() == ""
    assert history.gauges(10.0 + WORST_OF_S)["worst_expected_pd"] == 0.31
    assert history.gauges(10.1 + WORST_OF_S)["worst_expected_pd"] == 0.95
    later = history.gauges(21.0 + WORST_OF_S)
    assert set(later) == set(GAUGES[:3])
    assert later["expected_pd"] == 0.95


def test_a_difficult_seabed_is_a_warning_and_an_unknown_one_has_no_gauges():
    history = SeabedHistory()
    history.add(ROCK, 10.0)
    assert history.warning() == "expected Pd 31 % on this seabed; a clean result does not mean no mines"
    history.add(None, 20.0)
    assert history.gauges(20.0) == {"worst_expected_pd": 0.31}
    assert history.warning() == ""


def test_health_has_the_difficulty_of_the_last_file(start_service, incoming, tmp_path, lines):
    (path,) = split(tmp_path, survey_of(200, Box(100)), (0, 200))
    service = start_service(confidence_threshold=1.9)
    expected = detect_in_survey(path, "0" * 64, "uuv-1", service.config).difficulty
    assert expected is not None
    assert not set(GAUGES) & set(service.health().gauges), "unknown before the first file"
    path.rename(incoming / path.name)
    eventually(lambda: "expected_pd" in service.health().gauges)
    health = service.health()
    assert health.gauges["expected_pd"] == health.gauges["worst_expected_pd"] == round(expected.expected_pd, 3)
    assert health.gauges["clutter_per_1000_m2"] == pytest.approx(expected.clutter_per_1000_m2, abs=0.01)
    assert health.gauges["ripple_strength"] == pytest.approx(expected.ripple_strength, abs=0.001)
    assert health.state == "ok", "a difficult seabed is not a failure"
    assert ("a clean result does not mean no mines" in health.detail) == (not expected.is_reliable)
    eventually(lambda: lines("File processed"))
    assert lines("File processed")[0]["expected_pd"] == f"{expected.expected_pd:.2f}"
