from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sonarpost.detection.matched_filter import IntegralImage, in_noise_units

values = st.one_of(st.floats(-100, 100, width=32), st.just(float("nan")))


@given(
    image=hnp.arrays(np.float32, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9), elements=values),
    top=st.integers(-3, 2),
    left=st.integers(-4, 3),
    height=st.integers(1, 3),
    width=st.integers(1, 4),
)
def test_means_are_those_of_the_plain_definition(image, top, left, height, width):
    bottom, right = min(top + height, 4), min(left + width, 5)
    got = IntegralImage(image, (3, 4)).mean((top, bottom), (left, right), 0.5)
    rows, columns = image.shape
    for r in range(rows):
        for c in range(columns):
            block = image[max(r + top, 0) : max(r + bottom, 0), max(c + left, 0) : max(c + right, 0)]
            known = block[np.isfinite(block)]
            if known.size >= max(1, 0.5 * (bottom - top) * (right - left)):
                assert got[r, c] == pytest.approx(known.mean(dtype=np.float64), abs=1e-3)
            else:
                assert np.isnan(got[r, c])


@pytest.mark.parametrize(("rows", "columns"), [((0, 0), (0, 1)), ((0, 1), (2, 1)), ((-3, 1), (0, 1)), ((0, 1), (0, 5))])
def test_a_box_that_is_empty_or_reaches_too_far_is_refused(rows, columns):
    with pytest.raises(ValueError, match="expected a non-empty span"):
        IntegralImage(np.ones((4, 4), np.float32), (2, 3)).mean(rows, columns)


def test_noise_comes_out_with_unit_deviation_wherever_its_level_and_strength_change():
    rng = np.random.default_rng(0)
    strength = np.where(np.arange(400) < 200, 1.0, 1.8)
    noise = (rng.normal(size=(300, 400)) * strength + np.linspace(0, 2, 400)).astype(np.float32)
    units = in_noise_units(noise, (40, 40))
    assert units[:, :150].std() == pytest.approx(1.0, abs=0.15)
    assert units[:, 250:].std() == pytest.approx(1.0, abs=0.15)
    assert abs(float(units[:, 60:140].mean())) < 0.2


def test_an_object_does_not_raise_the_noise_it_is_measured_against():
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(200, 200)).astype(np.float32)
    noise[90:110, 90:110] += 10
    assert in_noise_units(noise, (50, 50))[90:110, 90:110].mean() > 8


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (200, 3), (5, 5)])
def test_tiny_and_flat_pictures_give_zero_not_infinity(shape):
    assert np.all(in_noise_units(np.full(shape, 3.0, np.float32), (20, 20)) == 0)


def test_nothing_known_stays_unknown():
    assert np.isnan(in_noise_units(np.full((20, 20), np.nan, np.float32), (8, 8))).all()
