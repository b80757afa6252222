"""XTF files that this package writes, read back and by pyxtf."""

import dataclasses

import numpy as np
import pytest
import pyxtf
from builders.xtf import write_xtf
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey


def assert_same(read, written):
    assert len(read.pings) == len(written.pings)
    for got, want in zip(read, written, strict=True):
        assert got.number == want.number
        assert got.time_utc_s == pytest.approx(want.time_utc_s, abs=0.0051)
        assert (got.lat_deg, got.lon_deg) == (want.lat_deg, want.lon_deg)
        for name in ("heading_deg", "altitude_m", "depth_m", "speed_mps", "pitch_deg", "roll_deg"):
            assert getattr(got, name) == pytest.approx(getattr(want, name), rel=1e-6), name
        assert len(got.channels) == len(want.channels)
        for got_channel, want_channel in zip(got.channels, want.channels, strict=True):
            assert got_channel.side is want_channel.side
            assert got_channel.samples.dtype == want_channel.samples.dtype
            np.testing.assert_array_equal(got_channel.samples, want_channel.samples)
            assert got_channel.slant_range_m == pytest.approx(want_channel.slant_range_m, rel=1e-6)
            assert got_channel.frequency_hz == want_channel.frequency_hz


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32])
def test_written_survey_is_read_back_and_by_pyxtf(small_survey, tmp_path, dtype):
    survey = small_survey(dtype)
    write_xtf(survey, tmp_path / "a.xtf")
    assert [path.name for path in tmp_path.iterdir()] == ["a.xtf"]
    read = read_survey(tmp_path / "a.xtf")
    assert_same(read, survey)
    assert (read.path, read.sonar_id, read.line_name, read.warnings) == (tmp_path / "a.xtf", "HDS", "a", ())
    header, packets = pyxtf.xtf_read(str(tmp_path / "a.xtf"))
    assert header.SonarName == b"HDS"
    assert header.NavUnits == 3
    pings = packets[pyxtf.XTFHeaderType.sonar]
    assert len(pings) == len(survey.pings)
    for got, want in zip(pings, survey, strict=True):
        np.testing.assert_array_equal(got.data[0][::-1], want.channels[0].samples)
        np.testing.assert_array_equal(got.data[1], want.channels[1].samples)
        assert got.get_time() == np.datetime64(round(want.time_utc_s * 100) * 10, "ms")
        assert got.SensorYcoordinate == want.lat_deg
        assert got.NumBytesThisRecord % 64 == 0
        assert (got.MagicNumber, got.NumChansToFollow, got.PingNumber) == (0xFACE, 2, want.number)


def test_missing_navigation_is_read_as_none(small_survey, tmp_path):
    survey = small_survey()
    without_navigation = tuple(Ping(p.number, p.time_utc_s, p.channels) for p in survey.pings)
    write_xtf(dataclasses.replace(survey, pings=without_navigation), tmp_path / "a.xtf")
    read = read_survey(tmp_path / "a.xtf")
    for ping in read:
        assert {ping.lat_deg, ping.lon_deg, ping.heading_deg, ping.altitude_m, ping.speed_mps} == {None}
    missing = tuple(f"no {what} in 5 of 5 pings, the first in row 0" for what in ("position fix", "heading"))
    assert read.warnings == missing
    # One ping without navigation; a heading of 0 differs from an unknown one.
    north = tuple(dataclasses.replace(ping, heading_deg=0.0) for ping in survey.pings[1:])
    write_xtf(dataclasses.replace(survey, pings=(without_navigation[0], *north)), tmp_path / "a.xtf")
    read = read_survey(tmp_path / "a.xtf")
    assert_same(dataclasses.replace(read, pings=read.pings[1:]), dataclasses.replace(survey, pings=north))
    assert (read.pings[0].lat_deg, read.pings[0].heading_deg, read.pings[0].pitch_deg) == (None, None, None)


def test_dual_frequency_and_ping_without_one_side(small_survey, tmp_path):
    survey = small_survey()
    low = ChannelPing(Side.PORT, np.arange(17, dtype=np.uint16), 80.0, 262_500.0)
    pings = list(survey.pings)
    pings[1] = dataclasses.replace(pings[1], channels=(*pings[1].channels, low))
    pings[2] = dataclasses.replace(pings[2], channels=pings[2].channels[1:])
    survey = dataclasses.replace(survey, pings=tuple(pings))
    write_xtf(survey, tmp_path / "a.xtf")
    first = tuple(dataclasses.replace(ping, channels=ping.channels[:2]) for ping in pings)
    assert_same(read_survey(tmp_path / "a.xtf"), dataclasses.replace(survey, pings=first))
    second = read_survey(tmp_path / "a.xtf", SurveyOptions(frequency_hz=262_500.0))
    assert_same(second, dataclasses.replace(survey, pings=(dataclasses.replace(pings[1], channels=(low,)),)))


@given(
    lat=st.floats(-90, 90).filter(lambda v: v != 0),
    lon=st.floats(-180, 180),
    heading=st.floats(0, 359.5, width=32),
    altitude=st.floats(0.5, 5000, width=32),
    time=st.floats(0, 4e9),
    samples=st.lists(st.integers(0, 65535), min_size=1, max_size=70),
)
def test_any_ping_is_read_back(tmp_path_factory, lat, lon, heading, altitude, time, samples):
    channel = ChannelPing(Side.PORT, np.array(samples, np.uint16), 30.0, None)
    ping = Ping(1, time, (channel,), lat, lon, heading, altitude, depth_m=3.0, speed_mps=1.0, pitch_deg=1, roll_deg=1)
    path = tmp_path_factory.mktemp("any") / "x.xtf"
    survey = Survey(path, "A", "x", (ping,))
    write_xtf(survey, path)
    assert_same(read_survey(path), survey)


def test_survey_outside_format_is_rejected(small_survey, tmp_path):
    for change in ({"sonar_id": "a name longer than the field"}, {"sonar_id": "söder"}, {"pings": ()}):
        with pytest.raises(SurveyFileError, match="channels" if "pings" in change else "sonar_id"):
            write_xtf(dataclasses.replace(small_survey(), **change), tmp_path / "a.xtf")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"number": -1}, "number"),
        ({"time_utc_s": float("nan")}, "time_utc_s"),
        ({"time_utc_s": 1e18}, "time_utc_s"),
        ({"altitude_m": float("inf")}, "SensorPrimaryAltitude"),
        ({"channels": (ChannelPing(Side.PORT, np.zeros(3, np.uint8), 0.0),)}, "slant_range_m"),
        ({"channels": (ChannelPing(Side.PORT, np.zeros(0, np.uint8), 9.0),)}, "samples"),
        ({"channels": (ChannelPing(Side.PORT, np.zeros(3, np.uint16), 9.0),)}, "sample type"),
        ({"channels": (ChannelPing(Side.PORT, np.zeros(3, np.float64), 9.0),)}, "sample type"),
    ],
)
def test_ping_outside_format_is_rejected(small_survey, tmp_path, change, field):
    survey = small_survey()
    pings = (*survey.pings[:2], dataclasses.replace(survey.pings[2], **change))
    with pytest.raises(SurveyFileError, match=f"row 2, {field}"):
        write_xtf(dataclasses.replace(survey, pings=pings), tmp_path / "a.xtf")
