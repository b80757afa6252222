"""Difficulty of the seabed: features on synthetic grids, the model of the expected Pd, search, strips and files."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.detection import detector, stream
from sonarpost.detection.detector import search
from sonarpost.detection.difficulty import (
    RELIABLE_PD,
    Difficulty,
    PdModel,
    combined,
    default_pd_model,
    seabed_difficulty,
    unreliable_text,
)
from sonarpost.detection.normalisation import LevelGrid
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.stream import FileOrigin, StreamDetector
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.source import InMemorySource
from sonarpost.sonar.survey import Side

pytestmark = pytest.mark.usefixtures("few_candidates")

ROW_M, CELL_M = 0.1, 0.06
ROWS, CELLS = 500, 450


def grid_of(level, row_m=ROW_M, cell_m=CELL_M):
    rows = np.zeros(len(level), dtype=np.int64)
    return LevelGrid(Side.PORT, level.astype(np.float32), rows, 1, cell_m, row_m, row_is_measured=True)


def places(row_m=ROW_M, cell_m=CELL_M, shape=(ROWS, CELLS)):
    return np.arange(shape[0])[:, None] * row_m, np.arange(shape[1])[None, :] * cell_m


def noise(shape=(ROWS, CELLS), seed=1):
    return np.random.default_rng(seed).normal(0.0, 0.6, shape)


def rated(level, matched=(), threshold=1.0, **sizes):
    found = seabed_difficulty(grid_of(level, **sizes), matched, threshold)
    assert found is not None
    return found


def test_flat_seabed_has_no_clutter_ripples_or_contrast():
    found = rated(np.zeros((ROWS, CELLS)))
    assert found.area_m2 == pytest.approx(ROWS * ROW_M * CELLS * CELL_M)
    assert (found.clutter_per_1000_m2, found.ripple_strength, found.contrast) == (0.0, 0.0, 0.0)
    assert rated(noise()).ripple_strength < 0.1


@pytest.mark.parametrize(("wavelength_m", "direction_deg"), [(0.6, 0), (1.0, 30), (1.7, 90), (1.0, 135)])
def test_ripples_of_any_wavelength_and_orientation(wavelength_m, direction_deg):
    along, across = places()
    direction = math.radians(direction_deg)
    phase = 2 * math.pi * (along * math.cos(direction) + across * math.sin(direction)) / wavelength_m
    assert rated(np.sin(phase)).ripple_strength > 0.9
    noisy = rated(0.5 * np.sin(phase) + noise()).ripple_strength
    assert 0.4 < noisy < rated(np.sin(phase)).ripple_strength
    weak = rated(0.1 * np.sin(phase) + noise()).ripple_strength
    assert weak < noisy


def test_long_undulations_and_a_border_are_not_ripples():
    along, across = places()
    assert rated(np.sin(2 * math.pi * along / 12.0) + 0 * across + noise()).ripple_strength < 0.15
    assert rated(np.where(along < 25.0, 1.0, -1.0) + 0 * across + noise()).ripple_strength < 0.15


def test_ripple_strength_does_not_depend_on_the_distance_between_pings():
    values = []
    for row_m in (0.05, 0.1, 0.2):
        shape = (round(50.0 / row_m), CELLS)
        along, across = places(row_m, CELL_M, shape)
        values.append(rated(np.sin(2 * math.pi * (along + across)), row_m=row_m).ripple_strength)
    assert max(values) - min(values) < 0.1


def test_clutter_is_counted_per_area_above_a_fixed_response():
    level = noise()
    area_m2 = ROWS * ROW_M * CELLS * CELL_M
    assert rated(level, [3.4] * 50).clutter_per_1000_m2 == 0.0
    assert rated(level, [3.5, 9.0, 2.0]).clutter_per_1000_m2 == pytest.approx(2000.0 / area_m2)
    half = level.copy()
    half[:, : CELLS // 2] = np.nan
    assert rated(half, [4.0] * 10).clutter_per_1000_m2 == pytest.approx(10_000.0 / (area_m2 / 2))


def test_contrast_of_patches():
    along, across = places()
    patches = np.where((along // 4 + across // 4) % 2 == 0, 0.8, -0.8)
    assert rated(patches).contrast == pytest.approx(0.8, abs=0.05)


def test_too_little_known_seabed_has_no_difficulty():
    unknown = np.full((ROWS, CELLS), np.nan)
    assert seabed_difficulty(grid_of(unknown), [], 1.0) is None
    assert seabed_difficulty(grid_of(noise((40, CELLS))), [], 1.0) is None, "4 m along the track"
    assert seabed_difficulty(grid_of(noise((ROWS, 16))), [], 1.0) is None
    scattered = noise()
    scattered[::3] = np.nan
    scattered[:, ::2] = np.nan
    assert seabed_difficulty(grid_of(scattered), [], 1.0) is None, "no tile"


@given(st.floats(0, 500), st.floats(0, 1), st.floats(0, 4), st.floats(0, 2), st.floats(0, 1))
def test_expected_pd_never_increases_with_difficulty_or_threshold(clutter, ripples, contrast, threshold, step):
    model = default_pd_model()
    at = model.expected_pd(clutter, ripples, contrast, threshold)
    assert 0.0 <= at <= 1.0
    assert model.expected_pd(clutter + 100 * step, ripples, contrast, threshold) <= at
    assert model.expected_pd(clutter, min(1.0, ripples + step), contrast, threshold) <= at
    assert model.expected_pd(clutter, ripples, contrast + step, threshold) <= at
    assert model.expected_pd(clutter, ripples, contrast, min(2.0, threshold + step)) <= at


def test_model_separates_sand_from_rock_and_extreme_odds_do_not_overflow():
    model = default_pd_model()
    sand, rock = model.expected_pd(4.0, 0.1, 0.41, 1.0), model.expected_pd(50.0, 0.14, 1.2, 1.0)
    assert sand > 0.8
    assert rock < sand - 0.2
    assert model.expected_pd(50.0, 0.14, 1.2, 0.1) > model.expected_pd(50.0, 0.14, 1.2, 1.9)
    weights = {"clutter_weight": 1000.0, "contrast_weight": 2.0, "ripple_weight": 1.0}
    model = PdModel(thresholds=[0.1, 1.9], offsets=[1000.0, -1000.0], **weights)
    assert (model.expected_pd(0.0, 0.0, 0.0, 0.0), model.expected_pd(1e9, 1.0, 9.0, 2.0)) == (1.0, 0.0)


def test_combined_is_weighted_by_area():
    one, other = Difficulty(100.0, 10.0, 0.2, 0.4, 0.9), Difficulty(300.0, 50.0, 0.4, 1.2, 0.5)
    found = combined([one, None, other])
    assert found == Difficulty(400.0, pytest.approx(40.0), pytest.approx(0.35), pytest.approx(1.0), pytest.approx(0.6))
    assert combined([None]) is None
    assert combined([]) is None
    assert not found.is_reliable
    assert one.is_reliable
    assert replace(one, expected_pd=RELIABLE_PD).is_reliable
    assert unreliable_text(0.618) == "expected Pd 62 % on this seabed; a clean result does not mean no mines"


def test_search_rates_each_side_at_its_threshold(one_object, make_survey, monkeypatch):
    survey, _ = one_object
    calls, original = [], detector.matched_response
    monkeypatch.setattr(detector, "matched_response", lambda *a: calls.append(1) or original(*a))
    low, high = (
        search(survey, DetectorSettings(confidence_threshold=c), SurveyOptions()).difficulties for c in (0.1, 1.9)
    )
    assert len(calls) == 2 * 2, "the matched filter runs once a side"
    assert set(low) == set(Side)
    silent = search(make_survey(scale=0.0), DetectorSettings(), SurveyOptions())
    assert silent.difficulties == {Side.PORT: None, Side.STARBOARD: None}, "no echoes"
    for side in Side:
        assert low[side].area_m2 == high[side].area_m2
        assert low[side].clutter_per_1000_m2 == high[side].clutter_per_1000_m2
        assert low[side].expected_pd > high[side].expected_pd
    assert low[Side.PORT].area_m2 == pytest.approx(200 * 0.1 * 16.7, rel=0.05)
    assert low[Side.PORT].clutter_per_1000_m2 > 0.0, "the object is an echo"


def results_of(*surveys, settings=None):
    found = StreamDetector(lambda survey, detection, origin: None, settings)
    results = []
    for survey in surveys:
        source = InMemorySource(survey, SurveyOptions())
        results.append(found.add_file(source, FileOrigin.of(source, survey.path.stem)))
    return results


def test_file_has_the_difficulty_of_its_strips(make_survey, monkeypatch):
    monkeypatch.setattr(stream, "STRIP_PINGS", 80)
    settings = DetectorSettings(join_overlap_pings=20)
    (result,) = results_of(make_survey(), settings=settings)
    spans = {(strip.first_row, strip.end_row) for strip in result.difficulties}
    assert len(result.difficulties) == 2 * len(spans) >= 4
    assert min(spans)[0] == 0
    assert max(spans)[1] == 200
    known = [strip.difficulty for strip in result.difficulties]
    assert result.difficulty == combined(known)
    pds = [d.expected_pd for d in known if d is not None]
    assert min(pds) <= result.difficulty.expected_pd <= max(pds)


def test_rows_of_a_joined_file_begin_at_its_first_ping(make_survey):
    survey = make_survey()
    files = [
        replace(survey, path=Path(f"{n}.xtf"), pings=survey.pings[rows])
        for n, rows in enumerate((slice(0, 110), slice(110, 200)))
    ]
    first, second = results_of(*files)
    assert second.joined
    assert {(s.first_row, s.end_row) for s in first.difficulties} == {(0, 110)}
    assert {(s.first_row, s.end_row) for s in second.difficulties} == {(0, 90)}
    # A short file has no difficulty.
    (result,) = results_of(replace(survey, pings=survey.pings[:30]))
    assert [strip.difficulty for strip in result.difficulties] == [None, None]
    assert result.difficulty is None
