"""Cerulean SVLOG: pairing, clock, navigation messages, scale, damage."""

import json
import math

import numpy as np
import pytest
from builders.surveys import svlog_mavlink, svlog_packet, svlog_position, svlog_profile, svlog_session

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.readers import open_survey, read_survey
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


def sentence(text):
    total = 0
    for byte in text.encode():
        total ^= byte
    return f"${text}*{total:02X}\r\n"


def nmea(*texts):
    return svlog_packet(109, "".join(map(sentence, texts)).encode())


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
    assert (first.heading_deg, first.course_deg) == pytest.approx((359.5, 359.5), abs=0.3)
    assert first.speed_mps == pytest.approx(1.5, abs=0.005)
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
    assert (first.speed_mps, first.course_deg) == pytest.approx((1.0289, 90.0), abs=1e-3)
    assert second.lat_deg is None  # farther than a vehicle can have moved
    assert (third.lat_deg, third.heading_deg) == (None, None)
    assert "ignored NMEA sentence: checksum (1 times)" in survey.warnings


@pytest.mark.parametrize("talker", ["GP", "GN", "HE", "II"])
@pytest.mark.parametrize("ending", [True, False])
def test_nmea_sentences_of_any_talker_with_or_without_checksum(tmp_path, talker, ending):
    """Several sentences are in one packet, with spaces before them, and with different line ends."""
    texts = [
        "GGA,010203.00,3351.0000,S,15112.0000,E,4,12,0.7,3.0,M,20.0,M,,",
        "VTG,271.5,T,,M,4.0,N,7.4,K,A",
        "THS,33.5,A",
    ]
    lines = [sentence(talker + text).strip() for text in texts]
    lines = lines if ending else [line.partition("*")[0] for line in lines]
    for packet in ("\r\n".join(lines) + "\r\n", "  " + " \n ".join(lines) + "\0", "".join(lines)):
        survey = read_survey(recording(tmp_path, svlog_packet(109, packet.encode()), profile()))
        (ping,) = survey.pings
        assert (ping.lat_deg, ping.lon_deg, ping.heading_deg) == pytest.approx((-33.85, 151.2, 33.5))
        assert (ping.speed_mps, ping.course_deg) == pytest.approx((2.0578, 271.5), abs=1e-3)
        assert ("accepted NMEA sentence without checksum (3 times)" in survey.warnings) is not ending


@pytest.mark.parametrize(
    "text",
    [
        "GPHDT,33.5",
        "GPHDT,400,T",
        "GPTHS,33.5,V",
        "GPRMC,211300,V,4824.0,N,06848.0,W,2.0,90.0,100913",
        "GPGGA,1,4824.0,N,068",
        "GPGGA,1,4824.0,,06848.0,W,1",
        "GPGLL,4824.0,N,06848.0,W,211300,V",
        "GPVTG,,T,,M,0.1,N",
        "",
        "$",
        "\xff",
    ],
)
def test_incomplete_or_invalid_nmea_sentence_has_no_values(tmp_path, text):
    (ping,) = read_survey(recording(tmp_path, svlog_packet(109, f"${text}\r\n".encode("latin-1")), profile())).pings
    assert (ping.lat_deg, ping.heading_deg, ping.course_deg) == (None, None, None)


def test_course_needs_speed_and_attitude_is_that_of_the_vehicle(tmp_path):
    attitude = svlog_mavlink("ATTITUDE", yaw=-math.pi / 2, pitch=0.1, roll=-0.2)
    slow = nmea("GPRMC,211300,A,4824.000,N,06848.000,W,0.1,90.0,100913,,")
    (ping,) = read_survey(recording(tmp_path, attitude, slow, profile(heading=12.5))).pings
    assert (ping.heading_deg, ping.course_deg) == (pytest.approx(270), None)
    assert (ping.pitch_deg, ping.roll_deg) == pytest.approx((5.7296, -11.459), abs=1e-3)


@pytest.mark.parametrize("recorded", ["MAVLink", "NMEA"])
def test_without_a_heading_the_recorded_course_is_used(tmp_path, recorded):
    message = nmea("GPRMC,211300,A,4824.000,N,06848.000,W,2.0,315.0,100913,,")
    if recorded == "MAVLink":
        values = {"lat": 484000000, "lon": -688000000, "vx": 100, "vy": -100, "hdg": 65_535}
        message = svlog_mavlink("GLOBAL_POSITION_INT", **values)
    survey = read_survey(recording(tmp_path, *(p for n in range(9) for p in (message, profile(n, 1_000_000 + 50 * n)))))
    assert [ping.heading_deg for ping in survey] == pytest.approx([315.0] * 9)
    assert survey.pings[0].heading_sigma_deg == 10
    assert any("heading is that of the course over ground" in w for w in survey.warnings)


@pytest.mark.parametrize(
    "payload",
    [b"", b"\xff", b"[1]", b'{"message": 5}', b"[" * 9000]
    + [
        json.dumps({"message": {"type": "GLOBAL_POSITION_INT", "lat": lat, "lon": 5, "hdg": hdg}}).encode()
        for lat, hdg in (("x", 65_535), (None, []), (1e300, 1e300), (True, -5), (HUGE, HUGE), (math.inf, math.nan))
    ]
    + [
        json.dumps({"message": {"type": kind, "yaw": value, "time_unix_usec": value}}).encode()
        for kind in ("ATTITUDE", "SYSTEM_TIME", [], None)
        for value in ("x", 1e300, -1e300, HUGE, None, math.nan)
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


@pytest.mark.parametrize("channel", [0, 1, 7, 255])
@pytest.mark.parametrize("angle", [1.0, 90.0, 179.0, 181.0, 270.0, 359.0, -1.0, -90.0, -179.0, 450.0, -270.0])
def test_side_is_that_of_the_look_angle(tmp_path, channel, angle):
    side = Side.STARBOARD if angle in (1, 90, 179, 450, -270) else Side.PORT
    survey = read_survey(recording(tmp_path, profile(channel=channel, look_angle=angle), profile(2, look_angle=0.0)))
    assert survey.sides() == (side,)
    assert len(survey.pings) == 1
    assert f"only 1 transducer, to {side}" in survey.warnings
    assert "skipped profile: channel 0 has a look angle of 0 degrees, thus no side (1 times)" in survey.warnings


@pytest.mark.parametrize("angle", [0.0, 180.0, -180.0, 360.0, math.nan, math.inf])
def test_side_is_guessed_from_the_channel_number_if_no_profile_has_a_look_angle(tmp_path, angle):
    packets = [profile(n, 1_000_000 + 50 * n, channel, look_angle=angle) for n in range(3) for channel in (0, 1, 2)]
    survey = read_survey(recording(tmp_path, *packets))
    assert sides(survey) == ["ps"] * 3
    assert "side guessed from the channel number, without a look angle (6 times)" in survey.warnings
    assert "skipped profile: channel 2 has no look angle, thus no side (3 times)" in survey.warnings
    with_angle = profile(9, 1_009_000, 0, look_angle=90.0)
    survey = read_survey(recording(tmp_path, *packets, with_angle))
    assert [p.number for p in survey] == [9]


def test_transducers_of_one_side_are_kept_apart(tmp_path):
    packets = [profile(n, 1_000_000 + 50 * n, channel, look_angle=80.0) for n in range(3) for channel in (3, 5)]
    with open_survey(recording(tmp_path, *packets)) as source:
        assert [len(each.channels) for each in source.pings()] == [1] * 3
        assert [each.ping_count for each in source.info.channel_sets] == [3, 3]
        assert "only 2 transducers, to starboard" in source.info.warnings


def test_damaged_packets_are_left_out_with_their_place(tmp_path):
    packets = [profile(n, 1_000_000 + 50 * n) for n in range(4)]
    path = recording(tmp_path, *packets)
    complete = path.read_bytes()
    second = len(svlog_session()) + len(packets[0])
    for place, raw, note in (
        (second + 20, b"\xff\xff", f"packet at byte {second} is left out: checksum: got "),
        (second + 2, b"\xff\xff", f"no packet at bytes {second} to {second + len(packets[1]) - 1}"),
        (second, b"X", f"no packet at bytes {second} to {second + len(packets[1]) - 1}"),
    ):
        damaged = bytearray(complete)
        damaged[place : place + len(raw)] = raw
        path.write_bytes(damaged)
        survey = read_survey(path)
        assert [p.number for p in survey] == [0, 2, 3]
        assert survey.warnings[0].startswith(note)
    for packet, field in ((profile(count=3), "number of results"), (svlog_packet(2198, bytes(20)), "at least 52")):
        survey = read_survey(recording(tmp_path, packet, *packets))
        assert len(survey.pings) == 4
        assert field in survey.warnings[0]
        with pytest.raises(SurveyFileError, match=field):
            read_survey(recording(tmp_path, packet))
    path.write_bytes(complete[:-1])
    survey = read_survey(path)
    assert (survey.sides(), len(survey.pings)) == ((Side.PORT,), 3)
    assert survey.warnings[0].startswith("the file ends inside its last packet")


def test_samples_that_look_like_packets_hide_no_packet_after_damage(tmp_path):
    """The value 21058 is the bytes of the magic; a length and zeros follow it."""
    results = np.array([0x5242, 3000, 2198, 0] * 20 + [0] * 400)
    packets = [svlog_profile(n, 1_000_000 + 50 * n, 0, results) for n in range(8)]
    raw = bytearray(svlog_session() + b"".join(packets))
    raw[len(svlog_session()) + len(packets[0]) :][:3] = b"xxx"
    del raw[len(svlog_session()) + len(packets[0]) + 3]
    path = tmp_path / "line.svlog"
    path.write_bytes(raw)
    assert [p.number for p in read_survey(path)] == [0, 2, 3, 4, 5, 6, 7]
