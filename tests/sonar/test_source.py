"""Surveys read in strips, with bounded memory."""

from itertools import pairwise

import numpy as np
import pytest

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.source import InMemorySource, load_survey, strips
from sonarpost.sonar.survey import ChannelPing, Ping, Side


def pings(count, samples=4):
    return [Ping(n, float(n), (ChannelPing(Side.PORT, np.zeros(samples, dtype=np.uint8), 10.0),)) for n in range(count)]


@pytest.mark.parametrize("count", [1, 9, 10, 11, 15, 16, 30, 107])
@pytest.mark.parametrize("overlap", [0, 4, 9])
def test_strips_cover_stream_and_overlap(count, overlap):
    found = list(strips(pings(count), 10, overlap))
    assert [s.is_last for s in found] == [False] * (len(found) - 1) + [True]
    for strip in found:
        assert [p.number for p in strip.pings] == list(range(strip.first_row, strip.first_row + len(strip.pings)))
        assert len(strip.pings) <= 15
    for one, other in pairwise(found):
        assert other.first_row == one.first_row + len(one.pings) - overlap
        assert len(one.pings) == 10
    assert found[-1].first_row + len(found[-1].pings) == count
    # A short rest is part of the strip before it, so that no strip consists mostly of overlap.
    assert len(found) == 1 or len(found[-1].pings) > overlap


def test_byte_limit_shortens_strips():
    assert list(strips([], 10, 2)) == []
    found = list(strips(pings(100, samples=1000), 50, 4, max_bytes=20_000))
    assert max(len(s.pings) for s in found) <= 21
    assert found[-1].first_row + len(found[-1].pings) == 100
    for one, other in pairwise(found):
        assert other.first_row == one.first_row + len(one.pings) - 4

    with pytest.raises(SurveyFileError, match=r"survey, row 4: samples: got 'over 4000 bytes in 5 pings'"):
        list(strips(pings(100, samples=1000), 50, 20, max_bytes=2000))
    for length, overlap in ((0, 0), (10, 10), (10, -1)):
        with pytest.raises(ValueError, match="expected more than the overlap"):
            list(strips(pings(3), length, overlap))


def test_one_long_ping_counts_for_each_ping_of_its_strip():
    mixed = [*pings(30), *pings(1, samples=1000), *pings(30)]
    found = list(strips(mixed, 50, 2, max_bytes=10_000))
    sizes = [len(strip.pings) * max(ping.channels[0].samples.size for ping in strip.pings) for strip in found]
    assert max(sizes) <= 10_000
    assert found[-1].first_row + len(found[-1].pings) == 61
    with pytest.raises(SurveyFileError, match=r"survey, row 30: samples: got 'over 10000 bytes in 21 pings'"):
        list(strips(mixed, 50, 10, max_bytes=5000))


def test_strips_read_stream_lazily():
    read = []

    def stream():
        for ping in pings(1000):
            read.append(ping.number)
            yield ping

    first = next(strips(stream(), 10, 2))
    assert len(first.pings) == 10
    assert len(read) <= 16


def test_load_survey_limits_number_of_samples(small_survey):
    source = InMemorySource(small_survey(), SurveyOptions())
    assert len(load_survey(source, 400).pings) == 5
    with pytest.raises(SurveyFileError, match="samples"):
        load_survey(source, 399)
