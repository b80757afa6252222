"""Matched filter, candidates, fusion of their scores, structures, classification."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sonarpost.detection.candidates import (
    Candidate,
    FilterScores,
    Measurement,
    TextureMap,
    find_candidates,
    geometry_score,
    measure,
)
from sonarpost.detection.detector import CLUTTER, MINE_LIKE, classify, find_structures, height_from_shadow_m
from sonarpost.detection.fusion import (
    FILTERS,
    FusionModel,
    clutter_levels,
    default_fusion_model,
    fused_confidences,
    log_scores,
    suppress_duplicates,
)
from sonarpost.detection.matched_filter import IntegralImage, in_noise_units, matched_response, peaks
from sonarpost.detection.normalisation import normalise_side
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import Side

SETTINGS = DetectorSettings()
scores = st.floats(0, 1000)


def box(**fields):
    """Return an object for `make_survey`: the fields that differ from the default."""
    return fields


def best_near(survey, ping=100, sample=250):
    grid = normalise_side(survey, Side.PORT, SETTINGS)
    response = matched_response(grid, SETTINGS)
    cell = sample // grid.samples_per_cell
    return float(response.score[ping - 8 : ping + 9, cell - 12 : cell + 13].max()), grid, response


pixels = st.one_of(st.floats(-100, 100, width=32), st.just(float("nan")))


@given(
    image=hnp.arrays(np.float32, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9), elements=pixels),
    top=st.integers(-3, 2),
    left=st.integers(-4, 3),
    height=st.integers(1, 3),
    width=st.integers(1, 4),
)
def test_box_means_match_definition(image, top, left, height, width):
    bottom, right = min(top + height, 4), min(left + width, 5)
    got = IntegralImage(image, (3, 4)).mean((top, bottom), (left, right), 0.5)
    rows, columns = image.shape
    for r in range(rows):
        for c in range(columns):
            block = image[max(r + top, 0) : max(r + bottom, 0), max(c + left, 0) : max(c + right, 0)]
            finite = block[np.isfinite(block)]
            if finite.size >= max(1, 0.5 * (bottom - top) * (right - left)):
                assert got[r, c] == pytest.approx(finite.mean(dtype=np.float64), abs=1e-3)
            else:
                assert np.isnan(got[r, c])


@pytest.mark.parametrize(("rows", "columns"), [((0, 0), (0, 1)), ((0, 1), (2, 1)), ((-3, 1), (0, 1)), ((0, 1), (0, 5))])
def test_empty_or_too_distant_box_is_rejected(rows, columns):
    with pytest.raises(ValueError, match="expected a non-empty span"):
        IntegralImage(np.ones((4, 4), np.float32), (2, 3)).mean(rows, columns)


def test_noise_has_unit_deviation_with_changing_level_and_strength():
    rng = np.random.default_rng(0)
    strength = np.where(np.arange(400) < 200, 1.0, 1.8)
    noise = (rng.normal(size=(300, 400)) * strength + np.linspace(0, 2, 400)).astype(np.float32)
    units = in_noise_units(noise, (40, 40))
    assert units[:, :150].std() == pytest.approx(1.0, abs=0.15)
    assert units[:, 250:].std() == pytest.approx(1.0, abs=0.15)
    assert abs(float(units[:, 60:140].mean())) < 0.2


def test_object_does_not_raise_its_noise_estimate():
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(200, 200)).astype(np.float32)
    noise[90:110, 90:110] += 10
    assert in_noise_units(noise, (50, 50))[90:110, 90:110].mean() > 8


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (200, 3), (5, 5)])
def test_tiny_and_flat_images_give_zero(shape):
    assert np.all(in_noise_units(np.full(shape, 3.0, np.float32), (20, 20)) == 0)


def test_image_without_values_stays_nan():
    assert np.isnan(in_noise_units(np.full((20, 20), np.nan, np.float32), (8, 8))).all()


def test_response_to_object_with_shadow_exceeds_seabed(make_survey):
    with_object, grid, response = best_near(make_survey(box()))
    assert with_object > 5 * SETTINGS.min_matched_response
    strongest = peaks(response, grid, SETTINGS, 1.0)[0]
    assert abs(strongest.row - 100) <= 4
    assert abs(strongest.cell * 2 - 250) <= 10
    empty, grid, response = best_near(make_survey())
    assert empty < 0.5 * with_object
    assert all(p.score < 0.5 * with_object for p in peaks(response, grid, SETTINGS, 1.0))


@pytest.mark.parametrize("half", [box(shadow=1.0), box(highlight=1.0), box(shadow_first=True)])
def test_response_to_partial_or_mirrored_signature_is_low(make_survey, half):
    complete, _, _ = best_near(make_survey(box()))
    partial, _, _ = best_near(make_survey(half))
    assert partial < 0.6 * complete


def test_peaks_are_separated_sorted_and_above_threshold(make_survey):
    _, grid, response = best_near(make_survey(box(), box(ping=40, sample=350)))
    found = peaks(response, grid, SETTINGS, 1.5)
    assert [p.score for p in found] == sorted((p.score for p in found), reverse=True)
    assert min(p.score for p in found) >= 1.5
    positions_m = np.array([(p.row * grid.row_along_m, p.cell * grid.cell_across_m) for p in found])
    gaps = np.abs(positions_m[:, None] - positions_m[None]).max(axis=2)[~np.eye(len(found), dtype=bool)]
    assert gaps.min() > 0.4


def test_measured_extent_matches_object(make_survey):
    _, grid, response = best_near(make_survey(box()))
    found = measure(grid, peaks(response, grid, SETTINGS, 3.0)[0], SETTINGS)
    assert found.rows[1] - found.rows[0] == pytest.approx(8, abs=2)
    assert 2 * (found.cells[1] - found.cells[0]) == pytest.approx(12, abs=4)
    assert 2 * found.shadow_cells == pytest.approx(30, abs=6)
    assert not found.shadow_is_cut
    assert found.cfar > 1.8
    assert found.shadow > 1.5
    assert geometry_score(found, grid, SETTINGS) == 1.0


def test_geometry_score_is_low_for_extended_shadow(make_survey):
    def shadow_geometry(survey):
        _, grid, response = best_near(survey)
        peak = next(
            p for p in peaks(response, grid, SETTINGS, 0.5) if abs(p.row - 100) < 6 and abs(2 * p.cell - 250) < 16
        )
        return geometry_score(measure(grid, peak, SETTINGS), grid, SETTINGS)

    scar = [box(ping=p, highlight=1.0, pings=10) for p in range(40, 170, 10) if p != 100]
    assert shadow_geometry(make_survey(box(pings=10), *scar)) < 0.5 * shadow_geometry(make_survey(box(pings=10)))


five_scores = st.tuples(scores, scores, scores, scores, scores)


@given(five_scores, st.floats(-50, 50))
def test_confidence_is_between_0_and_2(values, clutter):
    model = default_fusion_model()
    assert 0.0 <= model.confidence(model.evidence(FilterScores(*values)), clutter) <= 2.0


@given(five_scores, st.integers(0, 4), st.floats(0, 100))
def test_evidence_never_decreases_with_a_score(values, which, more):
    model = default_fusion_model()
    raised = tuple(s + more if i == which else s for i, s in enumerate(values))
    assert model.evidence(FilterScores(*raised)) >= model.evidence(FilterScores(*values)) - 1e-12


def test_clutter_lowers_confidence_and_even_odds_give_one():
    model = FusionModel(-2.0, (1.0,) * len(FILTERS), 0.5, -3.0)
    assert model.confidence(2.0, 0.0) == pytest.approx(1.0)
    assert model.confidence(2.0, 4.0) == pytest.approx(2.0 / (1.0 + np.exp(2.0)))
    assert model.confidence(-1e6, 0.0) == 0.0
    assert log_scores(FilterScores(0.0, 1e9, 1.0, 1.0, 1.0))[:2] == (0.0, np.log(10.0))


@pytest.mark.parametrize(
    "wrong", [(0.0, (1.0,), 0.0, 0.0), (0.0, (1.0, 1, 1, 1, -1), 0.0, 0.0), (0.0, (1.0,) * 5, -1.0, 0.0)]
)
def test_weights_that_decrease_confidence_are_rejected(wrong):
    with pytest.raises(ValueError, match="weight"):
        FusionModel(*wrong)


def measurement(row, cell, shadow_cells=10):
    return Measurement(row, cell, (row - 2, row + 3), (cell - 2, cell + 3), shadow_cells, False, 5.0, 3.0, 3.0)


def candidate(row, cell, shadow_cells=10):
    return Candidate(measurement(row, cell, shadow_cells), FilterScores(5.0, 3.0, 3.0, 3.0, 1.0))


def test_most_confident_candidate_suppresses_its_neighbours(make_survey):
    grid = normalise_side(make_survey(), Side.PORT, SETTINGS)
    near, far, behind = candidate(60, 110), candidate(150, 110), candidate(50, 160)
    in_shadow_of_it = candidate(51, 205)
    long_shadow = candidate(50, 160, shadow_cells=60)
    kept = suppress_duplicates([(1.1, candidate(50, 100)), (1.3, near), (1.2, far), (1.15, behind)], grid, SETTINGS)
    assert [c for c, _ in kept] == [1.3, 1.2, 1.15]
    assert kept[0][1] is near
    assert suppress_duplicates([(1.2, long_shadow), (1.1, in_shadow_of_it)], grid, SETTINGS) == [(1.2, long_shadow)]


def test_clutter_level_needs_many_neighbours(make_survey):
    grid = normalise_side(make_survey(), Side.PORT, SETTINGS)
    alone = [measurement(100, 130)]
    few = [measurement(20 + 60 * i, 40 + 60 * i) for i in range(3)]
    many = [measurement(r, c) for r in range(10, 190, 31) for c in range(50, 240, 40)]

    def level_at_first(found):
        return clutter_levels(found, np.full(len(found), 7.0), grid, SETTINGS, floor=-2.0)[0]

    assert level_at_first(alone) == -2.0
    assert level_at_first([*alone, *few]) == -2.0
    assert level_at_first([*alone, *many]) == 7.0
    assert clutter_levels([], np.zeros(0), grid, SETTINGS, floor=-2.0).shape == (0,)


def test_parts_of_one_object_are_not_clutter(make_survey):
    grid = normalise_side(make_survey(), Side.PORT, SETTINGS)
    parts = [measurement(100 + i, 130 + j) for i in range(-6, 7, 3) for j in range(-8, 9, 4)]
    assert (clutter_levels(parts, np.full(len(parts), 7.0), grid, SETTINGS, floor=-2.0) == -2.0).all()


def test_texture_anomaly_of_object_exceeds_seabed(make_survey):
    grid = normalise_side(make_survey(box()), Side.PORT, SETTINGS)
    texture = TextureMap(grid)
    at_object = texture.anomaly(100, 125)
    elsewhere = [texture.anomaly(row, cell) for row in range(30, 180, 30) for cell in (80, 180, 210)]
    assert at_object > 3.0
    assert max(elsewhere) < 0.6 * at_object
    assert np.median(elsewhere) < 2.0


def test_texture_anomaly_of_unknown_area_is_zero(make_survey):
    grid = normalise_side(make_survey(), Side.PORT, SETTINGS)
    assert TextureMap(grid).anomaly(50, 0) == 0.0
    unknown = replace(grid, level=np.full_like(grid.level, np.nan))
    assert TextureMap(unknown).anomaly(100, 125) == 0.0


def test_candidates_have_every_score_and_object_is_best(make_survey):
    grid = normalise_side(make_survey(box()), Side.PORT, SETTINGS)
    found = find_candidates(grid, SETTINGS)
    best = max(zip(fused_confidences(found, grid, SETTINGS), found, strict=True), key=lambda c: c[0])
    assert best[0] > 1.5
    assert abs(best[1].measurement.row - 100) <= 4
    assert all(value > 0 for value in (getattr(best[1].scores, name) for name in FILTERS))


def test_long_shadow_behind_bright_edge_is_one_structure(make_survey):
    rows = [box(ping=ping, pings=10, sample=200, samples=14, shadow_samples=180) for ping in range(60, 150, 10)]
    grid = normalise_side(make_survey(*rows), Side.PORT, SETTINGS)
    found = find_structures(grid)
    assert len(found) == 1
    structure = found[0].candidate.measurement
    assert found[0].confidence > 1.0
    assert (structure.rows[0], structure.rows[1]) == (pytest.approx(55, abs=6), pytest.approx(145, abs=6))
    assert 2 * structure.cells[1] == pytest.approx(207, abs=10)
    assert find_structures(normalise_side(make_survey(box()), Side.PORT, SETTINGS)) == []


def test_height_from_shadow_by_similar_triangles():
    # Sonar at 5 m, object of 1 m at 8 m ground range: its shadow ends at 10 m ground range.
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
def test_classification_by_size_and_shape(length_m, width_m, height_m, expected):
    assert classify(length_m, width_m, height_m, SETTINGS) == expected
