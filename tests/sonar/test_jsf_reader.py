"""EdgeTech JSF: subsystems, data formats, versions, validity, damage."""

from __future__ import annotations

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


def test_both_frequencies_are_in_one_ping(tmp_path):
    """The subsystem with the most messages is first in each ping, in any order of the messages."""
    low, high = ENVELOPE, np.arange(8, dtype=np.uint16)
    messages = [jsf_message(1, 20, side, low) for side in (0, 1)]
    for number in (2, 3):
        messages += [jsf_message(number, 21, 0, high), jsf_message(number, 20, 0, low)]
        messages += [jsf_message(number, 20, 1, low), jsf_message(number, 21, 1, high)]
    messages.append(jsf_message(9, 21, 0, high))
    survey = read_survey(recording(tmp_path, *messages))
    sizes = [[(c.side, c.samples.size) for c in ping.channels] for ping in survey]
    one = [(Side.PORT, 4), (Side.STARBOARD, 4)]
    assert [ping.number for ping in survey] == [1, 2, 3]
    assert sizes[0] == one
    assert sizes[1] == sizes[2] == [*one, (Side.PORT, 8), (Side.STARBOARD, 8)]
    assert "left out ping of subsystem 21: none of this number in subsystem 20 (1 times)" in survey.warnings

    # Without common numbers the other frequency is left out.
    numbers = [(20, number) for number in range(40)] + [(21, number + 5000) for number in range(40)]
    messages = [jsf_message(number, system, side, ENVELOPE) for system, number in numbers for side in (0, 1)]
    survey = read_survey(recording(tmp_path, *messages))
    assert [len(ping.channels) for ping in survey] == [2] * 40
    assert any("left out ping of subsystem 21" in w and "(40 times)" in w for w in survey.warnings)
    survey = read_survey(recording(tmp_path, *(jsf_message(4, 22, side, ENVELOPE) for side in (1, 0, 0))))
    assert [[c.side for c in ping.channels] for ping in survey] == [[Side.PORT, Side.STARBOARD], [Side.PORT]]


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


def test_cut_last_message_is_left_out(tmp_path):
    whole = [jsf_message(number, 20, side, ENVELOPE) for number in range(3) for side in (0, 1)]
    path = recording(tmp_path, *whole)
    path.write_bytes(path.read_bytes()[:-3])
    survey = read_survey(path)
    assert [len(p.channels) for p in survey] == [2, 2, 1]
    assert survey.warnings[0].startswith("the file ends inside its last message")


@pytest.mark.parametrize(
    ("offset", "raw", "field"),
    [
        (0, b"\x02", "marker"),
        (12, struct.pack("<i", -1), "size"),
        (12, struct.pack("<i", 1 << 25), "size"),
        (12, struct.pack("<i", 5000), "truncated"),
        (16 + 114, struct.pack("<H", 5), "number of samples"),
        (16 + 16, struct.pack("<H", 0xF00), "number of samples"),
    ],
)
def test_damage_is_rejected(tmp_path, offset, raw, field):
    content = bytearray(jsf_message(1, 20, 0, ENVELOPE))
    content[offset : offset + len(raw)] = raw
    for damaged, message in ((content, field), (jsf_other(80, bytes(30)), "at least 240")):
        with pytest.raises(SurveyFileError, match=message):
            read_survey(recording(tmp_path, damaged))
