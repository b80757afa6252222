"""Heading from gyro and course, and recorded layback."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.sonar.geometry import Position, offset_between_m, offset_position
from sonarpost.sonar.navigation import HeadingChoice
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.survey import ChannelPing, Ping, Side

CHANNELS = (ChannelPing(Side.PORT, np.ones(4, np.uint8), 30.0),)


START = Position(48.0, 2.0)


def straight(direction_deg, *, pings=60, speed_mps=2.0, interval_s=0.5, start=START, **values):
    """Return the pings of a straight track."""
    made = []
    for row in range(pings):
        place = offset_position(start, direction_deg, row * interval_s * speed_mps)
        made.append(Ping(row, row * interval_s, CHANNELS, place.lat_deg, place.lon_deg, **values))
    return made


def applied(pings, **options):
    choice = HeadingChoice(SurveyOptions(**options))
    for ping in pings:
        choice.observe(ping)
    return choice, list(choice.apply(pings))


def degrees_between(one, other):
    return abs((one - other + 180) % 360 - 180)


@given(
    course_deg=st.floats(0, 359.9),
    speed_mps=st.floats(0.5, 8),
    lat_deg=st.floats(-75, 75),
    lon_deg=st.sampled_from((0.0, 2.0, 179.9999, -180.0)),
)
def test_course_from_the_positions_is_the_direction_of_the_track(course_deg, speed_mps, lat_deg, lon_deg):
    pings = straight(course_deg, speed_mps=speed_mps, start=Position(lat_deg, lon_deg))
    choice, found = applied(pings)
    assert choice.source == "course"
    assert all(degrees_between(ping.heading_deg, course_deg) < 0.2 for ping in found)
    assert {ping.heading_sigma_deg for ping in found} == {10.0}
    assert len(found) == len(pings)


def test_sources_in_their_order_and_by_option():
    pings = straight(90.0, heading_deg=91.0, gyro_deg=92.0, course_deg=93.0)
    assert applied(pings)[1] == pings, "the sensor's heading is used as it is"
    for source, heading_deg, sigma_deg in (("gyro", 92.0, 3.0), ("course", 93.0, 10.0)):
        choice, found = applied(pings, heading_source=source)
        assert {(ping.heading_deg, ping.heading_sigma_deg) for ping in found} == {(heading_deg, sigma_deg)}
        assert "(option heading_source)" in choice.warnings()[0]
    choice, found = applied(straight(90.0, gyro_deg=92.0, course_deg=93.0))
    assert {ping.heading_deg for ping in found} == {92.0}
    assert "the file has no heading of the sensor" in choice.warnings()[0]


def test_a_stationary_vehicle_has_no_course():
    _, found = applied(straight(90.0, speed_mps=0.0))
    assert {ping.heading_deg for ping in found} == {None}


def test_pings_without_positions_have_the_heading_that_is_recorded():
    pings = [Ping(n, float(n), CHANNELS) for n in range(5)]
    choice, found = applied(pings)
    assert (choice.source, choice.warnings(), found) == ("sensor", [], pings)


@given(course_deg=st.floats(0, 359.9), layback_m=st.floats(1, 300))
def test_layback_is_applied_against_the_course_and_not_against_the_heading(course_deg, layback_m):
    pings = straight(course_deg, heading_deg=(course_deg + 30) % 360, layback_m=layback_m)
    choice, found = applied(pings)
    for ship, towed in zip(pings, found, strict=True):
        north_m, east_m = offset_between_m(Position(ship.lat_deg, ship.lon_deg), Position(towed.lat_deg, towed.lon_deg))
        assert math.hypot(north_m, east_m) == pytest.approx(layback_m, rel=1e-4)
        behind_deg = math.degrees(math.atan2(east_m, north_m))
        assert degrees_between(behind_deg, course_deg + 180) < 0.2
        assert towed.heading_deg == ship.heading_deg
    assert "is applied along the track" in choice.warnings()[0]
