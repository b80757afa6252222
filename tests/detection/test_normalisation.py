"""Normalisation of a side: cells, water column, seabed level."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonarpost.detection.normalisation import normalise_side
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

SETTINGS = DetectorSettings()


def test_normalised_seabed_is_flat_over_range(make_survey):
    grid = normalise_side(make_survey(), Side.PORT, SETTINGS)
    by_range = np.nanmedian(grid.level[:, 100:], axis=0)
    assert np.abs(by_range).max() < 0.35
    assert abs(float(np.nanmedian(grid.level))) < 0.05
    assert grid.level.dtype == np.float32


def test_water_column_is_masked_and_tracked_without_altitude(make_survey):
    tracked = normalise_side(make_survey(altitude=False), Side.PORT, SETTINGS)
    assert np.abs(tracked.first_return_cell * tracked.cell_across_m - 3.0).max() < 0.2
    grid = normalise_side(make_survey(), Side.STARBOARD, SETTINGS)
    first = 3.0 / grid.cell_across_m
    assert np.abs(grid.first_return_cell - first).max() <= 2
    assert np.isnan(grid.level[:, : int(first)]).all()
    assert np.isfinite(grid.level[:, int(first * 1.02) + 12 :]).all()


def test_cell_and_row_lengths(make_survey):
    grid = normalise_side(make_survey(), Side.PORT, SETTINGS)
    assert grid.samples_per_cell == 2
    assert grid.cell_across_m == pytest.approx(2 * 20.0 / 512)
    assert grid.row_along_m == pytest.approx(0.1, rel=0.02)
    assert grid.row_is_measured
    unknown = normalise_side(make_survey(navigation=False), Side.PORT, SETTINGS)
    assert not unknown.row_is_measured
    assert unknown.row_along_m == SETTINGS.assumed_row_along_m


def test_vehicle_that_hardly_moves_has_the_assumed_distance_between_pings(make_survey):
    survey = make_survey()
    still = [replace(ping, speed_mps=None, lat_deg=40 + 1e-12 * row) for row, ping in enumerate(survey.pings)]
    grid = normalise_side(replace(survey, pings=tuple(replace(p, lon_deg=-70.0) for p in still)), Side.PORT, SETTINGS)
    assert not grid.row_is_measured
    assert grid.row_along_m == SETTINGS.assumed_row_along_m


def test_missing_channel_and_short_ping_are_unknown_and_a_spike_is_removed(make_survey):
    survey = make_survey()
    pings = list(survey.pings)
    pings[50] = replace(pings[50], channels=())
    short = pings[60].channel(Side.PORT)
    pings[60] = replace(pings[60], channels=(ChannelPing(Side.PORT, short.samples[:300], short.slant_range_m),))
    grid = normalise_side(replace(survey, pings=tuple(pings)), Side.PORT, SETTINGS)
    assert np.isnan(grid.level[50]).all()
    assert np.isnan(grid.level[60, 150:]).all()
    assert np.isfinite(grid.level[60, 100:148]).all()
    assert np.isfinite(grid.level[[49, 51, 59, 61], 100:]).all()
    # A single spike is removed.
    samples = survey.pings[80].channel(Side.PORT).samples
    samples[301] = 65535
    spiked = normalise_side(survey, Side.PORT, SETTINGS)
    assert spiked.level[80, 150] < 2.0


def test_unusable_side_is_none():
    nines = np.full(200, 9, np.uint8)
    port = ((nines * 0, 20.0), (nines[:0], 20.0), (nines[:8], 20.0), (nines, 0.0))
    unusable = (ChannelPing(Side.STARBOARD, nines, 20.0), *(ChannelPing(Side.PORT, *each) for each in port))
    for channels in ((), *((channel,) for channel in unusable)):
        survey = Survey(Path("x"), "x", "x", tuple(Ping(i, float(i), channels, altitude_m=2.0) for i in range(20)))
        assert normalise_side(survey, Side.PORT, SETTINGS) is None


def test_invalid_settings_are_rejected():
    for name, value in (
        ("cell_across_m", 0.0),
        ("noise_window_m", (10.0, float("nan"))),
        ("confidence_threshold", 2.1),
        ("confidence_threshold", float("nan")),
        ("max_contacts", 0),
        ("highlight_sizes_m", ()),
        ("highlight_sizes_m", ((1.0, 0.0),)),
    ):
        with pytest.raises(ValueError, match=name):
            DetectorSettings(**{name: value})
