"""Positions, distances, and the error ellipse of positions of samples."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import pyxtf
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod

from sonarpost.sonar.geometry import (
    Position,
    along_track_m,
    georeference,
    ground_position,
    ground_to_slant_range_m,
    offset_between_m,
    offset_position,
    ping_spacing_m,
    sample_slant_range_m,
    slant_to_ground_range_m,
)
from sonarpost.sonar.options import ErrorBudget, Mounting, SurveyOptions
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

GEOD = Geod(ellps="WGS84")


ORIGINS = st.builds(Position, st.floats(-80, 80), st.floats(-180, 179.99))


@given(origin=ORIGINS, bearing=st.floats(0, 360), distance=st.floats(0, 500))
def test_offsets_match_geodesic_within_1_mm_and_are_inverted(origin, bearing, distance):
    got = offset_position(origin, bearing, distance)
    lon_deg, lat_deg, _ = GEOD.fwd(origin.lon_deg, origin.lat_deg, bearing, distance)
    assert GEOD.inv(lon_deg, lat_deg, got.lon_deg, got.lat_deg)[2] < 1e-3
    assert -180 <= got.lon_deg < 180
    north, east = offset_between_m(origin, got)
    assert north == pytest.approx(distance * math.cos(math.radians(bearing)), abs=1e-3)
    assert east == pytest.approx(distance * math.sin(math.radians(bearing)), abs=1e-3)


def test_ground_range_assumes_flat_seabed():
    assert slant_to_ground_range_m(5.0, 3.0) == pytest.approx(4.0)
    np.testing.assert_allclose(slant_to_ground_range_m([3.0, 5.0, 13.0], [3.0, 3.0, 12.0]), [0.0, 4.0, 5.0])
    assert np.isnan(slant_to_ground_range_m(2.9, 3.0))


@given(st.floats(0, 500), st.floats(0.1, 100))
def test_slant_and_ground_range_conversions_are_inverse(ground, altitude):
    back = slant_to_ground_range_m(ground_to_slant_range_m(ground, altitude), altitude)
    # Near nadir the ground range is very sensitive to the slant range.
    assert np.nan_to_num(back) == pytest.approx(ground, abs=1e-5)


def sample_position(ping, side, sample_index, **changes):
    found = georeference(ping, side, sample_index, SurveyOptions(), **changes)
    return None if found is None else found.position


def ping_at(heading_deg, **changes):
    channels = tuple(ChannelPing(side, np.zeros(100, np.uint8), 50.0) for side in Side)
    ping = Ping(1, 0.0, channels, lat_deg=60.0, lon_deg=10.0, heading_deg=heading_deg, altitude_m=12.25)
    return dataclasses.replace(ping, **changes)


@pytest.mark.parametrize(
    ("heading", "side", "north", "east"),
    [(0, Side.PORT, 0, -1), (90, Side.STARBOARD, -1, 0), (225, Side.STARBOARD, math.sqrt(0.5), -math.sqrt(0.5))],
)
def test_sample_lies_abeam_on_its_side(heading, side, north, east):
    ping = ping_at(heading)
    index = 60
    slant_m = sample_slant_range_m(ping.channel(side), index)
    assert slant_m == pytest.approx(30.25)
    ground_m = math.sqrt(30.25**2 - 12.25**2)
    position = sample_position(ping, side, index)
    got = offset_between_m(Position(60.0, 10.0), position)
    assert got == pytest.approx((north * ground_m, east * ground_m), abs=1e-3)
    assert position == ground_position(ping, side, ground_m)


def test_no_position_without_navigation_or_the_channel_or_in_the_water_column():
    for missing in ("lat_deg", "lon_deg", "heading_deg", "altitude_m"):
        assert sample_position(dataclasses.replace(ping_at(0), **{missing: None}), Side.PORT, 60) is None
    assert sample_position(ping_at(0), Side.PORT, 20) is None
    assert sample_position(ping_at(0, channels=()), Side.PORT, 60) is None


def straight_line(step_m, count, digits=12, **changes):
    origin = Position(48.0, -68.0)
    places = (offset_position(origin, 30.0, row * step_m) for row in range(count))
    fixes = ((round(place.lat_deg, digits), round(place.lon_deg, digits)) for place in places)
    pings = tuple(Ping(row, row * 0.1, (), *fix, **changes) for row, fix in enumerate(fixes))
    return Survey(Path("x"), "x", "x", pings)


def test_along_track_distance_of_straight_line():
    np.testing.assert_allclose(along_track_m(straight_line(0.12, 300)), 0.12 * np.arange(300), atol=1e-3)
    assert ping_spacing_m(straight_line(0.12, 300)) == pytest.approx(0.12, rel=1e-4)


def test_coarse_fixes_do_not_lengthen_track():
    coarse = straight_line(0.12, 600, digits=5)  # steps of 1.1 m north and 0.75 m east
    first, *_ = places = [Position(p.lat_deg, p.lon_deg) for p in coarse]
    raw = [offset_between_m(first, place) for place in places]
    assert np.hypot(*np.diff(raw, axis=0).T).sum() > 1.2 * 0.12 * 599
    assert ping_spacing_m(coarse) == pytest.approx(0.12, rel=0.03)


def test_distance_is_interpolated_over_missing_fixes():
    survey = straight_line(0.12, 300)
    lost = {*range(5), 100, 101, 102, *range(290, 300)}
    pings = tuple(
        dataclasses.replace(p, lat_deg=None, lon_deg=None) if row in lost else p for row, p in enumerate(survey)
    )
    distance = along_track_m(dataclasses.replace(survey, pings=pings))
    np.testing.assert_allclose(distance, 0.12 * np.arange(300), atol=2e-3)


def test_distance_without_fixes_is_from_speed_and_time_or_unknown():
    survey = straight_line(1.0, 50, speed_mps=1.5)
    pings = [dataclasses.replace(p, lat_deg=None, lon_deg=None) for p in survey]
    pings[7] = dataclasses.replace(pings[7], speed_mps=None)
    without_fixes = dataclasses.replace(survey, pings=tuple(pings))
    np.testing.assert_allclose(along_track_m(without_fixes), 0.15 * np.arange(50), atol=1e-9)
    unknown = dataclasses.replace(survey, pings=tuple(dataclasses.replace(p, speed_mps=None) for p in pings))
    assert (along_track_m(unknown), ping_spacing_m(unknown), ping_spacing_m(straight_line(0.0, 5))) == (None,) * 3
    assert along_track_m(dataclasses.replace(survey, pings=())) is None


@pytest.mark.realdata
def test_track_speed_of_recording_matches_recorded_speed(data_dir):
    survey = read_survey(data_dir / "surveys" / "scotsman-iver2.xtf")
    speeds = [p.speed_mps for p in survey if p.speed_mps is not None]
    duration_s = survey.pings[-1].time_utc_s - survey.pings[0].time_utc_s
    assert along_track_m(survey)[-1] / duration_s == pytest.approx(np.mean(speeds), rel=0.05)


NO_ERRORS = dict.fromkeys(ErrorBudget.model_fields, 0.0)
FINE = 6000
"""Number of samples with which the sample spacing is negligible."""


def accurate_ping(**changes):
    channels = tuple(ChannelPing(side, np.zeros(FINE, np.uint8), 60.0) for side in Side)
    complete = Ping(1, 0.0, channels, 60.0, 10.0, heading_deg=30.0, altitude_m=12.0, speed_mps=1.5)
    return dataclasses.replace(complete, **changes)


def only_errors(**errors):
    return SurveyOptions(errors=ErrorBudget(**{**NO_ERRORS, **errors}))


def test_each_error_contribution():
    index = 3600  # 36 m of slant range
    slant = 36.005
    ground = math.sqrt(slant**2 - 144)
    cases = {
        "position_m": (5.0, 5.0, 5.0),
        "heading_deg": (2.0, 0.0, ground * math.radians(2)),
        "altitude_m": (0.3, 0.3 * 12 / ground, 0.0),
        "sound_speed": (0.01, 0.01 * slant**2 / ground, 0.0),
        "bottom_slope_deg": (3.0, ground * math.tan(math.radians(3)) * 12 / ground, 0.0),
        "time_s": (0.4, 0.0, 0.6),
    }
    for name, (value, across_m, along_m) in cases.items():
        got = georeference(accurate_ping(), Side.PORT, index, only_errors(**{name: value}))
        assert got.across_sigma_m == pytest.approx(across_m, abs=0.004), name
        assert got.along_sigma_m == pytest.approx(along_m, abs=1e-9), name
    whole = georeference(accurate_ping(), Side.PORT, index, SurveyOptions())
    assert whole.sigma_m == max(whole.across_sigma_m, whole.along_sigma_m) > 5
    near = georeference(accurate_ping(), Side.PORT, 1200.4, only_errors(altitude_m=0.2))
    far = georeference(accurate_ping(), Side.PORT, 5000, only_errors(altitude_m=0.2))
    assert far.across_sigma_m < 0.06
    assert 1.5 < near.across_sigma_m < 3, "large and finite near the nadir"


def test_error_ellipse_matches_monte_carlo():
    """Monte Carlo: positions are computed from inputs that are drawn from the error budget."""
    rng = np.random.default_rng(4)
    options = only_errors(position_m=1.0, heading_deg=2.0, altitude_m=0.3, sound_speed=0.01)
    got = georeference(accurate_ping(), Side.STARBOARD, 3600, options)
    north, east = [], []
    for _ in range(2000):
        sampled = accurate_ping(heading_deg=30 + rng.normal(0, 2), altitude_m=12 + rng.normal(0, 0.3))
        factor = 1 + rng.normal(0, 0.01)
        channels = tuple(dataclasses.replace(c, slant_range_m=60 * factor) for c in sampled.channels)
        place = georeference(dataclasses.replace(sampled, channels=channels), Side.STARBOARD, 3600, options)
        n, e = offset_between_m(got.position, place.position)
        north.append(n + rng.normal(0, 1))
        east.append(e + rng.normal(0, 1))
    bearing = math.radians(30 + 90)
    across = np.array(north) * math.cos(bearing) + np.array(east) * math.sin(bearing)
    along = np.array(east) * math.cos(bearing) - np.array(north) * math.sin(bearing)
    assert across.std() == pytest.approx(got.across_sigma_m, rel=0.08)
    assert along.std() == pytest.approx(got.along_sigma_m, rel=0.08)


def test_tracked_altitude_and_layback_increase_error():
    index = 3600
    without_altitude = accurate_ping(altitude_m=None)
    assert georeference(without_altitude, Side.PORT, index, SurveyOptions()) is None
    options = only_errors(altitude_m=0.1, tracked_altitude_m=1.0, layback_m=7.0)
    tracked = georeference(without_altitude, Side.PORT, index, options, tracked_altitude_m=12.0)
    own = georeference(accurate_ping(), Side.PORT, index, options)
    assert tracked.position == own.position
    assert tracked.across_sigma_m == pytest.approx(10 * own.across_sigma_m, rel=0.01)
    towed = options.model_copy(update={"mounting": Mounting(layback_m=50)})
    behind = georeference(accurate_ping(), Side.PORT, index, towed)
    assert behind.along_sigma_m == pytest.approx(math.hypot(7, 50 * 0.05))
    swing_m = 50 * math.sin(math.radians(3))
    assert behind.across_sigma_m == pytest.approx(math.hypot(own.across_sigma_m, swing_m))
    recorded = georeference(accurate_ping(layback_m=50), Side.PORT, index, options)
    assert (recorded.along_sigma_m, recorded.across_sigma_m) == (behind.along_sigma_m, behind.across_sigma_m)
    by_course = georeference(accurate_ping(heading_sigma_deg=10), Side.PORT, index, options)
    assert by_course.along_sigma_m == pytest.approx(by_course.ground_range_m * math.radians(10))


def test_no_position_outside_swath_in_water_column_or_at_poles():
    for index in (-1, FINE, 500, float("nan")):
        assert georeference(accurate_ping(), Side.PORT, index, SurveyOptions()) is None
    for lat_deg in (89.5, -90.0):
        assert georeference(accurate_ping(lat_deg=lat_deg), Side.PORT, 3600, SurveyOptions()) is None


@pytest.mark.realdata
def test_positions_of_recording_match_pyxtf_and_geographiclib(data_dir):
    """The reference is independent: pyxtf reads the file, pyproj computes the geodesic."""
    path = data_dir / "surveys" / "scotsman-iver2.xtf"
    _, packets = pyxtf.xtf_read(str(path))
    survey = read_survey(path)
    compared, worst_m = 0, 0.0
    for got, head in list(zip(survey, packets[pyxtf.XTFHeaderType.sonar], strict=True))[1::9]:
        assert (got.lat_deg, got.lon_deg) == (head.SensorYcoordinate, head.SensorXcoordinate)
        for side, number, sign in ((Side.PORT, 0, -90), (Side.STARBOARD, 1, 90)):
            channel = head.ping_chan_headers[number]
            for index in (400, 700, 1023):
                slant_m = (index + 0.5) * channel.SlantRange / channel.NumSamples
                if slant_m <= head.SensorPrimaryAltitude:
                    continue
                ground_m = math.sqrt(slant_m**2 - head.SensorPrimaryAltitude**2)
                lon, lat, _ = GEOD.fwd(
                    head.SensorXcoordinate, head.SensorYcoordinate, head.SensorHeading + sign, ground_m
                )
                place = georeference(got, side, index, SurveyOptions()).position
                _, _, off_m = GEOD.inv(lon, lat, place.lon_deg, place.lat_deg)
                worst_m, compared = max(worst_m, off_m), compared + 1
    assert compared > 250
    assert worst_m < 0.001


@pytest.mark.realdata
def test_labelled_point_of_wreck_lies_to_starboard(data_dir):
    channel, sample, row = map(int, (data_dir / "surveys" / "scotsman-iver2.xtf.hits").read_text().split())
    survey = read_survey(data_dir / "surveys" / "scotsman-iver2.xtf")
    side = (Side.PORT, Side.STARBOARD)[channel]
    target = survey.pings[row]
    found = georeference(target, side, sample, SurveyOptions())
    north, east = offset_between_m(Position(target.lat_deg, target.lon_deg), found.position)
    right = offset_position(Position(target.lat_deg, target.lon_deg), target.heading_deg + 90, 10)
    towards = offset_between_m(Position(target.lat_deg, target.lon_deg), right)
    assert (north * towards[0] + east * towards[1] > 0) is (side is Side.STARBOARD)
    assert math.hypot(north, east) == pytest.approx(found.ground_range_m, abs=0.001)
