"""Surveys with the kinds and receiver options that a survey contains only when they are named."""

import dataclasses
import math
from functools import cache

import numpy as np
import pytest

from sonarpost.extensions.simulation.seabed.midwater import SonarPath
from sonarpost.extensions.simulation.seabed.objects import (
    FURTHER_CLUTTER_KINDS,
    FURTHER_MINE_LIKE_KINDS,
    STRUCTURE_KINDS,
    ObjectKind,
    SeabedObject,
    random_object,
)
from sonarpost.extensions.simulation.seabed.survey import SimulatedSurvey, SurveySpec, echo_intensity, simulate_survey
from sonarpost.extensions.simulation.seabed.targets import place_object
from sonarpost.extensions.simulation.seabed.terrain import Seabed, SeabedKind
from sonarpost.sonar.survey import Side

SPEC = SurveySpec(seed=7, pings=150, samples=256, seabed=SeabedKind.SAND, targets=2, clutter=2, bits=16)
ALTITUDE_M = 5.0
DEFAULT = {
    "sand": [91, 69, 101, 16, 65, 46, 98, 41, 80, 50, 55, 117, 93, 34, 44, 56, 49, 84, 92, 91],
    "ripples": [107, 72, 121, 13, 37, 55, 105, 39, 63, 40, 57, 104, 78, 34, 62, 64, 58, 59, 71, 145],
    "gravel": [139, 78, 119, 22, 65, 57, 130, 48, 127, 95, 72, 178, 145, 45, 51, 79, 73, 87, 136, 105],
    "mud": [47, 36, 59, 10, 33, 24, 42, 18, 39, 31, 26, 58, 50, 20, 24, 29, 26, 37, 47, 47],
    "rock": [148, 69, 143, 30, 65, 46, 60, 46, 97, 151, 57, 83, 87, 34, 47, 57, 49, 116, 91, 255],
    "mixed": [58, 87, 124, 15, 65, 27, 97, 25, 99, 50, 32, 132, 80, 30, 44, 30, 59, 146, 91, 107],
}
"""Samples of surveys with the default values."""
SOLID = (ObjectKind.FINNED_CYLINDER, ObjectKind.FLUTED_CONE, ObjectKind.LOG, ObjectKind.TYRE, ObjectKind.CRAB_POT)


@pytest.mark.parametrize("kind", list(SeabedKind))
def test_default_values_give_the_same_survey(kind):
    spec = SurveySpec(seed=11, pings=60, samples=128, targets=2, clutter=1, seabed=kind)
    image = simulate_survey(spec).survey.waterfall(Side.PORT).astype(int)
    # Processors differ in the last bit of some functions; other random draws differ far more.
    assert np.abs(image[5::18, 40::20].ravel() - DEFAULT[kind.value]).max() <= 1


@cache
def flat_echo(*items: SeabedObject) -> np.ndarray:
    """Return the echo of a flat seabed with objects, starboard, 200 pings 0.1 m apart."""
    bed = Seabed(np.zeros((521, 1301), np.float32), np.full((521, 1301), 0.3, np.float32), 0.05, -3.0, -32.5)
    for item in items:
        place_object(bed, item)
    still = np.zeros(200)
    track = SonarPath(np.arange(200) * 0.1, still, np.full(200, ALTITUDE_M), still, still)
    return echo_intensity(bed, track, SurveySpec(samples=1024), 1)


@pytest.mark.parametrize("kind", SOLID)
def test_solid_kind_has_a_highlight_and_a_shadow_of_its_height(kind):
    across_m = 14.0
    # Parallel to the track.
    item = dataclasses.replace(random_object(kind, 10.0, across_m, np.random.default_rng(5)), orientation_deg=0.0)
    usual, image = flat_echo()[100], flat_echo(item)
    rows = image[100 - int(4 * item.length_m) : 101 + int(4 * item.length_m)]
    assert (rows > 2.5 * np.maximum(usual, 0.1)).any(axis=1).mean() > 0.5
    end_m = (across_m + item.width_m / 2) * ALTITUDE_M / (ALTITUDE_M - item.height_m)
    dark = np.flatnonzero((rows[:, 300:] < 0.3 * usual[300:]).any(axis=0)) + 300
    last_m = math.sqrt((dark.max() * 30 / 1024) ** 2 - ALTITUDE_M**2)
    assert across_m < last_m < end_m + 0.6
    assert last_m - across_m > 0.4 * (end_m - across_m)


def test_moored_sphere_casts_a_separate_shadow():
    sphere = SeabedObject(ObjectKind.MOORED_SPHERE, 10.0, 12.0, 0.8, 0.8, 1.8)
    usual, image = flat_echo()[100], flat_echo(sphere)
    ratio = image[100] / np.maximum(usual, 1e-6)

    def sample(ground_m: float, above_m: float = 0.0) -> int:
        return int(math.hypot(ground_m, ALTITUDE_M - above_m) / 30 * 1024)

    echo = sample(12.0, 1.4) - round(0.4 / 30 * 1024)
    assert ratio[echo - 3 : echo + 4].max() > 3
    # Rays along the lower and upper edge of the sphere reach the seabed at the ends of the shadow.
    middle = 12.0 * ALTITUDE_M / (ALTITUDE_M - 1.4)
    assert ratio[sample(middle) - 5 : sample(middle) + 6].max() < 0.1
    # Between the anchor with its shadow and the separate shadow, the seabed returns its usual echo.
    assert ratio[sample(13.8) : sample(14.2)].min() > 0.9
    assert ratio[sample(21.0) :].min() > 0.9
    # Far from the object, nothing changes.
    np.testing.assert_allclose(image[:60], np.broadcast_to(usual, (60, 1024)), rtol=1e-3)


def test_fish_school_is_bright_with_a_weak_shadow():
    school = SeabedObject(ObjectKind.FISH_SCHOOL, 10.0, 12.0, 4.0, 4.0, 2.2, seed=3)
    usual, image = flat_echo()[100], flat_echo(school)
    near = image[85:116] / np.maximum(usual, 0.05)
    assert (near[:, 300:] > 2.0).mean() > 0.002
    shadow = near[15, 500:600].min()
    assert 0.25 < shadow < 0.8


@cache
def clean_survey(spec: SurveySpec) -> SimulatedSurvey:
    return simulate_survey(spec, speckle=False)


@pytest.mark.parametrize("kind", STRUCTURE_KINDS)
def test_structure_changes_a_large_area(kind):
    spec = dataclasses.replace(SPEC, pings=600, targets=(), clutter=(kind,), range_m=50.0, ping_rate_hz=10.0)
    full, empty = clean_survey(spec), clean_survey(dataclasses.replace(spec, clutter=()))
    (item,) = full.truth
    assert not item.is_mine_like
    assert item.length_m > 5
    assert item.height_m <= 0.6 * spec.altitude_m
    before, after = (s.survey.waterfall(item.side).astype(float) for s in (empty, full))
    rows = np.flatnonzero((np.abs(after - before) > 0.3 * before.mean()).sum(axis=1) > 2)
    assert 10 < np.ptp(rows) <= (item.length_m * 1.3 + 4) / 0.15
    assert (np.abs(after - before) > 0.3 * before.mean()).sum() > 300
    assert (after < 0.5 * before).sum() > 50


def test_all_kinds_fit_into_one_survey():
    kinds = (ObjectKind.WRECK, *FURTHER_CLUTTER_KINDS)
    spec = dataclasses.replace(SPEC, pings=1000, samples=128, targets=FURTHER_MINE_LIKE_KINDS, clutter=kinds)
    truth = simulate_survey(spec).truth
    assert sorted(t.kind for t in truth) == sorted((*FURTHER_MINE_LIKE_KINDS, *kinds))
    assert {t.kind for t in truth if t.is_mine_like} == set(FURTHER_MINE_LIKE_KINDS)


def test_burial_tilt_and_scour_leave_positions_and_the_seabed():
    whole = simulate_survey(dataclasses.replace(SPEC, clutter=()), speckle=False)
    sunk = simulate_survey(dataclasses.replace(SPEC, clutter=(), burial=0.8, scour=1.0, tilt_deg=10), speckle=False)
    assert [(t.ping, t.kind, t.lat_deg) for t in whole.truth] == [(t.ping, t.kind, t.lat_deg) for t in sunk.truth]
    assert all(b.height_m < a.height_m for a, b in zip(whole.truth, sunk.truth, strict=True))
    for side in Side:
        one, other = whole.survey.waterfall(side), sunk.survey.waterfall(side)
        assert (np.abs(one - other) < 0.1 * one.mean()).mean() > 0.7


@cache
def images(**fields: object) -> tuple[np.ndarray, np.ndarray]:
    survey = simulate_survey(dataclasses.replace(SPEC, targets=0, clutter=0, **fields), speckle=False).survey
    return survey.waterfall(Side.PORT).astype(float), survey.waterfall(Side.STARBOARD).astype(float)


def test_gain_error_grows_with_range():
    usual, changed = images()[0], images(tvg_error=0.5)[0]
    ratio = changed.mean(axis=0) / usual.mean(axis=0)
    assert ratio[128] == pytest.approx(1.0, abs=0.02)
    assert ratio[230] == pytest.approx(math.sqrt(2 * 230 / 256), rel=0.02)
    assert ratio[64] == pytest.approx(math.sqrt(0.5), rel=0.03)


def test_gain_steps_scale_whole_pings():
    usual, changed = images()[0], images(gain_steps=4, gain_step_db=12.0)[0]
    ratio = changed[:, 100:200].mean(axis=1) / usual[:, 100:200].mean(axis=1)
    levels = np.flatnonzero(np.abs(np.diff(ratio)) > 0.01)
    assert 1 <= levels.size <= 4
    assert 10 ** (-6 / 20) - 0.01 < ratio.min() < ratio.max() < 10 ** (6 / 20) + 0.01
    assert images(gain_steps=0)[0].tolist() == usual.tolist()


def test_crosstalk_adds_the_other_side():
    port, starboard = images()
    mixed = images(crosstalk_db=-10.0)
    expected = np.sqrt(port**2 + 0.1 * starboard**2)
    assert np.abs(mixed[0] - expected)[expected < 30000].max() <= 2


def test_surface_return_is_a_line_at_the_depth_of_the_vehicle():
    usual, changed = images(water_depth_m=8.0)[0], images(water_depth_m=8.0, surface_return=1.0)[0]
    first = np.argmax((changed - usual) > 0.1 * usual[:, 100:].mean(), axis=1) * 30 / 256
    depth_m = [ping.depth_m for ping in simulate_survey(dataclasses.replace(SPEC, water_depth_m=8.0)).survey]
    assert np.abs(first - depth_m).mean() < 0.35
    np.testing.assert_array_equal(changed[:, :5], usual[:, :5])


def test_wide_beam_and_long_pulse_blur():
    usual, wide, long = images()[0], images(beam_width_deg=3.0)[0], images(pulse_sigma_samples=4.0)[0]

    def roughness(image: np.ndarray, axis: int) -> float:
        return float(np.abs(np.diff(image[:, 120:220], axis=axis)).mean())

    assert roughness(wide, 0) < 0.8 * roughness(usual, 0)
    assert roughness(long, 1) < 0.8 * roughness(usual, 1)
