from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.detect.contacts import CLUTTER, MINE_LIKE, classify, height_from_shadow_m
from sonarpost.detect.fusion import fused_confidence, suppress
from sonarpost.detect.highlight_shadow import matched_response, peaks
from sonarpost.detect.measure import Measured, measure
from sonarpost.detect.preprocess import preprocess
from sonarpost.detect.settings import DetectorSettings
from sonarpost.sonar.survey import Side

SETTINGS = DetectorSettings()
scores = st.floats(0, 1000)


def box(**fields):
    """An object of `make_survey`, by the fields that differ from the default."""
    return fields


def best_near(survey, ping=100, sample=250):
    grid = preprocess(survey, Side.PORT, SETTINGS)
    response = matched_response(grid, SETTINGS)
    cell = sample // grid.samples_per_cell
    return float(response.score[ping - 8 : ping + 9, cell - 12 : cell + 13].max()), grid, response


def test_an_object_with_its_shadow_answers_and_the_seabed_does_not(make_survey):
    with_object, grid, response = best_near(make_survey(box()))
    assert with_object > 2 * SETTINGS.matched_at_threshold
    strongest = peaks(response, grid, SETTINGS, 1.0)[0]
    assert abs(strongest.row - 100) <= 4
    assert abs(strongest.cell * 2 - 250) <= 10
    empty, grid, response = best_near(make_survey())
    assert empty < 0.5 * with_object
    assert all(p.score < 0.5 * with_object for p in peaks(response, grid, SETTINGS, 1.0))


@pytest.mark.parametrize("half", [box(shadow=1.0), box(highlight=1.0), box(shadow_first=True)])
def test_half_of_the_signature_or_its_mirror_image_answers_much_less(make_survey, half):
    whole, _, _ = best_near(make_survey(box()))
    part, _, _ = best_near(make_survey(half))
    assert part < 0.6 * whole


def test_peaks_are_apart_sorted_and_above_the_least(make_survey):
    _, grid, response = best_near(make_survey(box(), box(ping=40, sample=350)))
    found = peaks(response, grid, SETTINGS, 1.5)
    assert [p.score for p in found] == sorted((p.score for p in found), reverse=True)
    assert min(p.score for p in found) >= 1.5
    places = np.array([(p.row * grid.row_along_m, p.cell * grid.cell_across_m) for p in found])
    gaps = np.abs(places[:, None] - places[None]).max(axis=2)[~np.eye(len(found), dtype=bool)]
    assert gaps.min() > 0.4


def test_the_measured_extents_are_those_of_the_object(make_survey):
    _, grid, response = best_near(make_survey(box()))
    found = measure(grid, peaks(response, grid, SETTINGS, 3.0)[0], SETTINGS)
    assert found.rows[1] - found.rows[0] == pytest.approx(8, abs=2)
    assert 2 * (found.cells[1] - found.cells[0]) == pytest.approx(12, abs=4)
    assert 2 * found.shadow_cells == pytest.approx(30, abs=6)
    assert not found.shadow_is_cut
    assert found.cfar > SETTINGS.cfar_at_threshold
    assert found.shadow > SETTINGS.shadow_at_threshold


def test_a_shadow_that_goes_on_along_track_counts_less(make_survey):
    def shadow_score(survey):
        _, grid, response = best_near(survey)
        peak = next(
            p for p in peaks(response, grid, SETTINGS, 0.5) if abs(p.row - 100) < 6 and abs(2 * p.cell - 250) < 16
        )
        return measure(grid, peak, SETTINGS).shadow

    scar = [box(ping=p, highlight=1.0, pings=10) for p in range(40, 170, 10) if p != 100]
    assert shadow_score(make_survey(box(pings=10), *scar)) < 0.5 * shadow_score(make_survey(box(pings=10)))


@given(scores, scores, scores)
def test_confidence_stays_within_0_and_2(matched, cfar, shadow):
    assert 0.0 <= fused_confidence(matched, cfar, shadow, SETTINGS) <= 2.0


@given(st.tuples(scores, scores, scores), st.integers(0, 2), st.floats(0, 100))
def test_confidence_never_falls_when_a_score_rises(three, which, more):
    raised = tuple(s + more if i == which else s for i, s in enumerate(three))
    assert fused_confidence(*raised, SETTINGS) >= fused_confidence(*three, SETTINGS) - 1e-12


def test_confidence_is_one_at_the_operating_point_and_none_without_evidence():
    point = (SETTINGS.matched_at_threshold, SETTINGS.cfar_at_threshold, SETTINGS.shadow_at_threshold)
    assert fused_confidence(*point, SETTINGS) == pytest.approx(1.0)
    for missing in range(3):
        assert fused_confidence(*(0.0 if i == missing else 100.0 for i in range(3)), SETTINGS) == 0.0


def candidate(row, cell, shadow_cells=10):
    return Measured(row, cell, (row - 2, row + 3), (cell - 2, cell + 3), shadow_cells, False, 5.0, 3.0, 3.0)


def test_one_place_gives_its_most_confident_candidate(make_survey):
    grid = preprocess(make_survey(), Side.PORT, SETTINGS)
    near, far, behind = candidate(60, 110), candidate(150, 110), candidate(50, 160)
    in_shadow_of_it = candidate(51, 205)
    long_shadow = candidate(50, 160, shadow_cells=60)
    kept = suppress([(1.1, candidate(50, 100)), (1.3, near), (1.2, far), (1.15, behind)], grid, SETTINGS)
    assert [c for c, _ in kept] == [1.3, 1.2, 1.15]
    assert kept[0][1] is near
    assert suppress([(1.2, long_shadow), (1.1, in_shadow_of_it)], grid, SETTINGS) == [(1.2, long_shadow)]


def test_height_is_that_of_similar_triangles():
    # A 1 m object at 8 m ground range under a sonar at 5 m: its shadow ends at ground range 10 m.
    top, end = np.hypot(8.0, 5.0 - 1.0), np.hypot(10.0, 5.0)
    assert height_from_shadow_m(end - top, top, 5.0) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("length_m", "width_m", "height_m", "expected"),
    [
        (1.0, 0.5, 0.4, MINE_LIKE),
        (1.0, 0.5, None, MINE_LIKE),
        (6.0, 1.0, 0.4, CLUTTER),
        (1.0, 3.0, 0.4, CLUTTER),
        (1.0, 0.5, 3.0, CLUTTER),
        (1.0, 0.5, 0.02, CLUTTER),
        (2.0, 0.12, 0.4, CLUTTER),
        (0.1, 0.5, 0.4, CLUTTER),
    ],
)
def test_mine_like_is_a_matter_of_size_and_shape(length_m, width_m, height_m, expected):
    assert classify(length_m, width_m, height_m, SETTINGS) == expected
