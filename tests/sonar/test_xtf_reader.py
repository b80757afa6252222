from __future__ import annotations

import csv
import os
import struct
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.readers import SUPPORTED_SUFFIXES, read_survey, register_reader, supported_suffixes
from sonarpost.sonar.readers.xtf import MAX_FILE_BYTES, read_xtf
from sonarpost.sonar.survey import Side
from sonarpost.sonar.xtf_writer import write_xtf

HEADER = 1024
PACKET = 512  # the small survey's: 256 + 2 * (64 + 40), padded
CHAN_INFO = 256


@pytest.fixture
def raw(small_survey, tmp_path) -> bytearray:
    write_xtf(small_survey(), tmp_path / "whole.xtf")
    return bytearray((tmp_path / "whole.xtf").read_bytes())


def read_bytes(tmp_path: Path, content: bytes):
    path = tmp_path / "bad.xtf"
    path.write_bytes(content)
    return read_xtf(path)


def put(raw: bytearray, offset: int, fmt: str, *values: float) -> bytearray:
    struct.pack_into("<" + fmt, raw, offset, *values)
    return raw


def test_the_packet_size_assumed_here(raw):
    assert len(raw) == HEADER + 5 * PACKET


@pytest.mark.parametrize("length", [0, 1, 500, 1023])
def test_shorter_than_the_header(tmp_path, raw, length):
    with pytest.raises(SurveyFileError, match="file size"):
        read_bytes(tmp_path, raw[:length])


def test_every_truncation_is_an_error_but_at_a_packet_border(tmp_path, raw):
    for length in range(HEADER, len(raw), 29):
        if (length - HEADER) % PACKET:
            with pytest.raises(SurveyFileError, match="truncated"):
                read_bytes(tmp_path, raw[:length])
    assert len(read_bytes(tmp_path, raw[: HEADER + 2 * PACKET]).pings) == 2


def test_a_file_of_no_pings(tmp_path, raw):
    with pytest.raises(SurveyFileError, match="pings"):
        read_bytes(tmp_path, raw[:HEADER])


def test_not_an_xtf_file(tmp_path):
    with pytest.raises(SurveyFileError, match=r"FileFormat: got '0x89', expected '?0x7b"):
        read_bytes(tmp_path, b"\x89PNG" + bytes(2000))


@pytest.mark.parametrize(
    ("offset", "fmt", "value", "field"),
    [
        (HEADER, "H", 0xBEEF, "MagicNumber"),
        (HEADER + 10, "I", 0, "NumBytesThisRecord"),
        (HEADER + 10, "I", 0xFFFFFFFF, "NumBytesThisRecord"),
        (HEADER + 10, "I", 100, "NumBytesThisRecord"),
        (HEADER + 4, "H", 65535, "NumChansToFollow"),
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
        (CHAN_INFO + 2, "H", 2, "CorrectionFlags"),
    ],
)
def test_a_bad_field_is_named(tmp_path, raw, offset, fmt, value, field):
    with pytest.raises(SurveyFileError, match=field) as caught:
        read_bytes(tmp_path, put(raw, offset, fmt, value))
    assert caught.value.where.endswith("bad.xtf")
    assert caught.value.expected


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_reads_or_raises_one_error(tmp_path, raw, data):
    damaged = bytearray(raw)
    for _ in range(data.draw(st.integers(1, 6))):
        damaged[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    try:
        survey = read_bytes(tmp_path, bytes(damaged))
    except SurveyFileError:
        return
    for ping in survey:
        assert ping.lat_deg is None or -90 <= ping.lat_deg <= 90
        assert ping.heading_deg is None or 0 <= ping.heading_deg < 360
        assert all(c.slant_range_m > 0 and c.samples.size for c in ping.channels)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(tail=st.binary(max_size=3000))
def test_noise_after_a_good_header_reads_or_raises_one_error(tmp_path, raw, tail):
    with pytest.raises(SurveyFileError):
        read_bytes(tmp_path, raw[:HEADER] + tail)


def test_other_packets_are_skipped_and_counted(tmp_path, raw):
    attitude = struct.pack("<HBBHHHI", 0xFACE, 3, 0, 0, 0, 0, 64) + bytes(50)
    unknown = struct.pack("<HBBHHHI", 0xFACE, 199, 0, 0, 0, 0, 14)
    body = raw[:HEADER] + attitude + raw[HEADER : HEADER + PACKET] + unknown + attitude + raw[HEADER + PACKET :]
    survey = read_bytes(tmp_path, body)
    assert len(survey.pings) == 5
    assert survey.warnings == (
        "skipped packet of type 199: not a sonar ping (1 times)",
        "skipped packet of type 3: not a sonar ping (2 times)",
    )


def test_projected_metres_give_no_positions(tmp_path, raw):
    survey = read_bytes(tmp_path, put(raw, 164, "H", 0))
    assert all(p.lat_deg is None and p.lon_deg is None and p.heading_deg == 354.5 for p in survey)
    assert len(survey.warnings) == 1
    assert "NavUnits is 0 (projected metres)" in survey.warnings[0]
    survey = read_bytes(tmp_path, put(raw, 164, "H", 7))
    assert all(p.lat_deg is None for p in survey)
    assert survey.warnings == ("no positions: NavUnits is 7, expected 3 (degrees) or 0 (projected metres)",)


@pytest.mark.parametrize("lat", [float("nan"), float("inf"), 90.5, -1e300])
def test_a_position_that_is_not_on_earth(tmp_path, raw, lat):
    survey = read_bytes(tmp_path, put(raw, HEADER + PACKET + 160, "d", lat))
    assert [p.lat_deg is None for p in survey] == [False, True, False, False, False]
    assert survey.pings[1].lon_deg is None
    assert survey.warnings == ("no position fix in 1 of 5 pings, the first in row 1",)


def test_altitude_zero_is_unknown_and_a_wild_one_is_dropped(tmp_path, raw):
    put(raw, HEADER + 196, "f", 0.0)
    survey = read_bytes(tmp_path, put(raw, HEADER + PACKET + 196, "f", -4.0))
    assert [p.altitude_m for p in survey] == [None, None, 6.25, 6.25, 6.25]
    assert survey.warnings == ("altitude_m out of range in 1 of 5 pings, the first in row 1",)


def test_hundred_hundredths_are_the_next_second(tmp_path, raw):
    before = read_bytes(tmp_path, raw).pings[0].time_utc_s
    assert read_bytes(tmp_path, put(raw, HEADER + 21, "B", 100)).pings[0].time_utc_s == pytest.approx(
        before - 0.13 + 1.0
    )


def test_another_kind_of_channel_is_skipped(tmp_path, raw):
    survey = read_bytes(tmp_path, put(raw, CHAN_INFO, "B", 0))
    assert survey.sides() == (Side.STARBOARD,)
    assert survey.warnings == ("skipped channel: sub-bottom, not side-scan (5 times)",)


def test_samples_before_the_count_field_existed(tmp_path, raw):
    for row in range(5):
        put(raw, HEADER + row * PACKET + 256 + 42, "I", 0)
    survey = read_bytes(tmp_path, put(raw, CHAN_INFO + 8, "I", 40))
    assert survey.pings[0].channels[0].samples.shape == (40,)


def test_more_than_six_channels_have_a_longer_header(tmp_path, raw):
    put(raw, 166, "H", 7)
    survey = read_bytes(tmp_path, raw[:HEADER] + bytes(1024) + raw[HEADER:])
    assert len(survey.pings) == 5


def test_frequency_in_hertz_or_kilohertz(tmp_path, raw):
    for row in range(5):
        put(raw, HEADER + row * PACKET + 256 + 26, "H", 0)
    assert read_bytes(tmp_path, raw).pings[0].channels[0].frequency_hz == 600_000
    put(raw, CHAN_INFO + 32, "f", 455_000.0)
    assert read_bytes(tmp_path, raw).pings[0].channels[0].frequency_hz == 455_000


def test_an_index_file_beside_the_survey_is_left_alone(tmp_path, raw):
    (tmp_path / "bad.pyxtf_idx").write_bytes(b"cos\nabort\n(tR.")  # a pickle that would end the process
    assert len(read_bytes(tmp_path, raw).pings) == 5


def test_port_stored_nearest_first_is_remarked_on(small_survey, tmp_path):
    survey = small_survey(pings=80, samples=128)
    for ping in survey:
        for channel in ping.channels:
            channel.samples[:] = np.linspace(1, 200, 128)
            if channel.side is Side.PORT:
                channel.samples[:] = channel.samples[::-1].copy()
    write_xtf(survey, tmp_path / "a.xtf")
    assert "port looks stored nearest" in read_xtf(tmp_path / "a.xtf").warnings[0]


def test_what_is_no_file(tmp_path):
    with pytest.raises(SurveyFileError, match="No such file"):
        read_xtf(tmp_path / "absent.xtf")
    with pytest.raises(SurveyFileError, match=r"directory|regular"):
        read_xtf(tmp_path)
    os.mkfifo(tmp_path / "pipe.xtf")
    with pytest.raises(SurveyFileError, match="regular"):
        read_xtf(tmp_path / "pipe.xtf")


def test_a_giant_is_refused_by_its_size(tmp_path):
    with (tmp_path / "giant.xtf").open("wb") as file:
        file.truncate(MAX_FILE_BYTES + 1)
    with pytest.raises(SurveyFileError, match="file size"):
        read_xtf(tmp_path / "giant.xtf")


def test_the_registry(small_survey, tmp_path):
    write_xtf(small_survey(), tmp_path / "A.XTF")
    assert len(read_survey(tmp_path / "A.XTF").pings) == 5
    assert ".xtf" in SUPPORTED_SUFFIXES
    with pytest.raises(SurveyFileError, match=r"suffix: got '.jsf', expected .*\.xtf"):
        read_survey(tmp_path / "a.jsf")
    with pytest.raises(ValueError, match="already"):
        register_reader([".XTF"], lambda path: small_survey())
    with pytest.raises(ValueError, match="not a file suffix"):
        register_reader(["xtf"], lambda path: small_survey())
    assert "xtf" not in supported_suffixes()


@pytest.mark.realdata
@pytest.mark.parametrize(("name", "sonar"), [("scotsman-iver2", "HDS"), ("000_1236", "WizMap")])
def test_real_recordings_agree_with_their_derived_pictures(data_dir, name, sonar):
    folder = data_dir / "surveys"
    survey = read_xtf(folder / f"{name}.xtf")
    assert survey.sonar_id == sonar
    # The pictures hold the file's own order: port from far to near.
    for side, suffix, step in ((Side.PORT, "port", -1), (Side.STARBOARD, "stbd", 1)):
        picture = np.asarray(Image.open(folder / "derived" / f"{name}.xtf.{suffix}.png"))
        rows = np.stack([ping.channel(side).samples for ping in survey])
        assert rows.dtype == picture.dtype
        np.testing.assert_array_equal(rows[:, ::step], picture)
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


@pytest.mark.realdata
def test_the_real_ping_without_a_fix(data_dir):
    survey = read_xtf(data_dir / "surveys" / "scotsman-iver2.xtf")
    assert [row for row, ping in enumerate(survey) if ping.lat_deg is None] == [0]
    assert survey.warnings == ("no position fix in 1 of 461 pings, the first in row 0",)
    assert read_xtf(data_dir / "surveys" / "000_1236.xtf").pings[0].altitude_m is None


@pytest.mark.realdata
@pytest.mark.parametrize("name", ["scotsman-iver2", "000_1236"])
def test_the_near_end_of_a_real_channel_is_the_water_column(data_dir, name):
    """Index 0 is nearest the vehicle: on both sides the dark water comes before the bright bottom."""
    survey = read_xtf(data_dir / "surveys" / f"{name}.xtf")
    for side in Side:
        picture = survey.waterfall(side)
        water = picture[:200, 30:60].mean()
        assert water * 5 < picture[:200, picture.shape[1] // 2 : picture.shape[1] // 2 + 50].mean()
