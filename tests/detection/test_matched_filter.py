"""Matched filter: response to objects, noise units, peaks."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sonarpost.detection.matched_filter import IntegralImage, in_noise_units, matched_response, peaks
from sonarpost.detection.normalisation import normalise_side
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import Side

SETTINGS = DetectorSettings()


def best_near(survey, ping=100, sample=250):
    grid = normalise_side(survey, Side.PORT, SETTINGS)
    response = matched_response(grid, SETTINGS)
    cell = sample // grid.samples_per_cell
    return float(response.score[ping - 8 : ping + 9, cell - 12 : cell + 13].max()), grid, response


pixels = st.one_of(st.floats(-100, 100, width=32), st.just(float("nan")))


images = hnp.arrays(np.float32, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9), elements=pixels)


@given(images, st.integers(-3, 2), st.integers(-4, 3), st.integers(1, 3), st.integers(1, 4))
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


def test_empty_or_too_distant_box_is_rejected():
    for rows, columns in (((0, 0), (0, 1)), ((0, 1), (2, 1)), ((-3, 1), (0, 1)), ((0, 1), (0, 5))):
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
    # An object does not raise its noise estimate.
    noise = rng.normal(size=(200, 200)).astype(np.float32)
    noise[90:110, 90:110] += 10
    assert in_noise_units(noise, (50, 50))[90:110, 90:110].mean() > 8


def test_tiny_and_flat_images_give_zero_and_an_image_without_values_stays_nan():
    for shape in ((1, 1), (3, 200), (200, 3), (5, 5)):
        assert np.all(in_noise_units(np.full(shape, 3.0, np.float32), (20, 20)) == 0)
    assert np.isnan(in_noise_units(np.full((20, 20), np.nan, np.float32), (8, 8))).all()


def test_response_to_object_with_shadow_exceeds_seabed(make_survey):
    with_object, grid, response = best_near(make_survey({}))
    assert with_object > 5 * SETTINGS.min_matched_response
    strongest = peaks(response, grid, SETTINGS, 1.0)[0]
    assert abs(strongest.row - 100) <= 4
    assert abs(strongest.cell * 2 - 250) <= 10
    empty, grid, response = best_near(make_survey())
    assert empty < 0.5 * with_object
    assert all(p.score < 0.5 * with_object for p in peaks(response, grid, SETTINGS, 1.0))


@pytest.mark.parametrize("half", [{"shadow": 1.0}, {"highlight": 1.0}, {"shadow_first": True}])
def test_response_to_partial_or_mirrored_signature_is_low(make_survey, half):
    complete, _, _ = best_near(make_survey({}))
    partial, _, _ = best_near(make_survey(half))
    assert partial < 0.6 * complete


def test_peaks_are_separated_sorted_and_above_threshold(make_survey):
    _, grid, response = best_near(make_survey({}, {"ping": 40, "sample": 350}))
    found = peaks(response, grid, SETTINGS, 1.5)
    assert [p.score for p in found] == sorted((p.score for p in found), reverse=True)
    assert min(p.score for p in found) >= 1.5
    positions_m = np.array([(p.row * grid.row_along_m, p.cell * grid.cell_across_m) for p in found])
    gaps = np.abs(positions_m[:, None] - positions_m[None]).max(axis=2)[~np.eye(len(found), dtype=bool)]
    assert gaps.min() > 0.4
