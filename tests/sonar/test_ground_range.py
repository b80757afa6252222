"""Ground-range images, beam and range normalisation."""

from pathlib import Path

import numpy as np
import pytest

from sonarpost.sonar.ground_range import beam_normalised, ground_range_image, interval_means
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey


def survey_of(rows, range_m=50.0, scale=1.0):
    pings = tuple(Ping(i, i * 0.1, (ChannelPing(Side.PORT, row, range_m, scale=scale),)) for i, row in enumerate(rows))
    return Survey(Path("x"), "x", "x", pings)


def test_line_on_seabed_is_straight_with_changing_altitude():
    altitude_m = np.linspace(5, 15, 60)
    centres_m = (np.arange(1000) + 0.5) * 0.05
    ground_m = np.sqrt(np.maximum(centres_m**2 - altitude_m[:, None] ** 2, 0))
    rows = np.where(np.abs(ground_m - 20) < 0.15, 200, 10).astype(np.uint8)
    image = ground_range_image(survey_of(rows), Side.PORT, altitude_m, 0.1)
    assert set(np.nanargmax(image, axis=1)) <= {198, 199, 200, 201}
    # The ground range ends where the slant range ends.
    ends = np.isfinite(image).sum(axis=1)
    np.testing.assert_allclose(ends * 0.1, np.sqrt(50**2 - altitude_m**2), atol=0.11)


def test_resampling_keeps_mean_echo():
    rows = np.random.default_rng(0).integers(0, 255, (4, 900), dtype=np.uint8)
    image = ground_range_image(survey_of(rows, scale=0.5), Side.PORT, np.zeros(4), 0.5)
    assert image.mean() == pytest.approx(rows.mean() / 2, rel=1e-3)


def test_unknown_altitude_gives_nan_and_absent_side_no_columns():
    rows = np.full((3, 100), 7, np.uint8)
    image = ground_range_image(survey_of(rows), Side.PORT, np.array([5.0, np.nan, 5.0]), 0.5)
    assert np.isnan(image[1]).all()
    assert np.nanmax(np.abs(image[[0, 2]] - 7)) < 1e-4
    assert ground_range_image(survey_of(rows), Side.STARBOARD, np.full(3, 5.0), 0.5).shape == (3, 0)


def test_interval_mean_weights_partial_samples():
    samples = np.array([10, 20, 40, 80], np.uint8)
    edges = np.array([0.0, 0.5, 2.0, 2.25, 2.75, 4.0])
    np.testing.assert_allclose(interval_means(samples, edges), [10, (5 + 20) / 1.5, 40, 40, (10 + 80) / 1.25])
    # Beyond the samples, and for an empty interval.
    means = interval_means(np.array([10, 20], np.uint16), np.array([0.0, 0.0, 0.25, 1.0, 2.0, 2.5]))
    np.testing.assert_array_equal(means, [np.nan, 10, 10, 20, np.nan])


def test_invalid_spacing_and_number_of_altitudes_are_rejected():
    survey = survey_of(np.ones((2, 9), np.uint8))
    for spacing_m in (0.0, -1.0, 1e-9, float("nan")):
        with pytest.raises(ValueError, match="spacing"):
            ground_range_image(survey, Side.PORT, np.ones(2), spacing_m)
    with pytest.raises(ValueError, match="one for each"):
        ground_range_image(survey, Side.PORT, np.ones(3), 1.0)


def test_beam_normalisation_handles_changing_altitude():
    rng = np.random.default_rng(1)
    altitude_m = np.linspace(5, 15, 400)
    angle = np.arctan2((np.arange(300) + 0.5) * 0.1, altitude_m[:, None])
    echo = (1 + np.cos(3 * angle) ** 2) * 50 * rng.rayleigh(0.8, angle.shape)
    normalised = beam_normalised(echo.astype(np.float32), altitude_m, 0.1)
    for low in (0.2, 0.5, 0.8, 1.1):
        patch = normalised[(angle > low) & (angle < low + 0.1)]
        assert patch.mean() == pytest.approx(1, abs=0.05)
