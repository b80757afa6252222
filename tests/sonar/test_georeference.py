"""Positions of samples and their error ellipse."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import pyxtf
from pyproj import Geod

from sonarpost.sonar.geometry import Position, georeference, offset_between_m, offset_position
from sonarpost.sonar.options import ErrorBudget, Mounting, SurveyOptions
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import ChannelPing, Ping, Side

NO_ERRORS = dict.fromkeys(ErrorBudget.model_fields, 0.0)
FINE = 6000  # so many samples that their own width does not count


def ping(**changes) -> Ping:
    channels = tuple(ChannelPing(side, np.zeros(FINE, np.uint8), 60.0) for side in Side)
    whole = Ping(1, 0.0, channels, 60.0, 10.0, heading_deg=30.0, altitude_m=12.0, speed_mps=1.5)
    return dataclasses.replace(whole, **changes)


def only(**errors) -> SurveyOptions:
    return SurveyOptions(errors=ErrorBudget(**{**NO_ERRORS, **errors}))


def test_each_contribution_alone():
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
        got = georeference(ping(), Side.PORT, index, only(**{name: value}))
        assert got.across_sigma_m == pytest.approx(across_m, abs=0.004), name
        assert got.along_sigma_m == pytest.approx(along_m, abs=1e-9), name
    assert georeference(ping(), Side.PORT, index, SurveyOptions()).drms_m > 7


def test_the_ellipse_holds_what_scattered_inputs_give():
    """Monte Carlo: inputs are drawn from the budget, positions computed from each."""
    rng = np.random.default_rng(4)
    options = only(position_m=1.0, heading_deg=2.0, altitude_m=0.3, sound_speed=0.01)
    got = georeference(ping(), Side.STARBOARD, 3600, options)
    north, east = [], []
    for _ in range(4000):
        drawn = ping(heading_deg=30 + rng.normal(0, 2), altitude_m=12 + rng.normal(0, 0.3))
        factor = 1 + rng.normal(0, 0.01)
        channels = tuple(dataclasses.replace(c, slant_range_m=60 * factor) for c in drawn.channels)
        place = georeference(dataclasses.replace(drawn, channels=channels), Side.STARBOARD, 3600, options)
        n, e = offset_between_m(got.position, place.position)
        north.append(n + rng.normal(0, 1))
        east.append(e + rng.normal(0, 1))
    bearing = math.radians(got.bearing_deg)
    across = np.array(north) * math.cos(bearing) + np.array(east) * math.sin(bearing)
    along = np.array(east) * math.cos(bearing) - np.array(north) * math.sin(bearing)
    assert across.std() == pytest.approx(got.across_sigma_m, rel=0.06)
    assert along.std() == pytest.approx(got.along_sigma_m, rel=0.06)


def test_near_the_nadir_the_deviation_stays_finite_and_is_large():
    just = georeference(ping(), Side.PORT, 1200.4, only(altitude_m=0.2))
    far = georeference(ping(), Side.PORT, 5000, only(altitude_m=0.2))
    assert far.across_sigma_m < 0.06
    assert 1.5 < just.across_sigma_m < 3


def test_a_tracked_altitude_is_less_certain_and_a_layback_counts():
    index = 3600
    bare = ping(altitude_m=None)
    assert georeference(bare, Side.PORT, index, SurveyOptions()) is None
    options = only(altitude_m=0.1, tracked_altitude_m=1.0, layback_m=7.0)
    tracked = georeference(bare, Side.PORT, index, options, tracked_altitude_m=12.0)
    own = georeference(ping(), Side.PORT, index, options)
    assert tracked.position == own.position
    assert tracked.across_sigma_m == pytest.approx(10 * own.across_sigma_m, rel=0.01)
    towed = options.model_copy(update={"mounting": Mounting(layback_m=50)})
    assert georeference(ping(), Side.PORT, index, towed).along_sigma_m == pytest.approx(7)


@pytest.mark.parametrize("index", [-1, FINE, 500, float("nan")])
def test_no_position_outside_the_swath_or_in_the_water(index):
    assert georeference(ping(), Side.PORT, index, SurveyOptions()) is None


@pytest.mark.parametrize("missing", ["lat_deg", "lon_deg", "heading_deg", "altitude_m"])
def test_no_position_without_navigation(missing):
    assert georeference(ping(**{missing: None}), Side.PORT, 3600, SurveyOptions()) is None
    assert georeference(ping(channels=()), Side.PORT, 3600, SurveyOptions()) is None


@pytest.mark.parametrize("lat", [89.5, -90.0])
def test_no_position_at_a_pole(lat):
    assert georeference(ping(lat_deg=lat), Side.PORT, 3600, SurveyOptions()) is None


@pytest.mark.realdata
def test_real_positions_agree_with_pyxtf_and_geographiclib(data_dir):
    """Every part of the way by other people's code: the file by pyxtf, the geodesic by pyproj."""
    path = data_dir / "surveys" / "scotsman-iver2.xtf"
    _, packets = pyxtf.xtf_read(str(path))
    geod = Geod(ellps="WGS84")
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
                lon, lat, _ = geod.fwd(
                    head.SensorXcoordinate, head.SensorYcoordinate, head.SensorHeading + sign, ground_m
                )
                place = georeference(got, side, index, SurveyOptions()).position
                _, _, off_m = geod.inv(lon, lat, place.lon_deg, place.lat_deg)
                worst_m, compared = max(worst_m, off_m), compared + 1
    assert compared > 250
    assert worst_m < 0.001


@pytest.mark.realdata
def test_the_labelled_point_of_the_wreck_lies_to_starboard(data_dir):
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
