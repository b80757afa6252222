from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.detection.candidates import (
    Candidate,
    FilterScores,
    Measurement,
    TextureMap,
    find_candidates,
    geometry_score,
    measure,
)
from sonarpost.detection.detector import CLUTTER, MINE_LIKE, classify, height_from_shadow_m
from sonarpost.detection.fusion import (
    FILTERS,
    FusionModel,
    clutter_levels,
    default_fusion_model,
    fused_confidences,
    log_scores,
    suppress_duplicates,
)
from sonarpost.detection.matched_filter import matched_response, peaks
from sonarpost.detection.normalisation import normalise_side
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.structures import find_structures
from sonarpost.sonar.survey import Side

SETTINGS = DetectorSettings()
scores = st.floats(0, 1000)


def box(**fields):
    """An object of `make_survey`, by the fields that differ from the default."""
    return fields


def best_near(survey, ping=100, sample=250):
    grid = normalise_side(survey, Side.PORT, SETTINGS)
    response = matched_response(grid, SETTINGS)
    cell = sample // grid.samples_per_cell
    return float(response.score[ping - 8 : ping + 9, cell - 12 : cell + 13].max()), grid, response


def test_an_object_with_its_shadow_answers_and_the_seabed_does_not(make_survey):
    with_object, grid, response = best_near(make_survey(box()))
    assert with_object > 5 * SETTINGS.least_matched
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
    assert found.cfar > 1.8
    assert found.shadow > 1.5
    assert geometry_score(found, grid, SETTINGS) == 1.0


def test_a_shadow_that_goes_on_along_track_counts_less(make_survey):
    def shadow_geometry(survey):
        _, grid, response = best_near(survey)
        peak = next(
            p for p in peaks(response, grid, SETTINGS, 0.5) if abs(p.row - 100) < 6 and abs(2 * p.cell - 250) < 16
        )
        return geometry_score(measure(grid, peak, SETTINGS), grid, SETTINGS)

    scar = [box(ping=p, highlight=1.0, pings=10) for p in range(40, 170, 10) if p != 100]
    assert shadow_geometry(make_survey(box(pings=10), *scar)) < 0.5 * shadow_geometry(make_survey(box(pings=10)))


five = st.tuples(scores, scores, scores, scores, scores)


@given(five, st.floats(-50, 50))
def test_confidence_stays_within_0_and_2(values, clutter):
    model = default_fusion_model()
    assert 0.0 <= model.confidence(model.evidence(FilterScores(*values)), clutter) <= 2.0


@given(five, st.integers(0, 4), st.floats(0, 100))
def test_confidence_never_falls_when_a_score_rises(values, which, more):
    model = default_fusion_model()
    raised = tuple(s + more if i == which else s for i, s in enumerate(values))
    assert model.evidence(FilterScores(*raised)) >= model.evidence(FilterScores(*values)) - 1e-12


def test_clutter_around_lowers_the_confidence_and_half_the_odds_are_one():
    model = FusionModel(-2.0, (1.0,) * len(FILTERS), 0.5, -3.0)
    assert model.confidence(2.0, 0.0) == pytest.approx(1.0)
    assert model.confidence(2.0, 4.0) == pytest.approx(2.0 / (1.0 + np.exp(2.0)))
    assert model.confidence(-1e6, 0.0) == 0.0
    assert log_scores(FilterScores(0.0, 1e9, 1.0, 1.0, 1.0))[:2] == (0.0, np.log(10.0))


@pytest.mark.parametrize(
    "wrong", [(0.0, (1.0,), 0.0, 0.0), (0.0, (1.0, 1, 1, 1, -1), 0.0, 0.0), (0.0, (1.0,) * 5, -1.0, 0.0)]
)
def test_weights_that_could_let_the_confidence_fall_are_refused(wrong):
    with pytest.raises(ValueError, match="weight"):
        FusionModel(*wrong)


def measured(row, cell, shadow_cells=10):
    return Measurement(row, cell, (row - 2, row + 3), (cell - 2, cell + 3), shadow_cells, False, 5.0, 3.0, 3.0)


def candidate(row, cell, shadow_cells=10):
    return Candidate(measured(row, cell, shadow_cells), FilterScores(5.0, 3.0, 3.0, 3.0, 1.0))


def test_one_place_gives_its_most_confident_candidate(make_survey):
    grid = normalise_side(make_survey(), Side.PORT, SETTINGS)
    near, far, behind = candidate(60, 110), candidate(150, 110), candidate(50, 160)
    in_shadow_of_it = candidate(51, 205)
    long_shadow = candidate(50, 160, shadow_cells=60)
    kept = suppress_duplicates([(1.1, candidate(50, 100)), (1.3, near), (1.2, far), (1.15, behind)], grid, SETTINGS)
    assert [c for c, _ in kept] == [1.3, 1.2, 1.15]
    assert kept[0][1] is near
    assert suppress_duplicates([(1.2, long_shadow), (1.1, in_shadow_of_it)], grid, SETTINGS) == [(1.2, long_shadow)]


def test_a_few_strong_neighbours_are_no_clutter_and_a_field_of_them_is(make_survey):
    grid = normalise_side(make_survey(), Side.PORT, SETTINGS)
    alone = [measured(100, 130)]
    few = [measured(20 + 60 * i, 40 + 60 * i) for i in range(3)]
    many = [measured(r, c) for r in range(10, 190, 31) for c in range(50, 240, 40)]

    def level_at_first(found):
        return clutter_levels(found, np.full(len(found), 7.0), grid, SETTINGS, floor=-2.0)[0]

    assert level_at_first(alone) == -2.0
    assert level_at_first([*alone, *few]) == -2.0
    assert level_at_first([*alone, *many]) == 7.0
    assert clutter_levels([], np.zeros(0), grid, SETTINGS, floor=-2.0).shape == (0,)


def test_parts_of_the_same_thing_are_not_clutter(make_survey):
    grid = normalise_side(make_survey(), Side.PORT, SETTINGS)
    parts = [measured(100 + i, 130 + j) for i in range(-6, 7, 3) for j in range(-8, 9, 4)]
    assert (clutter_levels(parts, np.full(len(parts), 7.0), grid, SETTINGS, floor=-2.0) == -2.0).all()


def test_texture_finds_an_object_and_not_the_seabed_nor_the_change_of_its_level(make_survey):
    grid = normalise_side(make_survey(box()), Side.PORT, SETTINGS)
    texture = TextureMap(grid)
    at_object = texture.anomaly(100, 125)
    elsewhere = [texture.anomaly(row, cell) for row in range(30, 180, 30) for cell in (80, 180, 210)]
    assert at_object > 3.0
    assert max(elsewhere) < 0.6 * at_object
    assert np.median(elsewhere) < 2.0


def test_texture_says_nothing_where_nothing_is_known(make_survey):
    grid = normalise_side(make_survey(), Side.PORT, SETTINGS)
    assert TextureMap(grid).anomaly(50, 0) == 0.0
    unknown = replace(grid, level=np.full_like(grid.level, np.nan))
    assert TextureMap(unknown).anomaly(100, 125) == 0.0


def test_candidates_come_with_every_score_and_an_object_is_the_best(make_survey):
    grid = normalise_side(make_survey(box()), Side.PORT, SETTINGS)
    found = find_candidates(grid, SETTINGS)
    best = max(zip(fused_confidences(found, grid, SETTINGS), found, strict=True), key=lambda c: c[0])
    assert best[0] > 1.5
    assert abs(best[1].measurement.row - 100) <= 4
    assert all(value > 0 for value in (getattr(best[1].scores, name) for name in FILTERS))


def test_a_wall_of_shadow_behind_a_bright_edge_is_a_structure_once(make_survey):
    rows = [box(ping=ping, pings=10, sample=200, samples=14, shadow_samples=180) for ping in range(60, 150, 10)]
    grid = normalise_side(make_survey(*rows), Side.PORT, SETTINGS)
    found = find_structures(grid)
    assert len(found) == 1
    one = found[0].candidate.measurement
    assert found[0].confidence > 1.0
    assert (one.rows[0], one.rows[1]) == (pytest.approx(55, abs=6), pytest.approx(145, abs=6))
    assert 2 * one.cells[1] == pytest.approx(207, abs=10)
    assert find_structures(normalise_side(make_survey(box()), Side.PORT, SETTINGS)) == []


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
