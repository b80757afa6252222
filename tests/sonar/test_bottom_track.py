"""Bottom tracking: altitude from the first return."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.bottom_track import altitudes_m, track_bottom
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey


def survey_of(rows, range_m=30.0):
    pings = tuple(
        Ping(i, i * 0.1, tuple(ChannelPing(side, row, range_m) for side in Side)) for i, row in enumerate(rows)
    )
    return Survey(Path("x"), "x", "x", pings)


def synthetic_echo(altitude_m, samples=600, range_m=30.0):
    """Return samples of a ring-down, a dark water column, and a bright seabed with speckle from `altitude_m` on."""
    rng = np.random.default_rng(1)
    centres = (np.arange(samples) + 0.5) * range_m / samples
    level = np.where(centres >= altitude_m[:, None], 90.0, 2.0)
    level[:, centres < 0.3] = 250
    return np.clip(level * rng.rayleigh(0.8, level.shape), 0, 255).astype(np.uint8)


def test_tracker_follows_sloping_bottom_and_ignores_fish_and_gaps():
    altitude = np.linspace(4.0, 9.0, 200)
    rows = synthetic_echo(altitude)
    assert np.abs(track_bottom(survey_of(rows)) - altitude).max() < 0.25
    rows[50:56, 60:66] = 255  # a school of fish at 3 m
    rows[100:110] = 0  # lost pings
    assert np.abs(track_bottom(survey_of(rows)) - altitude).max() < 0.25


def test_no_altitude_without_first_return():
    assert np.isnan(track_bottom(survey_of(np.full((60, 400), 80, np.uint8)))).all()
    assert np.isnan(track_bottom(survey_of(np.zeros((60, 400), np.uint8)))).all()
    assert track_bottom(Survey(Path("x"), "x", "x", ())).shape == (0,)
    for range_m in (0.2, 0.4001, 0.41, 0.5):  # the ringing alone
        assert np.isnan(track_bottom(survey_of(np.full((60, 12), 80, np.uint8), range_m))).all()
    # A long gap is not interpolated.
    rows = synthetic_echo(np.full(200, 7.0))
    rows[60:140] = 0
    tracked = track_bottom(survey_of(rows))
    assert np.isnan(tracked[80:120]).all()
    assert np.isfinite(tracked[:55]).all()


def test_sides_with_different_range_and_sampling():
    near = synthetic_echo(np.full(80, 6.0), samples=300, range_m=20.0)
    far = synthetic_echo(np.full(80, 6.0), samples=900, range_m=60.0)
    pings = tuple(
        Ping(i, i * 0.1, (ChannelPing(Side.PORT, near[i], 20.0), ChannelPing(Side.STARBOARD, far[i], 60.0)))
        for i in range(80)
    )
    assert np.abs(track_bottom(Survey(Path("x"), "x", "x", pings)) - 6.0).max() < 0.4


@pytest.mark.parametrize("kind", [SeabedKind.MUD, SeabedKind.ROCK])
def test_tracked_altitude_matches_simulation(kind):
    survey = simulate_survey(SurveySpec(seed=2, seabed=kind, pings=100, samples=256, targets=1, clutter=1)).survey
    truth = np.array([p.altitude_m for p in survey])
    assert np.median(np.abs(track_bottom(survey) - truth)) < 0.2


def test_recorded_altitude_has_precedence():
    survey = survey_of(synthetic_echo(np.full(60, 7.0)))
    pings = list(survey.pings)
    pings[5] = dataclasses.replace(pings[5], altitude_m=6.5)
    altitude = altitudes_m(dataclasses.replace(survey, pings=tuple(pings)))
    assert altitude[5] == 6.5
    assert altitude[6] == pytest.approx(7.0, abs=0.25)


@pytest.mark.realdata
def test_first_returns_of_recordings(data_dir):
    """The expected values were read from the images."""
    river = track_bottom(read_survey(data_dir / "surveys" / "000_1236.xtf"))
    assert np.isfinite(river).all()
    assert river[[100, 480, 1000, 1363]] == pytest.approx([6.7, 6.7, 4.1, 1.4], abs=0.5)
    dive = track_bottom(read_survey(data_dir / "surveys" / "scotsman-iver2.xtf"))
    assert dive[[10, 120, 260, 450]] == pytest.approx([13.9, 9.4, 4.3, 3.0], abs=0.6)
