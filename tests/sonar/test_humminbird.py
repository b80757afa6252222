"""Humminbird recordings: headers of other models, one side, damage, a recording."""

import struct

import numpy as np
import pytest
from builders.surveys import make_humminbird, mercator, son_ping
from PIL import Image

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.bottom_track import altitudes_m
from sonarpost.sonar.geometry import along_track_m
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import Side


@pytest.fixture
def recording(small_survey, tmp_path):
    path = make_humminbird(small_survey(), tmp_path)
    return path, path.with_suffix("") / "B002.SON", path.with_suffix("") / "B003.SON"


def test_longer_headers_are_parsed_by_tags(recording):
    path, port, starboard = recording
    extra = b"".join(struct.pack(">BI", tag, 7) for tag in range(0xA1, 0xB2)) + b"\x60\x01"
    for side in (port, starboard):
        side.write_bytes(son_ping(3, 500, b"\x01\x02\x03", extra) + son_ping(4, 600, b"\x04"))
    survey = read_survey(path)
    assert [ping.channel(Side.PORT).samples.tolist() for ping in survey] == [[1, 2, 3], [4]]


def test_ping_with_one_side_only(recording):
    path, port, starboard = recording
    port.write_bytes(son_ping(1, 0, b"a") + son_ping(3, 40, b"b") + son_ping(5, 80, b"c"))
    starboard.write_bytes(son_ping(2, 0, b"d") + son_ping(6, 80, b"e"))
    survey = read_survey(path)
    assert ["".join(c.side.value[0] for c in ping.channels) for ping in survey] == ["ps", "p", "ps"]
    assert "only one side in 1 of 3 pings" in survey.warnings
    starboard.unlink()
    assert read_survey(path).sides() == (Side.PORT,)
    port.unlink()
    with pytest.raises(SurveyFileError, match="side-scan channels"):
        read_survey(path)


def test_depth_and_sample_spacing_options(recording):
    path, *_ = recording
    plain = read_survey(path)
    assert plain.pings[0].altitude_m is None
    assert any("slant range is not recorded: assuming 0.0191 m" in w for w in plain.warnings)
    options = SurveyOptions(humminbird_sample_spacing_m=0.05, humminbird_depth_as_altitude=True)
    survey = read_survey(path, options)
    assert survey.pings[0].altitude_m == pytest.approx(6.2)
    assert survey.pings[0].channels[0].slant_range_m == pytest.approx(2.0)
    assert survey.warnings == ()


@pytest.mark.parametrize(
    "damage",
    [
        lambda raw: b"\x00" + raw[1:],
        lambda raw: raw[:4] + b"\x10" + raw[5:],
        lambda raw: raw.replace(b"\xa0\x00\x00\x00\x28\x21", b"\xa0\x00\x00\x00\x00\x21", 1),
        lambda raw: raw.replace(b"\xa0\x00\x00\x00\x28\x21", b"\xa0\xff\xff\xff\xff\x21", 1),
        lambda raw: raw.replace(b"\xa0\x00\x00\x00\x28\x21", b"\xa0\x00\x00\x00\x28\x22", 1),
        lambda raw: raw[:4] + b"\xa0\x00\x00\x00\x28\x21" + raw[10:],
        lambda raw: raw[:4] + b"\x41\x00" * 500 + raw[4:],
        lambda raw: raw[:60] + raw[61:],
    ],
    ids=["start", "tag", "no samples", "too many samples", "end of the header", "no fields", "too long", "lost byte"],
)
def test_ping_with_a_damaged_header_is_left_out(recording, damage):
    path, port, starboard = recording
    complete = read_survey(path)
    port.write_bytes(damage(port.read_bytes()))
    survey = read_survey(path)
    assert [len(ping.channels) for ping in survey] == [1, 2, 2, 2, 2]
    for damaged, whole in zip(survey, complete, strict=True):
        for channel in damaged.channels:
            np.testing.assert_array_equal(channel.samples, whole.channel(channel.side).samples)
    assert any(text.startswith("no ping of B002.SON at bytes 0 to ") for text in survey.warnings)
    starboard.unlink()
    port.write_bytes(damage(son_ping(1, 0, bytes(40))))
    with pytest.raises(SurveyFileError, match="line"):
        read_survey(path)


@pytest.mark.parametrize("row", [0, 1, 5, 10, 11])
@pytest.mark.parametrize("field", [b"\x80", b"\x81"], ids=["number", "time"])
@pytest.mark.parametrize("value", [0xFFFFFFFF, 2000, 0], ids=["great", "of another ping", "zero"])
def test_wrong_time_or_number_of_one_ping_leaves_the_others_joined(small_survey, tmp_path, row, field, value):
    path = make_humminbird(small_survey(pings=12), tmp_path)
    complete = [{channel.side for channel in ping.channels} for ping in read_survey(path)]
    assert complete == [set(Side)] * 12
    for name in ("B002.SON", "B003.SON"):
        file = path.with_suffix("") / name
        raw = file.read_bytes()
        starts = [at for at in range(len(raw)) if raw[at : at + 5] == b"\xc0\xde\xab\x21\x80"]
        at = starts[row] + {b"\x80": 5, b"\x81": 10}[field]
        file.write_bytes(raw[:at] + value.to_bytes(4, "big") + raw[at + 4 :])
        survey = read_survey(path)
        joined = [ping for ping in survey if len(ping.channels) == 2]
        assert len(joined) == (12 if field == b"\x80" else 11)
        file.write_bytes(raw)


def test_lost_pings_of_one_side_and_a_pause_leave_the_others_joined(recording):
    path, port, starboard = recording
    times = [*range(0, 4000, 40), *range(600_000, 604_000, 40)]
    pings = [(number, son_ping(number, time_ms, b"abcd")) for number, time_ms in enumerate(times)]
    starboard.write_bytes(b"".join(ping for _, ping in pings))
    port.write_bytes(b"".join(ping for number, ping in pings if not 20 <= number < 150))
    survey = read_survey(path)
    assert [ping.number for ping in survey] == list(range(200))
    assert [len(ping.channels) for ping in survey] == [2] * 20 + [1] * 130 + [2] * 50


def test_pings_after_the_clock_was_set_back_are_read(recording):
    path, port, starboard = recording
    times = [*range(9000, 9400, 40), *range(0, 400, 40)]
    for side in (port, starboard):
        side.write_bytes(b"".join(son_ping(number, time_ms, b"abcd") for number, time_ms in enumerate(times)))
    survey = read_survey(path)
    assert [(ping.number, len(ping.channels)) for ping in survey] == [(number, 2) for number in range(20)]
    assert any("time goes back in 1 of 20 pings, the first in row 10" in text for text in survey.warnings)


def test_invalid_dat_file_is_rejected(recording):
    path, *_ = recording
    for dat in (b"", bytes(64), b"\xc1" + bytes(63), b"\xc1" * 70_000):
        path.write_bytes(dat)
        with pytest.raises(SurveyFileError, match=r"line\.DAT"):
            read_survey(path)


def test_missing_fix_is_none(recording):
    path, port, starboard = recording
    fixes = ((0, 0), (2**31 - 1, 1), mercator(-36.5, 150.2))
    pings = [son_ping(n, n * 40, b"a", east=east, north=north) for n, (east, north) in enumerate(fixes)]
    for side in (port, starboard):
        side.write_bytes(b"".join(pings))
    survey = read_survey(path)
    assert [ping.lat_deg is None for ping in survey] == [True, True, False]
    assert (survey.pings[2].lat_deg, survey.pings[2].lon_deg) == pytest.approx((-36.5, 150.2), abs=1e-5)


@pytest.mark.realdata
@pytest.mark.system
def test_humminbird_recording(data_dir):
    folder = data_dir / "surveys"
    survey = read_survey(folder / "humminbird" / "test.DAT")
    for side, name in ((Side.PORT, "B002_port"), (Side.STARBOARD, "B003_stbd")):
        image = np.asarray(Image.open(folder / "derived" / f"pyhum_{name}.png"))
        np.testing.assert_array_equal(np.nan_to_num(survey.waterfall(side)), image)
    assert len(survey.warnings) == 2
    # Speed and position are independent in the recording and agree.
    times = np.array([ping.time_utc_s for ping in survey])
    distance_m = np.trapezoid([ping.speed_mps for ping in survey], times)
    assert along_track_m(survey)[-1] == pytest.approx(distance_m, rel=0.05)
    # Expected values were read from the image. The echo sounder agrees with them except in the last third.
    altitude_m = altitudes_m(survey)
    samples = altitude_m / survey.pings[0].channels[0].sample_spacing_m
    assert samples[[0, 800, 1800, 2200, 2800, 3400]] == pytest.approx([96, 230, 257, 160, 57, 97], abs=12)
    sounder = read_survey(folder / "humminbird" / "test.DAT", SurveyOptions(humminbird_depth_as_altitude=True))
    depth_m = np.array([ping.altitude_m for ping in sounder])
    assert np.median(np.abs(altitude_m[:2250] - depth_m[:2250])) < 0.4
    assert np.median(np.abs(altitude_m[2600:] - depth_m[2600:])) > 1


@pytest.mark.parametrize("size_bytes", [96, 100])
def test_date_of_a_solix_recording_is_little_endian(recording, size_bytes):
    path, *_ = recording
    whole, dat = read_survey(path), bytearray(size_bytes)
    struct.pack_into("<I", dat, 20, 1_600_000_000)
    path.write_bytes(dat)
    survey = read_survey(path)
    assert survey.pings[0].time_utc_s == pytest.approx(whole.pings[0].time_utc_s % 1 + 1_600_000_000)
    for value in (0, 5, 2**32 - 1):
        struct.pack_into("<I", dat, 20, value)
        path.write_bytes(dat)
        with pytest.raises(SurveyFileError, match="time"):
            read_survey(path)
