"""Lowrance SL2 and SL3 files: damage, missing values, recordings."""

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
        ({"samples": b""}, "number of samples"),
        ({"samples": b"abc"}, "number of samples"),
    ],
)
def test_frame_with_an_impossible_value_is_left_out(tmp_path, values, field):
    with pytest.raises(SurveyFileError, match=rf"frame at byte 8, {field}"):
        read_survey(recording(tmp_path, 3, values))
    survey = read_survey(recording(tmp_path, 3, {"index": 1}, {"index": 2, **values}, {"index": 3}))
    assert [ping.number for ping in survey] == [1, 3]
    assert survey.warnings[0].startswith(f"frame at byte 184 is left out: {field}: got")


@pytest.mark.parametrize("time_s", [5, 2**32 - 1])
def test_recording_without_a_date_is_rejected(tmp_path, time_s):
    with pytest.raises(SurveyFileError, match=f"frame at byte 8, time: got {time_s}"):
        read_survey(recording(tmp_path, 3, {"time_s": time_s}))


def test_recording_without_a_composite_ping_is_rejected(tmp_path):
    with pytest.raises(SurveyFileError, match="pings: got '0; skipped channel: left side-scan, not composite"):
        read_survey(recording(tmp_path, 3, {"channel": 0}, {"channel": 3}))


@pytest.mark.parametrize("version", [2, 3])
def test_date_is_that_of_the_first_frames(tmp_path, version):
    counters = [{"time_s": 1000 * number, "ms": 1000 * number} for number in range(1, 4)]
    survey = read_survey(recording(tmp_path, version, {"ms": 500}, *counters))
    assert [ping.time_utc_s - 1_378_847_588 for ping in survey] == [0.5, 1, 2, 3]
    wrong = read_survey(recording(tmp_path, version, {"time_s": 2_000_000_000}, {}, {}, *counters))
    assert wrong.pings[-1].time_utc_s == 1_378_847_588 + 3
    path = recording(tmp_path, version, {}, *counters)
    path.write_bytes(path.read_bytes()[:-1].replace(SAMPLES, SAMPLES[:-1], 1))  # the first frame has lost a byte
    assert [ping.time_utc_s - 1_378_847_588 for ping in read_survey(path)] == [1, 2]


@pytest.mark.parametrize(
    ("version", "sizes"), [(2, (144,)), (2, (160,)), (3, (168,)), (3, (180,)), (3, (128,)), (3, (180, 128, 168, 172))]
)
def test_header_is_what_the_samples_leave_of_a_frame(tmp_path, version, sizes):
    survey = read_survey(recording(tmp_path, version, *({"header_bytes": size} for size in sizes)))
    assert len(survey.pings) == len(sizes)
    for ping in survey:
        assert ping.channel(Side.PORT).samples.tolist() == [4, 3, 2, 1]
        assert ping.channel(Side.STARBOARD).samples.tolist() == [5, 6, 7, 8]


@pytest.mark.parametrize(("version", "header_bytes"), [(2, 140), (2, 264), (3, 124), (3, 170), (3, 264)])
def test_frame_with_an_implausible_header_is_left_out(tmp_path, version, header_bytes):
    path = recording(tmp_path, version, *([{"samples": SAMPLES * 32}] * 3))
    samples_at, samples_type = {2: (34, "<H"), 3: (44, "<I")}[version]
    size = HEADER_BYTES[version] + 8 * 32
    second = 8 + size
    raw = bytearray(path.read_bytes())
    struct.pack_into(samples_type, raw, second + samples_at, size - header_bytes)
    path.write_bytes(raw)
    survey = read_survey(path)
    assert len(survey.pings) == 2
    assert survey.warnings[0] == f"no frame at bytes {second} to {second + size - 1}: {size} bytes are left out"


@pytest.mark.parametrize("version", [2, 3])
def test_recorded_course_is_the_heading_of_a_recording_without_a_compass(tmp_path, version):
    east, north = 16_346_551, -5_276_871
    frames = [{"east": east, "north": north, "course": rad, "ms": 100, "speed": 2.0} for rad in (4.0, -1.0, 0.0)]
    survey = read_survey(recording(tmp_path, version, *frames))
    assert [ping.course_deg for ping in survey] == [pytest.approx(229.183), pytest.approx(302.704), None]
    assert [ping.heading_deg for ping in survey][:2] == [ping.course_deg for ping in survey][:2]
    assert [ping.heading_sigma_deg for ping in survey][:2] == [10, 10]
    assert any("heading is that of the course over ground" in text for text in survey.warnings)
    drifting = read_survey(recording(tmp_path, version, *({**frame, "speed": 0.2} for frame in frames)))
    assert {ping.heading_deg for ping in drifting} == {None}, "the course of a boat that does not move is noise"
    (compass,) = read_survey(recording(tmp_path, version, {"heading": 1.0, "course": 4.0})).pings
    assert (compass.heading_deg, compass.heading_sigma_deg) == (pytest.approx(57.296, abs=0.001), None)


@pytest.mark.parametrize("version", [2, 3])
def test_damage_is_local(tmp_path, version):
    path = recording(tmp_path, version, *({"index": number} for number in range(1, 7)))
    complete = path.read_bytes()
    size = HEADER_BYTES[version] + len(SAMPLES)
    size_at = {2: 28, 3: 8}[version]
    third = 8 + 2 * size
    for data, left in (
        # A lost byte before the sizes, in the samples, and an inserted one: the stored offsets are wrong from there.
        (complete[: third + 3] + complete[third + 4 :], [1, 2, 4, 5, 6]),
        (complete[: third + size - 1] + complete[third + size :], [1, 2, 4, 5, 6]),
        (complete[: third + 5] + b"\0" + complete[third + 5 :], [1, 2, 4, 5, 6]),
        (complete[: third + size_at] + b"\0\0" + complete[third + size_at + 2 :], [1, 2, 4, 5, 6]),
        (complete[:third] + b"\xff" * size + complete[third + size :], [1, 2, 4, 5, 6]),
        (complete[:third] + complete[third + 3 * size + 5 :], [1, 2]),  # what is left of the last frame has lost bytes
        (complete[: third + 5] + complete[-size:], [1, 2, 6]),
    ):
        path.write_bytes(data)
        survey = read_survey(path)
        assert [ping.number for ping in survey if ping.channel(Side.STARBOARD).samples.tolist() == [5, 6, 7, 8]] == left
        assert "no frame at bytes" in survey.warnings[0] or "inside its last frame" in survey.warnings[0]


@pytest.mark.parametrize("version", [2, 3])
def test_end_inside_a_frame_and_bytes_behind_the_last_one(tmp_path, version):
    path = recording(tmp_path, version, {}, {})
    complete = path.read_bytes()
    for data, pings, note in (
        (complete[:-1], 1, f"ends inside its last frame, as after a power failure: {HEADER_BYTES[version] + 7} bytes"),
        (complete[: -HEADER_BYTES[version]], 1, "ends inside its last frame, as after a power failure: 8 bytes"),
        (complete + b"\x05\x01", 2, "ends inside its last frame, as after a power failure: 2 bytes"),
        (complete + bytes(4096), 2, "the file ends with 4096 zero bytes"),
    ):
        path.write_bytes(data)
        survey = read_survey(path)
        assert len(survey.pings) == pings
        assert note in survey.warnings[0]
    for number in (0, 1, 4):
        path.write_bytes(struct.pack("<4H", number, 2, 3200, 1))
        with pytest.raises(SurveyFileError, match="format"):
            read_survey(path)
    for data in (complete[:5], complete[:8], complete[:100], complete[:8] + bytes(range(1, 256)) * 40):
        path.write_bytes(data)
        with pytest.raises(SurveyFileError):
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
