"""Klein SDF: page versions, frequencies, sides, navigation, time, damage."""

import math
import struct

import numpy as np
import pytest
from builders.surveys import sdf_other, sdf_page

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import Side

PORT = np.array([1, 2, 3, 4_000_000_000], np.uint32)
STARBOARD = np.array([5, 6, 7, 8], np.uint32)
NONE = np.array([], np.uint32)


def recording(tmp_path, *pages):
    path = tmp_path / "line.sdf"
    path.write_bytes(b"".join(pages))
    return path


def read_one(tmp_path, **values):
    (ping,) = read_survey(recording(tmp_path, sdf_page(7, PORT, STARBOARD, **values))).pings
    return ping


def test_samples_of_32_bits_are_nearest_first_on_both_sides(tmp_path):
    ping = read_one(tmp_path, range_m=75)
    assert [c.side for c in ping.channels] == [Side.PORT, Side.STARBOARD]
    assert [c.samples.tolist() for c in ping.channels] == [PORT.tolist(), STARBOARD.tolist()]
    assert [(c.slant_range_m, c.frequency_hz, c.scale) for c in ping.channels] == [(75.0, 900_000.0, 1.0)] * 2
    assert read_one(tmp_path, khz=0).channels[0].frequency_hz is None
    pages = [sdf_page(number, PORT, STARBOARD, rest=b"\xff" * 216) for number in range(3)]
    survey = read_survey(recording(tmp_path, *pages))  # bytes after the samples are skipped
    assert [(p.number, [c.samples.size for c in p.channels]) for p in survey] == [(n, [4, 4]) for n in range(3)]


def test_both_frequencies_are_channel_sets_of_one_ping(tmp_path):
    """In any order of the pages."""
    high, low = np.arange(6), np.arange(3)
    pages = [sdf_page(1, high, high, 3502), sdf_page(2, low, low, 3501, khz=400), sdf_page(2, high, high, 3502)]
    pages += [sdf_page(3, high, high, 3502), sdf_page(3, low, low, 3501, khz=400), sdf_page(9, low, low, 3501, khz=400)]
    path = recording(tmp_path, *pages)
    survey = read_survey(path)
    assert [(p.number, [(c.samples.size, c.index) for c in p.channels]) for p in survey] == [
        (number, [(6, 1)] * 2) for number in (1, 2, 3)
    ]
    assert any("2 channel sets: 900 kHz in 3 pings; 400 kHz in 3 pings" in w for w in survey.warnings)
    assert "left out pings without a channel of 900 kHz: 1" in survey.warnings
    survey = read_survey(path, SurveyOptions(frequency_hz=400e3))
    assert [(p.number, [(c.samples.size, c.index) for c in p.channels]) for p in survey] == [
        (number, [(3, 0)] * 2) for number in (2, 3, 9)
    ]


def test_pages_without_a_frequency_are_told_apart_by_their_version(tmp_path):
    pages = [sdf_page(1, np.arange(n), NONE, version, khz=0) for n, version in ((6, 3502), (3, 3501), (4, 3501))]
    survey = read_survey(recording(tmp_path, *pages))
    assert [[c.samples.size for c in p.channels] for p in survey] == [[3], [4]]
    assert any("2 channel sets" in w for w in survey.warnings)


@pytest.mark.parametrize("version", [3000, 3500, 3503])
def test_file_of_another_page_version_is_refused_by_its_number(tmp_path, version):
    path = recording(tmp_path, sdf_other(version, bytes(600)), sdf_other(version, bytes(600)))
    want = rf"page version: got .{version} \(2 times\).*, expected 3501 or 3502"
    with pytest.raises(SurveyFileError, match=want):
        read_survey(path)


@pytest.mark.parametrize(
    ("page", "warning"),
    [
        (sdf_other(3503, b""), "skipped page of version 3503: not side-scan of a UUV-3500 sonar (3501, 3502)"),
        (sdf_page(1, PORT, STARBOARD, count=3), "skipped page: a side has another number of samples than its header"),
        (sdf_page(1, PORT, STARBOARD, range_m=0), "skipped page: no samples, or impossible range"),
        (sdf_page(1, PORT, STARBOARD, range_m=10_001), "skipped page: no samples, or impossible range"),
        (sdf_page(1, PORT, STARBOARD, range_m=2**32 - 1), "skipped page: no samples, or impossible range"),
    ],
)
def test_page_that_cannot_be_used_is_left_out(tmp_path, page, warning):
    survey = read_survey(recording(tmp_path, page, sdf_page(2, PORT, STARBOARD)))
    assert [p.number for p in survey] == [2]
    assert survey.warnings[0] == f"{warning} (1 times)"
    assert "no position fix in 1 of 1 pings, the first in row 0" in survey.warnings
    assert "no heading in 1 of 1 pings, the first in row 0" in survey.warnings


def test_page_of_one_side(tmp_path):
    without_count = sdf_other(3502, sdf_page(1, PORT, NONE)[12:-4])
    pages = [without_count, sdf_page(2, NONE, STARBOARD), sdf_page(3, NONE, NONE)]
    survey = read_survey(recording(tmp_path, *pages))
    assert [[c.side for c in p.channels] for p in survey] == [[Side.PORT], [Side.STARBOARD]]
    assert "skipped page: no samples, or impossible range (1 times)" in survey.warnings


def test_navigation_of_the_vehicle_is_unknown_where_it_is_absent_or_implausible(tmp_path):
    names = ("lat_deg", "lon_deg", "altitude_m", "depth_m", "speed_mps", "heading_deg", "pitch_deg", "roll_deg")
    nan = float("nan")
    values = {"altitude": -1.0, "depth": 1e9, "speed": 2**32 - 1, "heading": -5.0, "pitch": 91.0, "roll": nan}
    for none in (read_one(tmp_path), read_one(tmp_path, lat=2.0, lon=nan, **values)):
        assert all(getattr(none, name) is None for name in names)
    values = {"altitude": 6.0, "depth": 14.0, "speed": 103, "heading": 360.0, "pitch": 1.0, "roll": -1.0}
    ping = read_one(tmp_path, lat=math.radians(48.3), lon=math.radians(-68.3), **values)
    got = [getattr(ping, name) for name in names]
    assert got == pytest.approx([48.3, -68.3, 6.0, 14.0, 1.03, 0.0, 1.0, -1.0])
    # One of both angles may be 0.
    level = read_one(tmp_path, roll=2.0)
    assert (level.pitch_deg, level.roll_deg) == (0.0, 2.0)


def test_time_with_fraction(tmp_path):
    assert read_one(tmp_path, fraction=0.25).time_utc_s == 1_378_847_588.25
    for value in (1.0, -0.5, float("nan")):
        assert read_one(tmp_path, fraction=value).time_utc_s == 1_378_847_588
    for values in ({"year": 1969}, {"month": 13}, {"day": 0}, {"hour": 24}, {"year": 2**32 - 1}):
        with pytest.raises(SurveyFileError, match="date and time"):
            read_one(tmp_path, **values)


def test_cut_last_page_is_left_out(tmp_path):
    path = recording(tmp_path, *(sdf_page(number, PORT, STARBOARD) for number in range(3)))
    complete = path.read_bytes()
    page_bytes = len(complete) // 3
    for left in (1, 7, 12, 500, page_bytes - 1):
        path.write_bytes(complete[: 2 * page_bytes + left])
        survey = read_survey(path)
        assert [p.number for p in survey] == [0, 1]
        assert survey.warnings[0].startswith(f"the file ends inside its last page, as after a power failure: {left} ")
    for length in (0, 3, 9, 12, 516, page_bytes - 1):
        with pytest.raises(SurveyFileError, match="pings: got '0"):
            read_survey(recording(tmp_path, complete[:length]))


@pytest.mark.parametrize(
    ("offset", "value", "note"),
    [
        (0, 0xFFFFFFFE, "no page at bytes 0 to 555"),
        (4, 7, "no page at bytes 0 to 555"),
        (4, 511, "no page at bytes 0 to 555"),
        (4, (1 << 24) + 9, "no page at bytes 0 to 555"),
        (4, 5000, "no page at bytes 0 to 555"),
        (4, 560, "no page at bytes 0 to 555"),
        (4, 0xFFFFFFFF, "no page at bytes 0 to 555"),
        (8, 256, "no page at bytes 0 to 555"),
        (76, 13, "page at byte 0 is left out: date and time: got (2013, 13, 10, 21, 13, 8)"),
        (184, 256, "page at byte 0 is left out: size of the header: got 256, expected 512"),
        (516, 10, "page at byte 0 is left out: number of port samples: got 10, expected up to 9"),
        (516, 2**32 - 1, "page at byte 0 is left out: number of port samples: got 4294967295"),
        (536, 5, "page at byte 0 is left out: number of starboard samples: got 5, expected up to 4"),
    ],
)
def test_damaged_page_is_left_out(tmp_path, offset, value, note):
    content = bytearray(sdf_page(1, PORT, STARBOARD))
    struct.pack_into("<I", content, offset, value)
    survey = read_survey(recording(tmp_path, content, *(sdf_page(number, PORT, STARBOARD) for number in (2, 3))))
    assert [ping.number for ping in survey] == [2, 3]
    assert survey.warnings[0].startswith(note)
    with pytest.raises(SurveyFileError):
        read_survey(recording(tmp_path, content))


@pytest.mark.parametrize("lost", [1, 4, 12, 200, 600])
def test_saturated_samples_are_not_taken_for_pages(tmp_path, lost):
    """They have the value of the marker. A page between two damaged places is read: its content proves it."""
    samples = np.full(3000, 0xFFFFFFFF, np.uint32)
    samples[100::200], samples[101::200] = 600, 3501  # like the start of a page
    pages = [sdf_page(number, samples, samples, rest=b"\xff" * 40 + b"end") for number in range(5)]
    path = recording(tmp_path, pages[0], pages[1][lost:], pages[2], pages[3][lost:], pages[4])
    survey = read_survey(path)
    assert [ping.number for ping in survey] == [0, 2, 4]
    assert all(np.array_equal(channel.samples, samples) for ping in survey for channel in ping.channels)
    assert sum(f"{len(pages[0]) - lost} bytes are left out" in w for w in survey.warnings) == 2


def test_file_of_another_kind_is_refused_by_its_first_bytes(tmp_path):
    with pytest.raises(SurveyFileError, match="page at byte 0, marker: got '74686973', expected ffffffff"):
        read_survey(recording(tmp_path, b"this is a text"))
