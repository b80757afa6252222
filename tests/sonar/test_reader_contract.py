"""The contract of survey readers, for every file format."""

import dataclasses
import os
import tracemalloc

import numpy as np
import pytest
from builders.surveys import MAKERS

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.geometry import Position, offset_between_m, offset_position
from sonarpost.sonar.options import Mounting, SurveyOptions
from sonarpost.sonar.readers import open_survey, read_survey, recording_parts
from sonarpost.sonar.readers.humminbird import SAMPLE_SPACING_M
from sonarpost.sonar.survey import Side

STORED = dict.fromkeys(MAKERS, lambda path: path) | {
    "humminbird": lambda path: path.with_suffix("") / "B003.SON",
    "waterfall": lambda path: path.with_name("line.csv"),
}
"""The file with the navigation of the pings, by format."""

pytestmark = pytest.mark.parametrize("kind", sorted(MAKERS))


def test_samples_and_navigation_are_read(kind, small_survey, tmp_path):
    written = small_survey()
    read = read_survey(MAKERS[kind](written, tmp_path))
    assert len(read.pings) == len(written.pings)
    assert read.line_name == "line"
    for got, want in zip(read, written, strict=True):
        assert got.number == want.number
        assert got.time_utc_s == pytest.approx(want.time_utc_s, abs=0.006)
        for side in Side:
            stored, expected = got.channel(side).samples, want.channel(side).samples
            if stored.dtype.kind == "f":  # amplitudes of decibels
                np.testing.assert_allclose(stored, np.maximum(expected, 1), rtol=1e-3)
            else:
                np.testing.assert_array_equal(stored, expected)
            # Humminbird records no range: 40 samples of its assumed spacing.
            range_m = 40 * SAMPLE_SPACING_M if kind == "humminbird" else want.channel(side).slant_range_m
            assert got.channel(side).slant_range_m == pytest.approx(range_m, abs=0.01)
        off_m = offset_between_m(Position(want.lat_deg, want.lon_deg), Position(got.lat_deg, got.lon_deg))
        assert np.hypot(*off_m) < 0.8  # Humminbird stores Mercator coordinates in whole metres
        assert got.heading_deg == pytest.approx(want.heading_deg, abs=0.05)
        assert got.speed_mps == pytest.approx(want.speed_mps, abs=0.05)
        for name in ("altitude_m", "depth_m", "pitch_deg", "roll_deg"):
            stored = None if kind in ("humminbird", "sl2", "sl3", "svlog") else getattr(want, name)
            assert getattr(got, name) == pytest.approx(stored, abs=0.01), name


def test_info_matches_pings_and_iteration_can_be_repeated(kind, small_survey, tmp_path):
    with open_survey(MAKERS[kind](small_survey(), tmp_path)) as source:
        first, second = list(source.pings()), list(source.pings())
        assert source.info.ping_count == len(first) == 5
        assert source.info.sides == tuple(Side)
        together = list(zip(source.pings(), source.pings(), strict=True))  # two iterators at a time
    assert [p.number for p in first] == [p.number for p in second] == [p.number for p, _ in together]
    assert all(a.number == b.number for a, b in together)


def test_jumps_of_position_and_time_are_reported_and_a_repeated_position_is_accepted(kind, small_survey, tmp_path):
    pings = list(small_survey(pings=24).pings)
    pings[4] = dataclasses.replace(pings[4], lat_deg=49.9)
    pings[14:] = [dataclasses.replace(ping, lat_deg=ping.lat_deg + 1) for ping in pings[14:]]
    goes_back = kind != "humminbird"  # its channels are paired by an unsigned time
    pings[8] = dataclasses.replace(pings[8], time_utc_s=pings[8].time_utc_s - 30 * goes_back)
    read = read_survey(MAKERS[kind](dataclasses.replace(small_survey(), pings=tuple(pings)), tmp_path))
    assert [row for row, ping in enumerate(read) if ping.lat_deg is None] == [4, 14, 15, 16, 17]
    assert any("too far from the one before, in 5 of 24 pings, the first in row 4" in w for w in read.warnings)
    assert any("time goes back in 1 of 24 pings, the first in row 8" in w for w in read.warnings) is goes_back


def test_mounting_shifts_every_position(kind, small_survey, tmp_path):
    path = MAKERS[kind](small_survey(), tmp_path)
    options = SurveyOptions(mounting=Mounting(forward_m=2, starboard_m=3, layback_m=42, heading_offset_deg=10))
    for plain, moved in zip(read_survey(path), read_survey(path, options), strict=True):
        assert moved.heading_deg == pytest.approx((plain.heading_deg + 10) % 360)
        want = offset_position(Position(plain.lat_deg, plain.lon_deg), moved.heading_deg, -40)
        want = offset_position(want, moved.heading_deg + 90, 3)
        assert np.hypot(*offset_between_m(want, Position(moved.lat_deg, moved.lon_deg))) < 0.001


def test_every_truncation_raises_error_or_gives_complete_pings(kind, small_survey, tmp_path):
    path = MAKERS[kind](small_survey(), tmp_path)
    stored = STORED[kind](path)
    complete, has_note = stored.read_bytes(), []
    for length in range(0, len(complete), max(len(complete) // 40, 1)):
        stored.write_bytes(complete[:length])
        try:
            survey = read_survey(path)
        except SurveyFileError:
            continue
        assert all(channel.samples.size == 40 for ping in survey for channel in ping.channels)
        has_note.append(any("the file ends inside its last" in warning for warning in survey.warnings))
    # A cut between two pings has no note.
    assert kind == "waterfall" or has_note.count(True) > 0.8 * len(has_note) > 0


def test_file_modified_while_read_is_an_error(kind, small_survey, tmp_path):
    path = MAKERS[kind](small_survey(pings=30), tmp_path)
    with open_survey(path) as source:
        pings = source.pings()
        next(pings)
        with STORED[kind](path).open("ab") as file:
            file.write(b"more")
        os.utime(STORED[kind](path), ns=(1, 1))
        with pytest.raises(SurveyFileError, match="changed while"):
            list(pings)


def test_replaced_file_is_read_to_its_end_and_a_missing_or_irregular_one_rejected(kind, small_survey, tmp_path):
    path = MAKERS[kind](small_survey(), tmp_path)
    stored = STORED[kind](path)
    with open_survey(path) as source:
        before = [p.time_utc_s for p in source.pings()]
        stored.unlink()
        stored.write_bytes(b"something else")
        assert [p.time_utc_s for p in source.pings()] == before
    stored.unlink()
    if kind != "humminbird":  # one side alone is a valid recording
        with pytest.raises(SurveyFileError, match="No such file"):
            open_survey(path)
    os.mkfifo(stored)
    with pytest.raises(SurveyFileError, match="not a regular file"):
        open_survey(path)


@pytest.mark.system
def test_memory_is_independent_of_file_length(kind, small_survey, tmp_path):
    """Reading a file of three times the length needs no more memory."""
    if kind == "waterfall":
        return  # images are decoded completely, up to image_files.MAX_PIXELS
    peaks = []
    for number, pings in enumerate((300, 900)):
        folder = tmp_path / str(number)
        folder.mkdir()
        path = MAKERS[kind](small_survey(pings=pings, samples=1000), folder)
        tracemalloc.start()
        with open_survey(path) as source:
            assert sum(1 for _ in source.pings()) == pings
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0] + 100_000
    assert peaks[1] < 3_000_000


def test_parts_are_the_files_that_the_recording_needs(kind, small_survey, tmp_path):
    """All parts exist; without any of them the recording is not complete, and a copy of the parts can be read."""
    path = MAKERS[kind](small_survey(), tmp_path)
    parts = recording_parts(path)
    assert parts[0] == path
    assert STORED[kind](path) in parts
    assert all(part.is_file() and part.is_relative_to(tmp_path) for part in parts)
    copied = tmp_path / "copy"
    for part in parts:
        target = copied / part.relative_to(tmp_path)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(part.read_bytes())
    assert len(read_survey(copied / path.name).pings) == 5
    for part in parts[1:]:
        part.unlink()
        assert recording_parts(path) == parts
