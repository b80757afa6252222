"""XTF files: damage, missing values, variants of different recorders."""

import csv
import struct
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from builders.xtf import write_xtf
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from pydantic import ValidationError
from pyproj import Transformer
from pyxtf import XTFPingHeader

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.geometry import Position, offset_between_m, slant_to_ground_range_m
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import ChannelPing, Side

HEADER = 1024
PACKET = 512
"""Length of a packet of `small_survey`: 256 + 2 * (64 + 40), padded to 64."""
CHAN_INFO = 256
CHANNEL = HEADER + 256
CHANNEL_BYTES = 64 + 40
WEIGHT, TIME_DELAY = 58, 12
ALTITUDE = XTFPingHeader.SensorPrimaryAltitude.offset


@pytest.fixture
def raw(small_survey, tmp_path):
    write_xtf(small_survey(), tmp_path / "complete.xtf")
    return bytearray((tmp_path / "complete.xtf").read_bytes())


def read(tmp_path, content, **options):
    path = tmp_path / "bad.xtf"
    path.write_bytes(content)
    return read_survey(path, SurveyOptions(**options))


def put(raw, offset, fmt, *values):
    struct.pack_into("<" + fmt, raw, offset, *values)
    return raw


def test_damage_is_named_with_its_place_and_the_other_pings_are_read(tmp_path, raw):
    complete = [ping.number for ping in read(tmp_path, raw)]
    for row in range(5):
        first = HEADER + row * PACKET
        others = complete[:row] + complete[row + 1 :]
        for length in (0, 100, PACKET + 1, len(raw), 0xFFFFFFFF):
            survey = read(tmp_path, put(raw[:], first + 10, "I", length))
            assert [ping.number for ping in survey] == others
            last = f"the file ends inside its last packet, as after a power failure: {PACKET} bytes are left out"
            lost = f"no packet at bytes {first} to {first + PACKET - 1}: {PACKET} bytes are left out"
            assert survey.warnings == (last if row == 4 else lost,)
        survey = read(tmp_path, put(raw[:], first + 16, "B", 13))
        assert [ping.number for ping in survey] == others
        assert f"packet at byte {first} is left out: ping {complete[row]}, date and time" in survey.warnings[0]
    survey = read(tmp_path, raw + bytes(PACKET // 2))
    assert survey.warnings == ("the file ends with 256 zero bytes, as after a power failure",)


def with_samples(survey, *pings):
    """Return the survey with these samples on both sides."""
    channels = [tuple(ChannelPing(side, samples, 25.0) for side in Side) for samples in pings]
    changed = (replace(ping, channels=each) for ping, each in zip(survey.pings, channels, strict=False))
    return replace(survey, pings=tuple(changed))


def test_samples_of_32_bits_are_kept_and_impossible_ones_become_zero(tmp_path, small_survey):
    path = tmp_path / "line.xtf"
    whole = np.array([2**32 - 1, 2**31 + 1, 2**24 + 1], np.uint32)
    fractions = np.array([0.0, 0.25, 1e-9, 3e7], np.float32)
    for samples in (whole, fractions):
        write_xtf(with_samples(small_survey(), samples, samples), path)
        survey = read_survey(path)
        assert survey.warnings == ()
        for channel in (channel for ping in survey for channel in ping.channels):
            assert channel.samples.dtype == samples.dtype
            np.testing.assert_array_equal(channel.samples, samples)
    for value in (float("nan"), float("inf"), -1.0, -float("inf"), 1e30):
        write_xtf(with_samples(small_survey(), np.array([1.0, value, 2.0], np.float32)), path)
        survey = read_survey(path)
        assert [c.samples.tolist() for c in survey.pings[0].channels] == [[1.0, 0.0, 2.0]] * 2
        assert survey.warnings == ("samples that are negative, not finite or above 1e+12 are read as 0 (2 times)",)


def as_ground_range(raw):
    for number in range(2):
        put(raw, CHAN_INFO + 128 * number + 2, "H", 2)
    return raw


@pytest.mark.parametrize("stated", [False, True])
def test_ground_range_samples_are_at_their_ground_range(tmp_path, raw, stated):
    """Every sample of the bottom keeps the ground range at which the recorder stored it."""
    altitude_m, range_m = 6.25, 25.0
    ground_m = float(np.sqrt(range_m**2 - altitude_m**2))
    plain = read(tmp_path, raw)
    if stated:
        for row in range(5):
            for number in range(2):
                put(raw, HEADER + row * PACKET + 256 + number * CHANNEL_BYTES + 8, "f", ground_m)
    survey = read(tmp_path, as_ground_range(raw))
    assert "ground-range samples converted to slant range with the altitude (10 times)" in survey.warnings
    for ping, before in zip(survey, plain, strict=True):
        for side in Side:
            channel, stored = ping.channel(side), before.channel(side).samples
            assert channel.slant_range_m == pytest.approx(range_m, rel=1e-5)
            for sample in range(40):
                here_m = slant_to_ground_range_m((sample + 0.5) * channel.sample_spacing_m, altitude_m)
                want = 0 if np.isnan(here_m) else stored[int(here_m / (ground_m / 40))]
                assert channel.samples[sample] == want


def test_ground_range_without_altitude_is_skipped(tmp_path, raw):
    for altitude in (0.0, float("nan"), -3.0, 30.0):
        survey = read(tmp_path, put(as_ground_range(raw), HEADER + ALTITUDE, "f", altitude))
        assert [p.number for p in survey] == [11, 12, 13, 14]
        assert "skipped port channel: ground-range samples without a plausible altitude (1 times)" in survey.warnings


@pytest.mark.realdata
def test_recording_of_a_multibeam_alone_is_refused(data_dir):
    with pytest.raises(SurveyFileError, match=r"got '0 sonar, 1 other'.*multibeam alone are not read"):
        read_survey(data_dir / "surveys" / "negative" / "multibeam-only-r2sonic.xtf")


@pytest.mark.parametrize(
    ("offset", "fmt", "value", "field"),
    [
        (0, "B", 0x89, "FileFormat: got '0x89', expected '?0x7b"),
        (HEADER, "H", 0xBEEF, "packet at byte 1024, marker: got 'efbe', expected cefa"),
        (HEADER + 16, "B", 13, "date and time"),
        (HEADER + 18, "B", 25, "date and time"),
        (HEADER + 21, "B", 101, "HSeconds"),
        (HEADER + 256, "H", 14, "ChannelNumber"),
        (HEADER + 256 + 42, "I", 0xFFFFFFFF, "NumSamples"),
        (HEADER + 256 + 42, "I", 300, "NumSamples"),
        (166, "H", 0, "channel counts"),
        (166, "H", 60000, "channel counts"),
        (CHAN_INFO + 6, "H", 3, "BytesPerSample"),
        (CHAN_INFO + 6, "H", 0, "BytesPerSample"),
        (CHAN_INFO + 74, "B", 5, "SampleFormat"),
        (CHAN_INFO + 74, "B", 1, "SampleFormat"),
    ],
)
def test_error_names_invalid_field(tmp_path, raw, offset, fmt, value, field):
    with pytest.raises(SurveyFileError, match=field) as caught:
        read(tmp_path, put(raw[: HEADER + PACKET], offset, fmt, value))
    assert caught.value.where.endswith("bad.xtf")
    assert caught.value.expected


@given(tail=st.binary(max_size=3000))
def test_noise_after_valid_header_raises_survey_file_error(tmp_path, raw, tail):
    with pytest.raises(SurveyFileError):
        read(tmp_path, raw[:HEADER] + tail)


def test_other_packets_are_skipped_and_counted(tmp_path, raw):
    attitude = struct.pack("<HBBHHHI", 0xFACE, 3, 0, 0, 0, 0, 64) + bytes(50)
    unknown = struct.pack("<HBBHHHI", 0xFACE, 199, 0, 0, 0, 0, 14)
    body = raw[:HEADER] + attitude + raw[HEADER : HEADER + PACKET] + unknown + attitude + raw[HEADER + PACKET :]
    survey = read(tmp_path, body)
    assert len(survey.pings) == 5
    assert survey.warnings == (
        "skipped packet of type 199: not a sonar ping (1 times)",
        "skipped packet of type 3: not a sonar ping (2 times)",
    )


def test_projected_coordinates_without_crs_give_no_positions(tmp_path, raw):
    survey = read(tmp_path, put(raw, 164, "H", 0))
    assert all(p.lat_deg is None and p.lon_deg is None and p.heading_deg == 354.5 for p in survey)
    assert len(survey.warnings) == 1
    assert "set the option projected_crs" in survey.warnings[0]
    survey = read(tmp_path, put(raw, 164, "H", 7))
    assert all(p.lat_deg is None for p in survey)
    assert survey.warnings[-1] == "no positions: NavUnits is 7, expected 3 (degrees) or 0 (projected metres)"


def test_invalid_position_is_unknown(tmp_path, raw):
    for lat in (float("nan"), float("inf"), 90.5, -1e300):
        survey = read(tmp_path, put(raw, HEADER + PACKET + 160, "d", lat))
        assert [p.lat_deg is None for p in survey] == [False, True, False, False, False]
        assert survey.pings[1].lon_deg is None
        assert survey.warnings == ("no position fix in 1 of 5 pings, the first in row 1",)


def test_zero_altitude_is_unknown_and_negative_is_reported(tmp_path, raw):
    put(raw, HEADER + 196, "f", 0.0)
    survey = read(tmp_path, put(raw, HEADER + PACKET + 196, "f", -4.0))
    assert [p.altitude_m for p in survey] == [None, None, 6.25, 6.25, 6.25]
    assert survey.warnings == ("altitude_m out of range in 1 of 5 pings, the first in row 1",)


def test_hundredths_of_100_are_the_next_second_and_a_sub_bottom_channel_is_skipped(tmp_path, raw):
    before = read(tmp_path, raw).pings[0].time_utc_s
    assert read(tmp_path, put(raw[:], HEADER + 21, "B", 100)).pings[0].time_utc_s == pytest.approx(before - 0.13 + 1.0)
    survey = read(tmp_path, put(raw, CHAN_INFO, "B", 0))
    assert survey.sides() == (Side.STARBOARD,)
    assert survey.warnings == ("skipped channel: sub-bottom, not side-scan (5 times)",)


def test_sample_count_and_frequency_are_from_the_file_header_if_a_ping_has_none(tmp_path, raw):
    in_every_ping(in_every_ping(raw, 256 + 42, "I", 0), 256 + 26, "H", 0)
    (channel, _) = read(tmp_path, put(raw, CHAN_INFO + 8, "I", 40)).pings[0].channels
    assert (channel.samples.shape, channel.frequency_hz) == ((40,), 600_000)  # from kilohertz
    in_every_ping(raw, 256 + CHANNEL_BYTES + 26, "H", 0)
    for number in range(2):
        put(raw, CHAN_INFO + 128 * number + 32, "f", 455_000.0)
    assert read(tmp_path, raw).pings[0].channels[0].frequency_hz == 455_000
    # More than six channels extend the file header.
    put(raw, 166, "H", 7)
    assert len(read(tmp_path, raw[:HEADER] + bytes(1024) + raw[HEADER:]).pings) == 5


def test_index_file_of_pyxtf_is_not_loaded(tmp_path, raw):
    (tmp_path / "bad.pyxtf_idx").write_bytes(b"cos\nabort\n(tR.")  # a pickle that would abort the process
    assert len(read(tmp_path, raw).pings) == 5


def in_every_ping(raw, offset, fmt, *values):
    for row in range(5):
        struct.pack_into("<" + fmt, raw, HEADER + row * PACKET + offset, *values)
    return raw


def attitude(time, pitch, roll, heading):
    year, month, day, hour, minute, second, millisecond = time
    body = struct.pack("<HBBHHHI", 0xFACE, 3, 0, 0, 0, 0, 64) + bytes(16)
    body += struct.pack("<ffffIf", pitch, roll, 0, 0, 0, heading)
    return body + struct.pack("<HBBBBBHB", year, month, day, hour, minute, second, millisecond, 0)


def test_weight_scales_echo_and_not_samples(raw, tmp_path):
    struct.pack_into("<h", raw, CHANNEL + WEIGHT, 3)
    struct.pack_into("<h", raw, CHANNEL + CHANNEL_BYTES + WEIGHT, -2)
    plain, weighted = read(tmp_path, in_every_ping(bytearray(raw), 256 + WEIGHT, "h", 0)), read(tmp_path, raw)
    port, starboard = weighted.pings[0].channels
    assert (port.scale, starboard.scale) == (1 / 8, 4.0)
    np.testing.assert_array_equal(port.samples, plain.pings[0].channels[0].samples)
    np.testing.assert_array_equal(port.echo(), port.samples / np.float32(8))
    np.testing.assert_array_equal(weighted.waterfall(Side.STARBOARD)[0], starboard.samples * np.float32(4))
    struct.pack_into("<h", raw, CHANNEL + WEIGHT, 999)
    assert "sample weight beyond ±31 is not applied (1 times)" in read(tmp_path, raw).warnings


@pytest.mark.parametrize("range_includes_delay", [True, False])
def test_time_delay_keeps_every_echo_at_its_range(raw, tmp_path, range_includes_delay):
    """25 m in 40 samples; recording starts at 12.5 m, or at 25 m."""
    in_every_ping(raw, 32, "f", 750.0)
    duration_s = 25 / 750 / (2 if range_includes_delay else 1)
    for offset in (256, 256 + CHANNEL_BYTES):
        in_every_ping(raw, offset + TIME_DELAY, "ff", duration_s, duration_s)
    survey = read(tmp_path, raw)
    channel = survey.pings[0].channels[1]
    assert channel.samples.shape == (80,)
    assert not channel.samples[:40].any()
    assert channel.slant_range_m == pytest.approx(25 if range_includes_delay else 50)
    assert any("zeros replace" in w for w in survey.warnings)
    # An inconsistent delay skips the channel.
    in_every_ping(raw, 256 + TIME_DELAY, "ff", 0.5, 0.001)
    survey = read(tmp_path, raw)
    assert survey.sides() == (Side.STARBOARD,)
    assert any("TimeDelay, SlantRange and TimeDuration disagree" in w for w in survey.warnings)


def test_attitude_packets_fill_missing_attitude(raw, tmp_path):
    in_every_ping(raw, 204, "fff", 0, 0, 0)  # pitch, roll, heading
    first = attitude((2013, 9, 10, 21, 13, 8, 100), 1.5, -2.5, 123.0)
    later = attitude((2013, 9, 10, 21, 13, 8, 800), 2.5, -3.5, 124.0)
    body = raw[:HEADER] + first + raw[HEADER : HEADER + 2 * PACKET] + later + raw[HEADER + 2 * PACKET :]
    survey = read(tmp_path, body)
    # Pings start at 8.13 s, every 0.37 s. The last one is within 1 s of the second packet.
    assert [p.heading_deg for p in survey] == [123, 123, 124, 124, 124]
    assert [p.pitch_deg for p in survey] == [1.5, 1.5, 2.5, 2.5, 2.5]
    assert survey.pings[0].roll_deg == -2.5
    assert survey.warnings == ("heading_deg, pitch_deg, roll_deg from attitude packets (2 of them)",)
    old = attitude((2013, 9, 10, 21, 13, 7, 0), 1.5, -2.5, 123.0)
    assert read(tmp_path, raw[:HEADER] + old + raw[HEADER:], heading_source="sensor").pings[0].heading_deg is None
    without_heading = attitude((2013, 9, 10, 21, 13, 8, 100), 1.5, -2.5, 0.0)
    ping = read(tmp_path, raw[:HEADER] + without_heading + raw[HEADER:], heading_source="sensor").pings[0]
    assert (ping.heading_deg, ping.pitch_deg) == (None, 1.5)
    in_every_ping(raw, 204, "fff", -2.5, 3.75, 354.5)
    ping = read(tmp_path, raw[:HEADER] + first + raw[HEADER:]).pings[0]
    assert (ping.heading_deg, ping.pitch_deg) == (354.5, -2.5), "the attitude of the ping has precedence"


def test_projected_coordinates_require_crs(raw, tmp_path):
    assert read(tmp_path, raw, projected_crs="EPSG:32619").pings[0].lat_deg == 48.44545, "degrees ignore it"
    to_utm = Transformer.from_crs(4326, 32619, always_xy=True)
    easting, northing = to_utm.transform(-68.827935, 48.44545)
    struct.pack_into("<H", raw, 164, 0)
    in_every_ping(raw, 160, "dd", northing, easting)
    assert all(p.lat_deg is None for p in read(tmp_path, raw))
    survey = read(tmp_path, raw, projected_crs="EPSG:32619")
    for ping in survey:
        off_m = offset_between_m(Position(48.44545, -68.827935), Position(ping.lat_deg, ping.lon_deg))
        assert np.hypot(*off_m) < 0.001
    assert survey.warnings == ()
    for wrong in ("EPSG:4326", "EPSG:999999", "nonsense", "EPSG:4978"):  # degrees, unknown, invalid, geocentric
        with pytest.raises(ValidationError, match="projected_crs"):
            read(tmp_path, raw, projected_crs=wrong)
    # A local grid with small coordinates: only NavUnits determines the unit.
    in_every_ping(raw, 160, "dd", 48.4, -68.8)
    assert all(p.lat_deg is None for p in read(tmp_path, raw))
    metres = read(tmp_path, raw, projected_crs="+proj=utm +zone=19 +datum=WGS84 +units=m")
    assert all(abs(p.lat_deg) < 1 for p in metres)
    in_every_ping(in_every_ping(raw, 160, "dd", 1e30, 1e30), 128, "dd", 1e30, 1e30)
    survey = read(tmp_path, raw, projected_crs="EPSG:32619")
    assert survey.warnings == ("no position fix in 5 of 5 pings, the first in row 0",)


def test_port_order_nearest_first_is_an_option_and_reported(raw, small_survey, tmp_path):
    one = read(tmp_path, raw).pings[0].channels[0].samples
    other = read(tmp_path, raw, port_order="nearest_first").pings[0].channels[0].samples
    np.testing.assert_array_equal(one, other[::-1])
    survey = small_survey(pings=80, samples=128)
    for ping in survey:
        for channel in ping.channels:
            channel.samples[:] = np.linspace(1, 200, 128)
            if channel.side is Side.PORT:
                channel.samples[:] = channel.samples[::-1].copy()
    write_xtf(survey, tmp_path / "a.xtf")
    assert "port looks stored nearest" in read_survey(tmp_path / "a.xtf").warnings[0]


def test_implausible_slant_range_skips_channel(raw, tmp_path):
    for slant_range_m in (1e30, 10_001, float("nan"), float("inf"), -5):
        survey = read(tmp_path, in_every_ping(raw, 256 + 4, "f", slant_range_m))
        assert survey.sides() == (Side.STARBOARD,)
        assert survey.warnings == ("skipped port channel: no samples or no slant range (5 times)",)


@pytest.mark.realdata
@pytest.mark.parametrize(("name", "sonar"), [("scotsman-iver2", "HDS"), ("000_1236", "WizMap")])
def test_recordings_match_derived_images(data_dir, name, sonar):
    folder = data_dir / "surveys"
    survey = read_survey(folder / f"{name}.xtf")
    assert survey.sonar_id == sonar
    missing = tuple(f"no {what} in 1 of 461 pings, the first in row 0" for what in ("position fix", "heading"))
    assert survey.warnings == (missing if sonar == "HDS" else ())
    # Index 0 is nearest to the vehicle: on both sides the dark water column is before the bright seabed.
    for image in map(survey.waterfall, Side):
        middle = image.shape[1] // 2
        assert image[:200, 30:60].mean() * 5 < image[:200, middle : middle + 50].mean()
    # The images have the order of the file: port from far to near.
    for side, suffix, step in ((Side.PORT, "port", -1), (Side.STARBOARD, "stbd", 1)):
        image = np.asarray(Image.open(folder / "derived" / f"{name}.xtf.{suffix}.png"))
        rows = np.stack([ping.channel(side).samples for ping in survey])
        assert rows.dtype == image.dtype
        np.testing.assert_array_equal(rows[:, ::step], image)
    with (folder / "derived" / f"{name}.xtf.nav.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == len(survey.pings)
    for ping, line in zip(survey, lines, strict=True):
        when = datetime.fromisoformat(line["utc"]).replace(tzinfo=UTC)
        assert ping.time_utc_s == pytest.approx(when.timestamp(), abs=0.001)
        assert (ping.lat_deg or 0.0) == pytest.approx(float(line["y_or_lat"]), abs=1e-9)
        assert (ping.lon_deg or 0.0) == pytest.approx(float(line["x_or_lon"]), abs=1e-9)
        assert (ping.altitude_m or 0.0) == pytest.approx(float(line["alt"]), abs=0.006)
        assert (ping.heading_deg or 0.0) == pytest.approx(float(line["heading"]), abs=0.006)
        assert (ping.speed_mps or 0.0) / 0.514444 == pytest.approx(float(line["speed"]), abs=0.006)
        assert ping.channels[0].slant_range_m == pytest.approx(float(line["slant_range"]), abs=1e-3)
