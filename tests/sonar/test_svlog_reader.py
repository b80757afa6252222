"""Cerulean SVLOG: pairing, clock, navigation messages, scale, damage."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from builders.surveys import svlog_packet, svlog_position, svlog_profile, svlog_session

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import Side

RESULTS = np.array([0, 65_535])
HUGE = 10**400


def recording(tmp_path, *packets, session=None):
    path = tmp_path / "line.svlog"
    path.write_bytes((svlog_session() if session is None else session) + b"".join(packets))
    return path


def sides(survey):
    return ["".join(c.side.value[0] for c in ping.channels) for ping in survey]


def profile(number=1, clock_ms=1000000, channel=0, **values):
    return svlog_profile(number, clock_ms, channel, RESULTS, **values)


def nmea(text):
    total = 0
    for byte in text.encode():
        total ^= byte
    return svlog_packet(109, f"${text}*{total:02X}\r\n".encode())


def test_sides_are_paired_and_lost_profiles_leave_one_side(tmp_path):
    packets = [profile(n, 1_000_000 + 50 * n, n % 2) for n in range(8)]
    survey = read_survey(recording(tmp_path, *packets))
    assert (sides(survey), [p.number for p in survey]) == (["ps"] * 4, [0, 2, 4, 6])
    # A file that begins between two sides.
    times = [(0, 1), *((100 * n, side) for n in range(1, 6) for side in (0, 1))]
    survey = read_survey(recording(tmp_path, *(profile(t, 1_000_000 + t, c) for t, c in times)))
    assert sides(survey)[-3:] == ["ps"] * 3
    assert survey.pings[-1].time_utc_s - survey.pings[-2].time_utc_s == pytest.approx(0.1)
    times = [(0, 0), (0, 1), (100, 0), (200, 0), (200, 1), (300, 1), (400, 0), (400, 1)]
    survey = read_survey(recording(tmp_path, *(profile(t, 1_000_000 + t, c) for t, c in times)))
    assert sides(survey) == ["ps", "p", "ps", "s", "ps"]
    assert "only one side in 2 of 5 pings" in survey.warnings


def test_time_is_that_of_the_session_and_its_uptime(tmp_path):
    path = recording(tmp_path, profile(clock_ms=1_000_500), session=svlog_session("2013-09-10T21:13:00Z", 1000.0))
    assert read_survey(path).pings[0].time_utc_s == pytest.approx(1_378_847_580.5)
    session = svlog_session("2013-09-10T21:13:00")
    survey = read_survey(recording(tmp_path, profile(clock_ms=7), profile(clock_ms=1007), session=session))
    assert [p.time_utc_s for p in survey] == pytest.approx([1_378_847_580, 1_378_847_581])
    assert any("another clock" in w for w in survey.warnings)


def test_file_without_a_date_is_rejected(tmp_path):
    packets = (b"", svlog_packet(10, b"{}"), svlog_packet(10, b"[" * 9000))
    for session in (*packets, svlog_session("yesterday"), svlog_session("1950-01-01")):
        with pytest.raises(SurveyFileError, match=r"date|timestamp"):
            read_survey(recording(tmp_path, profile(), session=session))


def test_samples_are_amplitudes_of_decibels_and_the_start_is_padded(tmp_path):
    (ping,) = read_survey(recording(tmp_path, profile(min_db=20.0, max_db=60.0))).pings
    assert ping.channels[0].echo().tolist() == pytest.approx([10.0, 1000.0])
    assert ping.channels[0].samples.dtype == np.float32
    (ping,) = read_survey(recording(tmp_path, profile(start_mm=10_000, length_mm=10_000))).pings
    assert ping.channels[0].samples.tolist()[:2] == [0, 0]
    assert ping.channels[0].slant_range_m == pytest.approx(20.0)
    assert ping.channels[0].frequency_hz == 450_000


def test_navigation_ages(tmp_path):
    packets = [
        svlog_position(48.4, -68.8, 359.5, 1.5),
        profile(1),
        profile(2, 1_004_000),
        profile(3, 1_006_000, heading=12.5),
    ]
    survey = read_survey(recording(tmp_path, *packets))
    first, second, third = survey.pings
    assert (first.lat_deg, first.lon_deg) == pytest.approx((48.4, -68.8))
    assert first.heading_deg == pytest.approx(359.5)
    assert first.speed_mps == pytest.approx(1.5)
    assert second.lat_deg == pytest.approx(48.4)
    assert (third.lat_deg, third.speed_mps, third.heading_deg) == (None, None, 12.5)
    assert any(w.startswith("no position fix in 1 of 3") for w in survey.warnings)


def test_nmea_navigation(tmp_path):
    packets = [
        nmea("GPRMC,211300,A,4824.000,N,06848.000,W,2.0,90.0,100913,,"),
        nmea("GPHDT,33.5,T"),
        profile(1),
        nmea("GNGGA,211301,3324.000,S,15148.000,E,1,9,1.0,5.0,M,,M,,"),
        profile(2, 1_050_000),
        nmea("GNGGA,211301,3324.000,S,15148.000,E,0,9,1.0,5.0,M,,M,,"),
        svlog_packet(109, b"$GPHDT,99.0,T*00\r\n"),
        nmea("GPRMC"),
        profile(3, 1_060_000),
    ]
    survey = read_survey(recording(tmp_path, *packets))
    first, second, third = survey.pings
    assert (first.lat_deg, first.lon_deg, first.heading_deg) == pytest.approx((48.4, -68.8, 33.5))
    assert first.speed_mps == pytest.approx(1.0289, abs=1e-3)
    assert second.lat_deg is None  # farther than a vehicle can have moved
    assert (third.lat_deg, third.heading_deg) == (None, None)
    assert "ignored NMEA sentence: checksum (1 times)" in survey.warnings


@pytest.mark.parametrize(
    "payload",
    [b"", b"\xff", b"[1]", b'{"message": 5}', b"[" * 9000]
    + [
        json.dumps({"message": {"type": "GLOBAL_POSITION_INT", "lat": lat, "lon": 5, "hdg": hdg}}).encode()
        for lat, hdg in (("x", 65_535), (None, []), (1e300, 1e300), (True, -5), (HUGE, HUGE), (math.inf, math.nan))
    ],
)
def test_hostile_mavlink_is_ignored(tmp_path, payload):
    (ping,) = read_survey(recording(tmp_path, svlog_packet(150, payload), profile())).pings
    assert ping.lat_deg is None
    assert ping.heading_deg is None


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"min_db": 50.0, "max_db": 40.0}, "decibels"),
        ({"max_db": math.nan}, "decibels"),
        ({"max_db": 1e30}, "decibels"),
        ({"length_mm": 0}, "impossible range"),
        ({"start_mm": 200_000}, "impossible range"),
        ({"length_mm": 2**32 - 1}, "impossible range"),
        ({"channel": 2}, "channel 2"),
    ],
)
def test_impossible_profile_is_left_out(tmp_path, values, text):
    survey = read_survey(recording(tmp_path, profile(**values), profile(5)))
    assert [p.number for p in survey] == [5]
    assert any(text in w for w in survey.warnings)
    with pytest.raises(SurveyFileError, match=text):  # the refusal states what was skipped
        read_survey(recording(tmp_path, profile(**values)))


def test_damage_is_rejected(tmp_path):
    path = recording(tmp_path, profile(), profile(2))
    complete = path.read_bytes()
    session_bytes = len(svlog_session())
    for place, raw, field in (
        (0, b"X", "start"),
        (session_bytes + 20, b"\xff\xff", "checksum"),
        (session_bytes + 2, b"\xff\xff", "truncated"),
    ):
        damaged = bytearray(complete)
        damaged[place : place + len(raw)] = raw
        path.write_bytes(damaged)
        with pytest.raises(SurveyFileError, match=field):
            read_survey(path)
    for packet, field in ((profile(count=3), "number of results"), (svlog_packet(2198, bytes(20)), "at least 52")):
        with pytest.raises(SurveyFileError, match=field):
            read_survey(recording(tmp_path, packet))
    path.write_bytes(complete[:-1])
    survey = read_survey(path)
    assert (survey.sides(), len(survey.pings)) == ((Side.PORT,), 1)
    assert survey.warnings[0].startswith("the file ends inside its last packet")
