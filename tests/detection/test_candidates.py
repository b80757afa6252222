"""Candidates: classification, non-maximum suppression, measurement of highlight and shadow."""

from dataclasses import replace

import numpy as np
import pytest

from sonarpost.detection.candidates import (
    Candidate,
    Measurement,
    candidate_peaks,
    classified_candidates,
    distinct_candidates,
    measure,
)
from sonarpost.detection.classifier import default_classifier
from sonarpost.detection.detector import height_from_shadow_m
from sonarpost.detection.matched_filter import Peak, matched_response, peaks
from sonarpost.detection.normalisation import normalise_side
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import Side

SETTINGS = DetectorSettings()


def candidate(row, cell, p_mine_like, score=5.0):
    return Candidate(Peak(row, cell, score, 4, 6), p_mine_like, 0.5 * (1 - p_mine_like))


def test_measured_extent_matches_object(make_survey):
    grid = normalise_side(make_survey({}), Side.PORT, SETTINGS)
    found = measure(grid, peaks(matched_response(grid, SETTINGS), grid, SETTINGS, 3.0)[0], SETTINGS)
    assert isinstance(found, Measurement)
    assert found.rows[1] - found.rows[0] == pytest.approx(8, abs=2)
    assert 2 * (found.cells[1] - found.cells[0]) == pytest.approx(12, abs=4)
    assert 2 * found.shadow_cells == pytest.approx(30, abs=6)
    assert not found.shadow_is_cut
    assert found.scores.matched > 5
    assert found.scores.cfar > 1.8
    assert found.scores.shadow > 1.5


def test_object_has_the_greatest_probability_of_a_mine(make_survey):
    grid = normalise_side(make_survey({}), Side.PORT, SETTINGS)
    found = classified_candidates(matched_response(grid, SETTINGS), grid, SETTINGS, default_classifier())
    best = max(found, key=lambda c: c.confidence)
    assert best.confidence > 1.0
    assert abs(best.peak.row - 100) <= 20
    (placed,) = distinct_candidates(found, grid, SETTINGS, 0.5)
    assert abs(placed.measurement.row - 100) <= 4
    assert abs(2 * placed.measurement.cell - 250) <= 10
    assert all(0 <= c.p_mine_like <= 1 and 0 <= c.p_mine_like + c.p_other_object <= 1 + 1e-6 for c in found)
    elsewhere = [c for c in found if abs(c.peak.row - 100) > 30]
    assert elsewhere
    assert max(c.confidence for c in elsewhere) < 0.5 * best.confidence


def test_number_of_candidates_is_limited_by_length(make_survey, monkeypatch):
    monkeypatch.setattr("sonarpost.detection.candidates._MAX_PER_1000_PINGS", 100)
    grid = normalise_side(make_survey(), Side.PORT, SETTINGS)
    flat = replace(grid, level=np.zeros_like(grid.level))
    assert classified_candidates(matched_response(flat, SETTINGS), flat, SETTINGS, default_classifier()) == []
    assert distinct_candidates([], grid, SETTINGS, 0.1) == []
    response = matched_response(grid, SETTINGS)
    many = candidate_peaks(response, grid, SETTINGS.model_copy(update={"min_matched_response": 1e-6}))
    assert len(many) == 100
    assert [p.score for p in many] == sorted((p.score for p in many), reverse=True)


def test_most_confident_candidate_suppresses_its_neighbours(make_survey):
    grid = normalise_side(make_survey({"ping": 50}, {"ping": 150}), Side.PORT, SETTINGS)
    one, near, far = candidate(50, 125, 0.6), candidate(62, 130, 0.5), candidate(150, 125, 0.8)
    kept = distinct_candidates([one, near, far], grid, SETTINGS, 0.1)
    assert [placed.candidate for placed in kept] == [far, one]
    assert [placed.candidate for placed in distinct_candidates([one, near, far], grid, SETTINGS, 1.3)] == [far]
    # A candidate in the shadow of another is the same object.
    grid = normalise_side(make_survey({"shadow_samples": 150}), Side.PORT, SETTINGS)
    kept = distinct_candidates([candidate(100, 125, 0.9), candidate(100, 190, 0.7)], grid, SETTINGS, 0.1)
    assert [placed.candidate.p_mine_like for placed in kept] == [0.9]


def test_place_is_that_of_the_best_product_of_probability_and_response(make_survey):
    grid = normalise_side(make_survey({}), Side.PORT, SETTINGS)
    strong, confident = candidate(100, 125, 0.5, score=9.0), candidate(104, 133, 0.9, score=3.0)
    (kept,) = distinct_candidates([strong, confident], grid, SETTINGS, 0.1)
    assert kept.candidate is confident
    assert kept.measurement.scores.matched == 9.0
    unlikely = candidate(100, 125, 0.1, score=9.0)
    (kept,) = distinct_candidates([unlikely, confident], grid, SETTINGS, 0.1)
    assert kept.measurement.scores.matched == 3.0


def test_height_from_shadow_by_similar_triangles():
    # Sonar at 5 m, object of 1 m at 8 m ground range: its shadow ends at 10 m ground range.
    top, end = np.hypot(8.0, 5.0 - 1.0), np.hypot(10.0, 5.0)
    assert height_from_shadow_m(end - top, top, 5.0) == pytest.approx(1.0)
