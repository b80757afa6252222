"""Lowrance SL2 and SL3 files: damage, missing values, recordings."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from builders.surveys import lowrance_frame

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import Side

SAMPLES = bytes(range(1, 9))
HEADER_BYTES = {2: 144, 3: 168}


def recording(tmp_path, version, *frames):
    """Write a file of frames, each given by the arguments of `lowrance_frame`."""
    content = struct.pack("<4H", version, 2, 3200, 1)
    for frame in frames:
        content += lowrance_frame(version, len(content), **{"samples": SAMPLES, **frame})
    path = tmp_path / f"line.sl{version}"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(("version", "low"), [(2, 0.0), (3, -100.0)])
def test_halves_range_and_heading(tmp_path, version, low):
    for rad, deg in ((-4.0, 360 - 229.183), (13.0, 24.845), (-1e-30, 0.0)):
        (ping,) = read_survey(recording(tmp_path, version, {"heading": rad})).pings
        assert ping.heading_deg == pytest.approx(deg, abs=0.01)
    (ping,) = read_survey(recording(tmp_path, version, {"low": low, "high": 100.0, "ms": -454})).pings
    assert ping.channel(Side.PORT).samples.tolist() == [4, 3, 2, 1]
    assert ping.channel(Side.STARBOARD).samples.tolist() == [5, 6, 7, 8]
    assert [c.slant_range_m for c in ping.channels] == pytest.approx([30.48, 30.48])
    assert ping.time_utc_s == pytest.approx(1_378_847_588 - 0.454)


@pytest.mark.parametrize("version", [2, 3])
def test_missing_values_are_none_and_reported(tmp_path, version):
    path = recording(tmp_path, version, {"speed": math.nan}, {"east": 2**31 - 1, "heading": math.nan}, {"channel": 3})
    survey = read_survey(path)
    assert all(p.lat_deg is None and p.heading_deg is None for p in survey)
    assert survey.pings[0].speed_mps is None
    assert survey.warnings == (
        "skipped channel: left side-scan, not composite (1 times)",
        "no position fix in 2 of 2 pings, the first in row 0",
        "no heading in 2 of 2 pings, the first in row 0",
    )


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"high": 0.0}, "maximum range"),
        ({"high": math.nan}, "maximum range"),
        ({"high": 1e30}, "maximum range"),
        ({"low": 3.0}, "minimum range"),
        ({"low": math.nan}, "minimum range"),
        ({"time_s": 5}, "time: got 5"),
        ({"samples": b""}, "number of samples"),
        ({"samples": b"abc"}, "number of samples"),
        ({"channel": 0}, "pings"),
    ],
)
def test_impossible_value_is_rejected(tmp_path, values, field):
    with pytest.raises(SurveyFileError, match=field):
        read_survey(recording(tmp_path, 3, values))


@pytest.mark.parametrize("version", [2, 3])
def test_damaged_sizes_are_rejected(tmp_path, version):
    path = recording(tmp_path, version, {}, {})
    complete = path.read_bytes()
    size_at, samples_at = {2: (28, 34), 3: (8, 44)}[version]
    for place, value, field in (
        (0, 9, "frame at byte 8, offset"),
        (size_at, 0, "frame size"),
        (size_at, HEADER_BYTES[version] - 1, "frame size"),
        (size_at, 65535, "truncated"),
        (samples_at, 65534, "number of samples"),
    ):
        raw = bytearray(complete)
        struct.pack_into("<H", raw, 8 + place, value)
        path.write_bytes(raw)
        with pytest.raises(SurveyFileError, match=field):
            read_survey(path)
    formats = [(struct.pack("<4H", number, 2, 3200, 1), "format") for number in (0, 1, 4)]
    for content, field in ((complete[:-1], "truncated"), *formats):
        path.write_bytes(content)
        with pytest.raises(SurveyFileError, match=field):
            read_survey(path)


@pytest.mark.realdata
@pytest.mark.parametrize(("name", "pings", "lon_deg"), [("20MCAL2", 156, 147.33753), ("40MCAL3", 113, 147.33756)])
def test_recordings(data_dir, name, pings, lon_deg):
    survey = read_survey(data_dir / "surveys" / "lowrance" / f"{name}.sl3")
    assert len(survey.pings) == pings
    assert survey.sides() == tuple(Side)
    first = survey.pings[0]
    assert (first.lat_deg, first.lon_deg) == (pytest.approx(-42.8859, abs=1e-3), pytest.approx(lon_deg, abs=1e-4))
    assert all(c.slant_range_m == pytest.approx(1.524, abs=0.01) and c.samples.size == 1400 for c in first.channels)
    steps_s = np.diff([p.time_utc_s for p in survey])
    assert (steps_s > 0).all()
    assert (steps_s < 1).all()
    assert 1_722_800_000 < first.time_utc_s < 1_722_900_000
