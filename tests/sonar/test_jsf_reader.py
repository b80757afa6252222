"""EdgeTech JSF: subsystems, data formats, versions, validity, damage."""

import math
import struct

import numpy as np
import pytest
from builders.surveys import jsf_message, jsf_other

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import Side

ENVELOPE = np.array([1, 2, 3, 40_000], np.uint16)
ALL_VALID = 0b0110_0011_0110_1101


def recording(tmp_path, *messages):
    path = tmp_path / "line.jsf"
    path.write_bytes(b"".join(messages))
    return path


def read_one(tmp_path, samples=ENVELOPE, **values):
    (ping,) = read_survey(recording(tmp_path, jsf_message(7, 20, 0, samples, **values))).pings
    return ping


LOW, HIGH = {"start": 22_000, "end": 24_000}, {"start": 52_000, "end": 56_000}


def both_frequencies(numbers, samples=ENVELOPE, high=ENVELOPE):
    """Return messages of two subsystems, in changing order."""
    messages = []
    for number in numbers:
        messages += [jsf_message(number, 21, 0, high, **HIGH), jsf_message(number, 20, 0, samples, **LOW)]
        messages += [jsf_message(number, 20, 1, samples, **LOW), jsf_message(number, 21, 1, high, **HIGH)]
    return messages


def test_both_frequencies_are_channel_sets_of_one_ping(tmp_path):
    low, high = ENVELOPE, np.arange(8, dtype=np.uint16)
    path = recording(tmp_path, *both_frequencies((2, 3), low, high), jsf_message(9, 20, 0, low, **LOW))
    survey = read_survey(path)
    assert [(p.number, [(c.side, c.samples.size, c.frequency_hz, c.index) for c in p.channels]) for p in survey] == [
        (number, [(side, 8, 540e3, 21) for side in Side]) for number in (2, 3)
    ]
    assert any("2 channel sets: 540 kHz in 2 pings; 230 kHz in 3 pings" in w for w in survey.warnings)
    assert "left out pings without a channel of 540 kHz: 1" in survey.warnings
    survey = read_survey(path, SurveyOptions(frequency_hz=200e3))
    assert [p.number for p in survey] == [2, 3, 9]
    assert {c.index for p in survey for c in p.channels} == {20}


def test_sides_are_joined_by_number_and_time(tmp_path):
    messages = (
        jsf_message(4, 22, side, ENVELOPE, seconds=seconds) for side, seconds in ((1, 8), (0, 8), (0, 8), (1, 9))
    )
    survey = read_survey(recording(tmp_path, *messages))
    assert [[c.side for c in p.channels] for p in survey] == [list(Side), [Side.PORT], [Side.STARBOARD]]


@pytest.mark.parametrize(
    ("start", "end", "protocol", "frequency_hz"),
    [
        (84_000, 86_000, 0x12, 850e3),
        (155_000, 165_000, 0xA, 1600e3),
        (60_000, 70_000, 0xB, 650e3),
        (1_000_000, 1_040_000, 0xB, 10_200e3),
        (84_000, 86_000, 9, 194_640.0),  # older files do not have these bits
    ],
)
def test_upper_bits_of_frequencies(tmp_path, start, end, protocol, frequency_hz):
    (channel,) = read_one(tmp_path, start=start, end=end, protocol=protocol).channels
    assert channel.frequency_hz == frequency_hz
    assert channel.samples.tolist() == ENVELOPE.tolist()


def test_envelope_is_unsigned_and_weighted(tmp_path):
    (channel,) = read_one(tmp_path, weight=3).channels
    assert channel.samples.tolist() == [1, 2, 3, 40_000]
    assert channel.echo().tolist() == [0.125, 0.25, 0.375, 5000.0]
    assert channel.frequency_hz == 400_000
    (channel,) = read_one(tmp_path, weight=-2).channels
    assert channel.echo()[0] == 4.0
    # Analytic samples become magnitudes.
    (channel,) = read_one(tmp_path, np.array([3 + 4j, -32768 - 32768j, 0])).channels
    assert channel.samples.tolist() == [5, 46_341, 0]


def test_range_of_interval_fraction_and_starting_depth(tmp_path):
    (channel,) = read_one(tmp_path, interval_ns=20_000, sound_speed=1480.0, lead=2).channels
    assert channel.samples.tolist() == [0, 0, 1, 2, 3, 40_000]
    assert channel.slant_range_m == pytest.approx(6 * 20e-6 * 740)
    (channel,) = read_one(tmp_path, interval_ns=20_000, lsb=128).channels
    assert channel.slant_range_m == pytest.approx(4 * 20_000.5e-9 * 750)
    (channel,) = read_one(tmp_path, interval_ns=20_000, lsb=128, protocol=0xA).channels
    assert channel.slant_range_m == pytest.approx(4 * 20e-6 * 750)
    for value in (0.0, float("nan"), 150.0):
        survey = read_survey(recording(tmp_path, jsf_message(1, 20, 0, ENVELOPE, sound_speed=value)))
        assert survey.pings[0].channels[0].slant_range_m == pytest.approx(4 * 20e-6 * 750)
        assert "no plausible sound speed: 1500 m/s assumed (1 times)" in survey.warnings


def test_number_of_samples_beyond_16_bits(tmp_path):
    samples = np.ones(70_000, np.uint16)
    (channel,) = read_one(tmp_path, samples).channels
    assert channel.samples.size == 70_000
    (channel,) = read_one(tmp_path, samples, protocol=9).channels  # older files do not have these bits
    assert channel.samples.size == 70_000 - 65_536


def test_navigation_needs_its_validity_bits(tmp_path):
    values = {"x": -41_000_000, "y": 29_000_000, "altitude": 6000, "depth": 14_000}
    values |= {"speed": 20, "heading": 36_000, "pitch": 182, "roll": -182}
    none = read_one(tmp_path, **values, valid=0)
    names = ("lat_deg", "lon_deg", "altitude_m", "depth_m", "speed_mps", "heading_deg", "pitch_deg", "roll_deg")
    assert all(getattr(none, name) is None for name in names)
    ping = read_one(tmp_path, **values, valid=ALL_VALID)
    got = [getattr(ping, name) for name in names]
    assert got == pytest.approx([48.33333, -68.33333, 6.0, 14.0, 1.0289, 0.0, 1.0, -1.0], abs=1e-3)
    for bit, name in ((0, "lat_deg"), (6, "altitude_m"), (9, "depth_m"), (2, "speed_mps"), (3, "heading_deg")):
        assert getattr(read_one(tmp_path, **values, valid=ALL_VALID & ~(1 << bit)), name) is None
    assert read_one(tmp_path, **{**values, "altitude": 0}, valid=ALL_VALID).altitude_m is None
    # The position of the antenna causes a warning.
    values = {"x": -41_000_000, "y": 29_000_000}
    survey = read_survey(recording(tmp_path, jsf_message(1, 20, 0, ENVELOPE, **values)))
    assert any("without layback" in w for w in survey.warnings)
    survey = read_survey(recording(tmp_path, jsf_message(1, 20, 0, ENVELOPE, **values, valid=ALL_VALID)))
    assert survey.warnings == ()


def test_course_and_fraction_of_speed(tmp_path):
    values = {"course": 271, "speed": 35, "lsb": 25 << 8, "lsb2": 7, "valid": ALL_VALID | 2}
    ping = read_one(tmp_path, **values, protocol=0xC)
    assert (ping.course_deg, ping.speed_mps) == pytest.approx((271.25, 3.57 * 1852 / 3600))
    ping = read_one(tmp_path, **values)  # older files do not have these bits
    assert (ping.course_deg, ping.speed_mps) == pytest.approx((271.0, 3.5 * 1852 / 3600))
    for invalid in ({"valid": ALL_VALID}, {"course": 2712}, {"course": -1}):
        assert read_one(tmp_path, **values | invalid).course_deg is None


def test_recorded_layback_is_applied_to_the_position_of_the_antenna(tmp_path):
    def read(interpolated, choice="auto", layback=45.0):
        """Return the last of three positions 100 m north of each other, and the notes."""
        messages = (
            jsf_message(
                number, 20, 0, ENVELOPE, x=-41_000_000, y=29_000_000 + 540 * number, layback=layback,
                seconds=1_378_847_588 + 4 * number, valid=1 | interpolated << 13,
            )
            for number in range(3)
        )  # fmt: skip
        survey = read_survey(recording(tmp_path, *messages), SurveyOptions(recorded_layback=choice))
        return survey.pings[-1].lat_deg, "\n".join(survey.warnings)

    recorded = (29_000_000 + 1080) / 600_000
    towed = pytest.approx(recorded - 45 / 111_200, abs=2e-6)
    for interpolated, choice, expected, note in (
        (False, "auto", towed, "recorded layback of up to 45 m is applied"),
        (False, "ignore", recorded, "position of the antenna at the last fix, without layback"),
        (True, "auto", recorded, ""),
        (True, "apply", towed, "recorded layback of up to 45 m is applied"),
    ):
        lat_deg, notes = read(interpolated, choice)
        assert lat_deg == expected
        assert note in notes
        assert ("antenna" in notes) is ("antenna" in note)
    for layback in (0.0, -5.0, 20_000.0, math.nan, math.inf):
        assert read(False, layback=layback)[0] == recorded


@pytest.mark.parametrize(("unit", "factor"), [(1, 1000), (3, 10), (4, 100)])
def test_positions_in_metres_need_a_projection(tmp_path, unit, factor):
    metres = (500_000 if unit != 1 else 166_021, 53_000 * 10)
    message = jsf_message(1, 20, 0, ENVELOPE, x=metres[0] * factor, y=metres[1] * factor, unit=unit)
    path = recording(tmp_path, message)
    plain = read_survey(path)
    assert plain.pings[0].grid_m == pytest.approx(metres)
    assert plain.pings[0].lat_deg is None
    assert any("projected_crs" in w for w in plain.warnings)
    ping = read_survey(path, SurveyOptions(projected_crs="EPSG:32619")).pings[0]
    assert ping.lat_deg == pytest.approx(4.79, abs=0.02)
    assert read_one(tmp_path, x=5_000_000, y=5_000_000, unit=9).lat_deg is None, "an unknown unit"


def test_times_of_old_and_new_protocols(tmp_path):
    assert read_one(tmp_path, seconds=1_378_847_588, day_ms=76_388_250).time_utc_s == 1_378_847_588.25
    # Milliseconds of the day that contradict the seconds are not used.
    assert read_one(tmp_path, seconds=1_378_847_588, day_ms=5).time_utc_s == 1_378_847_588
    old = {"protocol": 7, "seconds": 5, "year": 2013, "day": 253}
    assert read_one(tmp_path, **old, day_ms=500).time_utc_s == 1_378_771_200.5
    with pytest.raises(SurveyFileError, match="date and time"):
        read_one(tmp_path, protocol=7, year=2013, day=0)


@pytest.mark.parametrize(
    ("values", "warning"),
    [
        ({"kind": 2}, "skipped port message: data format 2"),
        ({"kind": -1}, "skipped port message: data format -1"),
        ({"lead": 100}, "impossible sample interval"),
        ({"lead": 2**32 - 1}, "impossible sample interval"),
        ({"interval_ns": 0}, "impossible sample interval"),
        ({"interval_ns": 2**32 - 1}, "impossible sample interval"),
    ],
)
def test_message_that_cannot_be_used_is_left_out(tmp_path, values, warning):
    messages = (jsf_message(1, 20, 0, ENVELOPE, **values), jsf_message(2, 20, 0, ENVELOPE))
    survey = read_survey(recording(tmp_path, *messages))
    assert [p.number for p in survey] == [2]
    assert warning in survey.warnings[0]


def test_file_without_side_scan_is_refused_with_its_messages(tmp_path):
    path = recording(tmp_path, jsf_message(1, 0, 0, ENVELOPE), jsf_other(2020, bytes(44)), jsf_other(2020, bytes(44)))
    with pytest.raises(SurveyFileError, match=r"type 2020 \(2 times\), type 80 \(1 times\)', expected .* side-scan"):
        read_survey(path)
    # Sub-bottom and other channels are skipped.
    messages = (jsf_message(1, *place, ENVELOPE) for place in ((0, 0), (20, 5), (20, 0)))
    survey = read_survey(recording(tmp_path, *messages))
    assert len(survey.pings) == 1
    assert sum("not side-scan" in w for w in survey.warnings) == 2


@pytest.mark.parametrize(
    ("offset", "raw", "note"),
    [
        (0, b"\x02", "no message at bytes 0 to 263"),
        (2, b"\0", "no message at bytes 0 to 263"),
        (4, b"\xff\xff", "no message at bytes 0 to 263"),
        (12, struct.pack("<i", -1), "no message at bytes 0 to 263"),
        (12, struct.pack("<i", 100), "no message at bytes 0 to 263"),
        (12, struct.pack("<i", 1 << 25), "no message at bytes 0 to 263"),
        (12, struct.pack("<i", 5000), "no message at bytes 0 to 263"),
        (12, struct.pack("<i", 260), "no message at bytes 0 to 263"),
        (16 + 114, struct.pack("<H", 5), "message at byte 0 is left out: number of samples: got 5, expected up to 4"),
        (16 + 16, struct.pack("<H", 0xF00), "message at byte 0 is left out: number of samples: got 983044"),
        (16, struct.pack("<i", 0), "message at byte 0 is left out: date and time"),
    ],
)
def test_damaged_message_is_left_out(tmp_path, offset, raw, note):
    content = bytearray(jsf_message(1, 20, 0, ENVELOPE))
    content[offset : offset + len(raw)] = raw
    others = [jsf_message(number, 20, 0, ENVELOPE) for number in (2, 3)]
    survey = read_survey(recording(tmp_path, content, *others))
    assert [ping.number for ping in survey] == [2, 3]
    assert survey.warnings[0].startswith(note)
    with pytest.raises(SurveyFileError):
        read_survey(recording(tmp_path, content))


def test_lost_bytes_of_a_message_do_not_affect_the_next_one(tmp_path):
    """Wherever its size points to: also into zeros."""
    samples = np.arange(150, dtype=np.uint16)
    first, *others = (jsf_message(number, 20, 0, samples) for number in range(4))
    for lost in range(1, 300, 3):
        survey = read_survey(recording(tmp_path, first[:256] + first[256 + lost :], *others))
        assert [ping.number for ping in survey] == [1, 2, 3], lost
        assert survey.warnings[0].startswith("no message at bytes 0 to")


def test_message_between_two_damaged_places_is_read(tmp_path):
    """Its content proves it: no message follows."""
    messages = [jsf_message(number, 20, 0, ENVELOPE) for number in range(5)]
    path = recording(tmp_path, messages[0], bytes(7), messages[1], b"damage", messages[2], jsf_other(99, b"x")[:-3])
    survey = read_survey(path)
    assert [ping.number for ping in survey] == [0, 1, 2]


def test_file_of_another_kind_is_refused_by_its_first_bytes(tmp_path):
    with pytest.raises(SurveyFileError, match="message at byte 0, marker: got '7468', expected 0116"):
        read_survey(recording(tmp_path, b"this is a text"))
