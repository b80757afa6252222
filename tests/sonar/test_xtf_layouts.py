"""XTF recordings whose pings are spread over packets, and their damage."""

import struct
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from builders.surveys import small_survey
from builders.two_frequencies import FIRST_HZ, SECOND_HZ, with_second_frequency
from builders.xtf import write_xtf
from builders.xtf_layouts import (
    FILE_HEADER,
    ONE_FREQUENCY,
    PING_HEADER,
    TWO_FREQUENCIES,
    UNNAMED_FREQUENCIES,
    Layout,
    in_layout,
)
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import open_survey, read_survey
from sonarpost.sonar.survey import Side

PINGS = 16
FIRST_M, SECOND_M = 25.0, 60.0
ONE_PACKET = Layout(((0, 1),), (0,))


def survey_of(frequencies=1, interval_s=0.2):
    survey = small_survey(np.uint16, pings=PINGS, samples=24)
    pings = (replace(ping, time_utc_s=1_378_847_588 + row * interval_s) for row, ping in enumerate(survey.pings))
    one = replace(survey, pings=tuple(pings))
    return one if frequencies == 1 else with_second_frequency(one, 32, SECOND_M)


def written(survey, path, layout):
    """Write a survey in a layout; return its bytes."""
    write_xtf(survey, path)
    data = in_layout(path.read_bytes(), layout)
    path.write_bytes(data)
    return data


def content(ping):
    return round(ping.time_utc_s, 2), {channel.side: channel.samples.tobytes() for channel in ping.channels}


def expected(survey, channels=slice(0, 2)):
    return [content(replace(ping, channels=ping.channels[channels])) for ping in survey]


@pytest.mark.parametrize("layout", ONE_FREQUENCY, ids=str)
def test_sides_in_packets_of_their_own_are_one_ping(layout, tmp_path):
    survey = survey_of()
    written(survey, tmp_path / "line.xtf", layout)
    read = read_survey(tmp_path / "line.xtf")
    assert read.warnings == ()
    times = [ping.time_utc_s for ping in read]
    assert [content(ping)[1] for ping in read] == [samples for _, samples in expected(survey)]
    np.testing.assert_allclose(times, [ping.time_utc_s for ping in survey], atol=0.006)


@pytest.mark.parametrize("layout", TWO_FREQUENCIES, ids=str)
def test_two_frequencies_are_two_channel_sets(layout, tmp_path):
    survey = survey_of(2)
    written(survey, tmp_path / "line.xtf", layout)
    for wanted_hz, frequency_hz, channels in ((None, FIRST_HZ, slice(0, 2)), (SECOND_HZ, SECOND_HZ, slice(2, 4))):
        with open_survey(tmp_path / "line.xtf", SurveyOptions(frequency_hz=wanted_hz)) as source:
            pings = list(source.pings())
            assert [(each.frequency_hz, each.ping_count) for each in source.info.channel_sets] == [
                (FIRST_HZ, PINGS),
                (SECOND_HZ, PINGS),
            ]
            assert "2 channel sets: 900 kHz in 16 pings; 400 kHz in 16 pings" in source.info.warnings[0]
            assert (len(source.info.warnings), source.info.sides) == (1, tuple(Side))
        assert [content(ping) for ping in pings] == expected(survey, channels)
        assert {channel.frequency_hz for ping in pings for channel in ping.channels} == {frequency_hz}


@pytest.mark.parametrize("layout", UNNAMED_FREQUENCIES, ids=str)
def test_frequencies_that_the_file_does_not_name_are_not_mixed(layout, tmp_path):
    survey = survey_of(2)
    written(survey, tmp_path / "line.xtf", layout)
    read = read_survey(tmp_path / "line.xtf")
    assert [content(ping) for ping in read] == expected(survey)
    assert {channel.slant_range_m for ping in read for channel in ping.channels} == {FIRST_M}
    assert "2 channel sets" in read.warnings[0]


@pytest.mark.parametrize("layout", [ONE_PACKET, ONE_FREQUENCY[0], ONE_FREQUENCY[2]], ids=str)
def test_recorder_without_ping_numbers_and_with_whole_seconds(layout, tmp_path):
    survey = survey_of(interval_s=0.0)
    unnumbered = replace(survey, pings=tuple(replace(ping, number=0) for ping in survey))
    written(unnumbered, tmp_path / "line.xtf", layout)
    assert [content(ping) for ping in read_survey(tmp_path / "line.xtf")] == expected(survey)


def test_sides_whose_packets_are_numbered_one_after_the_other(tmp_path):
    survey = survey_of()
    written(survey, tmp_path / "line.xtf", replace(ONE_FREQUENCY[0], consecutive=True, delay_hundredths=1))
    assert [content(ping) for ping in read_survey(tmp_path / "line.xtf")] == expected(survey)


def test_packets_of_the_sides_in_batches(tmp_path):
    survey = survey_of()
    path = tmp_path / "line.xtf"
    data = written(survey, path, ONE_FREQUENCY[0])
    bounds = bounds_of(data, ONE_FREQUENCY[0])
    pings = [data[start:end] for start, end in pairwise(bounds)]
    ports, starboards = ([ping[half : half + len(ping) // 2] for ping in pings] for half in (0, len(pings[0]) // 2))
    batches = (b"".join(side[row : row + 5]) for row in range(0, PINGS, 5) for side in (ports, starboards))
    path.write_bytes(data[:FILE_HEADER] + b"".join(batches))
    assert [content(ping) for ping in read_survey(path)] == expected(survey)


def test_packets_without_channels_are_noted_and_not_pings(tmp_path):
    survey = survey_of()
    path = tmp_path / "line.xtf"
    data = written(survey, path, ONE_PACKET)
    empty = bytearray(data[FILE_HEADER : FILE_HEADER + PING_HEADER])
    struct.pack_into("<H4xI", empty, 4, 0, PING_HEADER)
    path.write_bytes(data[:FILE_HEADER] + bytes(empty) * 3 + data[FILE_HEADER:] + bytes(empty))
    read = read_survey(path)
    assert [content(ping) for ping in read] == expected(survey)
    assert read.warnings == ("skipped packet without channels: not a ping (4 times)",)
    path.write_bytes(data[:FILE_HEADER] + bytes(empty) * 3)
    with pytest.raises(SurveyFileError, match=r"got '0; skipped packet without channels: not a ping \(3 times\)"):
        read_survey(path)


def bounds_of(data, layout):
    """Return the start of each ping, and the end of the file."""
    starts, offset = [], FILE_HEADER
    while offset < len(data):
        starts.append(offset)
        offset += struct.unpack_from("<I", data, offset + 10)[0]
    return [*starts[:: len(layout.packets)], len(data)]


@given(
    layout=st.sampled_from((ONE_PACKET, *ONE_FREQUENCY, *TWO_FREQUENCIES, *UNNAMED_FREQUENCIES)),
    kind=st.sampled_from(("delete", "overwrite", "insert")),
    place=st.floats(0, 1),
    count=st.integers(1, 200) | st.integers(1, 8000),
    seed=st.integers(0, 2**32 - 1),
)
def test_damage_of_packets_does_not_affect_other_pings(layout, kind, place, count, seed, tmp_path_factory):
    path = tmp_path_factory.mktemp("damaged") / "line.xtf"
    data = written(survey_of(1 if layout in (ONE_PACKET, *ONE_FREQUENCY) else 2), path, layout)
    complete = [content(ping) for ping in read_survey(path)]
    bounds = bounds_of(data, layout)
    first = FILE_HEADER + round(place * (len(data) - FILE_HEADER - 1))
    end = first if kind == "insert" else min(first + count, len(data))
    new = b"" if kind == "delete" else np.random.default_rng(seed).bytes(count if kind == "insert" else end - first)
    path.write_bytes(data[:first] + new + data[end:])
    untouched = [
        ping
        for ping, start, stop in zip(complete, *zip(*pairwise(bounds), strict=True), strict=True)
        if stop <= first or start >= max(end, first + 1)
    ]
    try:
        read = [content(ping) for ping in read_survey(path)]
    except SurveyFileError:
        assert not untouched
        return
    assert [ping for ping in untouched if ping not in read] == []
    assert len([ping for ping in read if ping not in complete]) <= (PINGS - len(untouched)) * len(layout.packets)
