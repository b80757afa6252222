"""Positions of sensor and ship, recorded layback and headings in XTF recordings."""

import math
import struct
from dataclasses import replace

import pytest
from builders.xtf import write_xtf
from pyxtf import XTFPingHeader

from sonarpost.sonar.geometry import Position, offset_between_m, offset_position
from sonarpost.sonar.options import Mounting, SurveyOptions
from sonarpost.sonar.readers import open_survey, read_survey

HEADER, PACKET, PINGS = 1024, 512, 30
START = Position(48.4459, -68.8283)
STEP_M = 0.5
COURSE_DEG = 90.0
NOT_APPLIED = (
    "recorded layback of {} m is not applied: the sensor's position is the ship's (option recorded_layback = \"apply\")"
)


@pytest.fixture
def raw(small_survey, tmp_path):
    """Return a recording on a track to the east, with position and heading of the sensor but none of the ship."""
    write_xtf(small_survey(pings=PINGS), tmp_path / "plain.xtf")
    data = bytearray((tmp_path / "plain.xtf").read_bytes())
    with_fields(data, **dict.fromkeys(("ShipYcoordinate", "ShipXcoordinate", "ShipGyro"), 0.0))
    return with_position(data, "Sensor")


def with_fields(data, rows=range(PINGS), **values):
    """Set fields of the ping headers."""
    for row in rows:
        head = XTFPingHeader.from_buffer(data, HEADER + row * PACKET)
        for name, value in values.items():
            setattr(head, name, value)
    return data


def track(behind_m=0.0):
    start = offset_position(START, COURSE_DEG + 180, behind_m)
    return [offset_position(start, COURSE_DEG, row * STEP_M) for row in range(PINGS)]


def with_position(data, whose, behind_m=0.0):
    """Set the positions of the ship or of the sensor, behind the track by a distance."""
    for row, place in enumerate(track(behind_m)):
        fields = {f"{whose}Ycoordinate": place.lat_deg, f"{whose}Xcoordinate": place.lon_deg}
        with_fields(data, (row,), **fields)
    return data


def without_position(data, whose):
    return with_fields(data, **{f"{whose}Ycoordinate": 0.0, f"{whose}Xcoordinate": 0.0})


def read(tmp_path, data, **options):
    path = tmp_path / "line.xtf"
    path.write_bytes(data)
    return read_survey(path, SurveyOptions(**options))


def behind_m(survey):
    """Return how far each ping is behind the track, rounded to centimetres; None without a position."""
    found = []
    for ping, place in zip(survey, track(), strict=True):
        north_m, east_m = offset_between_m(Position(ping.lat_deg, ping.lon_deg), place)
        assert abs(north_m) < 0.2
        found.append(round(east_m, 1))
    return found


@pytest.mark.parametrize(("source", "other"), [("sensor", "ship"), ("ship", "sensor")])
def test_position_of_the_source_and_in_the_other_field(raw, tmp_path, source, other):
    with_position(raw, "Ship", 7.0)
    assert set(behind_m(read(tmp_path, raw, position_source=source))) == {0.0 if source == "sensor" else 7.0}
    assert read(tmp_path, raw, position_source=source).warnings == ()
    without_position(raw, source.title())
    assert read(tmp_path, raw, position_source=source).warnings == (
        "no position fix in 30 of 30 pings, the first in row 0",
        f'the file has the position of the {other}, not of the {source}: position_source = "{other}"',
    )
    assert read(tmp_path, raw, position_source=other).warnings == ()


def test_position_of_the_ship_if_the_sensor_has_none_in_any_ping(raw, tmp_path):
    with_position(raw, "Ship", 7.0)
    with_fields(raw, range(20), SensorYcoordinate=0.0, SensorXcoordinate=0.0)
    survey = read(tmp_path, raw)
    assert [ping.lat_deg is None for ping in survey] == [True] * 20 + [False] * 10
    without_position(raw, "Sensor")
    survey = read(tmp_path, raw)
    assert set(behind_m(survey)) == {7.0}
    note = 'positions are those of the ship, the file has none of the sensor (position_source = "ship")'
    assert survey.warnings == (note,)


@pytest.mark.parametrize("layback_m", [1.5, 45.0, 333.25, 800.0])
@pytest.mark.parametrize("sign", [1, -1])
def test_layback_of_positions_of_the_ship_is_applied_along_the_track(raw, tmp_path, layback_m, sign):
    data = with_fields(with_position(without_position(raw, "Sensor"), "Ship"), Layback=sign * layback_m)
    survey = read(tmp_path, data)
    assert behind_m(survey) == pytest.approx([layback_m] * PINGS, abs=0.06 + layback_m * 1e-4)
    assert survey.warnings[-1] == f"recorded layback of up to {layback_m:.4g} m is applied along the track"
    assert {ping.position_note for ping in survey} == {None}
    assert behind_m(read(tmp_path, data, recorded_layback="ignore")) == [0.0] * PINGS
    mounted = read(tmp_path, data, mounting=Mounting(layback_m=10.0))
    assert {ping.layback_m for ping in mounted} == {None}


@pytest.mark.parametrize(
    ("cable_m", "hundredths", "depth_m", "layback_m"),
    [(50, 0, 30.0, 40.0), (50, 99, 0.0, 50.99), (13, 255, 5.0, 12.0), (20, 0, 25.0, None), (65535, 0, 5.0, None)],
)
def test_length_of_the_cable_gives_a_layback(raw, tmp_path, cable_m, hundredths, depth_m, layback_m):
    with_position(without_position(raw, "Sensor"), "Ship")
    with_fields(raw, CableOut=cable_m, CableOutHundredths=hundredths, SensorDepth=depth_m)
    survey = read(tmp_path, raw)
    assert behind_m(survey) == pytest.approx([layback_m or 0.0] * PINGS, abs=0.06)
    depth = "and the depth" if depth_m else "alone, the depth is unknown"
    note = f"layback calculated from the length of the cable (CableOut) {depth}"
    assert (note in survey.warnings) is (layback_m is not None)
    # A recorded layback has precedence.
    assert set(behind_m(read(tmp_path, with_fields(raw, Layback=33.0)))) == {33.0}


def test_layback_beside_a_copy_of_the_position_of_the_ship_is_a_note(raw, tmp_path):
    with_fields(with_position(raw, "Ship"), Layback=45.0)
    survey = read(tmp_path, raw)
    assert survey.warnings == (NOT_APPLIED.format(45),)
    assert {ping.position_note for ping in survey} == {NOT_APPLIED.format(45)}
    assert set(behind_m(survey)) == {0.0}
    assert set(behind_m(read(tmp_path, raw, recorded_layback="apply"))) == {45.0}
    assert set(behind_m(read(tmp_path, raw, position_source="ship"))) == {45.0}
    for options in ({"recorded_layback": "ignore"}, {"mounting": Mounting(layback_m=45.0)}):
        survey = read(tmp_path, raw, **options)
        assert (survey.warnings, {ping.position_note for ping in survey}) == ((), {None})
    # An offset of the antenna is not the layback.
    with_position(raw, "Ship", -4.0)
    assert read(tmp_path, raw).warnings == (NOT_APPLIED.format(45),)
    # Less than a metre, or the length of the cable.
    assert read(tmp_path, with_fields(raw, Layback=0.9)).warnings == ()
    with_fields(raw, Layback=0.0, CableOut=50, SensorDepth=30.0)
    assert read(tmp_path, raw).warnings == (
        "layback calculated from the length of the cable (CableOut) and the depth",
        NOT_APPLIED.format(40),
    )


def test_layback_without_a_position_of_the_ship_is_a_note(raw, tmp_path):
    survey = read(tmp_path, with_fields(raw, Layback=45.0))
    reason = "the file has no position of the ship to tell whether the sensor's includes it"
    assert survey.warnings == (NOT_APPLIED.format(45).replace("the sensor's position is the ship's", reason),)
    assert survey.pings[0].position_note == survey.warnings[0]


def test_position_of_the_sensor_that_the_recorder_calculated_is_used_as_it_is(raw, tmp_path):
    with_fields(with_position(raw, "Ship", -45.0), Layback=45.0)
    survey = read(tmp_path, raw)
    assert (survey.warnings, {ping.position_note for ping in survey}) == ((), {None})
    assert set(behind_m(survey)) == {0.0}


def test_layback_of_projected_positions_in_feet(raw, tmp_path):
    struct.pack_into("<H", raw, 164, 0)
    for row in range(PINGS):
        ship = {"ShipXcoordinate": 984_250.0 + row / 0.3048, "ShipYcoordinate": 157_872.0}
        with_fields(raw, (row,), SensorXcoordinate=ship["ShipXcoordinate"] - 147.0, SensorYcoordinate=157_872.0, **ship)
    with_fields(raw, Layback=45.0)  # 147.6 feet
    assert read(tmp_path, raw, projected_crs="EPSG:2263").warnings == ()
    with_fields(raw, Layback=93.0)
    assert "layback of 93 m is not applied" in read(tmp_path, raw, projected_crs="EPSG:2263").warnings[0]
    without_position(raw, "Sensor")
    with open_survey(tmp_path / "line.xtf", SurveyOptions(projected_crs="EPSG:2263")) as source:
        before = [(ping.lat_deg, ping.lon_deg) for ping in source.pings()]
        assert source.info.grid.first_m == pytest.approx(((984_250 - 147) * 1200 / 3937, 157_872 * 1200 / 3937))
    after = read(tmp_path, raw, projected_crs="EPSG:2263")
    for (lat_deg, lon_deg), ping in zip(before, after, strict=True):
        off_m = offset_between_m(Position(lat_deg, lon_deg), Position(ping.lat_deg, ping.lon_deg))
        assert math.hypot(*off_m) == pytest.approx(93.0 - 147 * 1200 / 3937, abs=0.1)


def test_gyro_of_the_ship_is_the_heading_if_the_sensor_has_none(raw, tmp_path):
    survey = read(tmp_path, with_fields(raw, ShipGyro=87.5))
    assert ({ping.heading_deg for ping in survey}, {ping.gyro_deg for ping in survey}) == ({354.5}, {87.5})
    survey = read(tmp_path, with_fields(raw, SensorHeading=0.0))
    assert {(ping.heading_deg, ping.heading_sigma_deg) for ping in survey} == {(87.5, 3.0)}
    assert "heading is that of the ship's gyro" in survey.warnings[0]
    assert {ping.gyro_deg for ping in read(tmp_path, with_fields(raw, ShipGyro=360.0))} == {0.0}
    for gyro_deg in (400.0, -1.0, float("nan")):
        survey = read(tmp_path, with_fields(raw, ShipGyro=gyro_deg))
        assert {ping.gyro_deg for ping in survey} == {None}
        assert "course over ground" in survey.warnings[-1]


@pytest.mark.parametrize(
    "damage",
    [
        {"SensorHeading": 12.0},
        {"SensorYcoordinate": 10.0, "SensorXcoordinate": 20.0},
        {"Layback": 700.0, "CableOut": 99},
    ],
)
def test_one_damaged_ping_does_not_decide_what_a_recording_has(raw, tmp_path, damage):
    with_fields(with_position(without_position(raw, "Sensor"), "Ship"), SensorHeading=0.0, ShipGyro=87.5)
    survey = read(tmp_path, raw)
    damaged = read(tmp_path, with_fields(raw, (5,), **damage))
    assert damaged.warnings == survey.warnings
    one, other = ([repr(replace(ping, channels=())) for ping in each] for each in (survey, damaged))
    assert one[:5] + one[6:] == other[:5] + other[6:]
