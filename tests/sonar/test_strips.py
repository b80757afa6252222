"""A stream of pings in strips: every ping once as a new one, strips that overlap, memory that is bounded."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.source import strips
from sonarpost.sonar.survey import ChannelPing, Ping, Side


def pings(count, samples=4):
    return [Ping(n, float(n), (ChannelPing(Side.PORT, np.zeros(samples, dtype=np.uint8), 10.0),)) for n in range(count)]


@pytest.mark.parametrize("count", [1, 9, 10, 11, 14, 15, 16, 17, 30, 100, 101, 107])
@pytest.mark.parametrize("overlap", [0, 1, 4, 9])
def test_strips_cover_the_stream_and_overlap(count, overlap):
    found = list(strips(pings(count), 10, overlap))
    assert [s.is_last for s in found] == [False] * (len(found) - 1) + [True]
    for strip in found:
        assert [p.number for p in strip.pings] == list(range(strip.first_row, strip.first_row + len(strip.pings)))
        assert len(strip.pings) <= 15
    for one, other in pairwise(found):
        assert other.first_row == one.first_row + len(one.pings) - overlap
        assert len(one.pings) == 10
    assert found[-1].first_row + len(found[-1].pings) == count
    # A short rest goes with the strip before it, so that no strip is mostly overlap.
    assert len(found) == 1 or len(found[-1].pings) > overlap


def test_an_empty_stream_has_no_strips():
    assert list(strips([], 10, 2)) == []


def test_long_pings_make_short_strips():
    found = list(strips(pings(100, samples=1000), 50, 4, max_bytes=20_000))
    assert max(len(s.pings) for s in found) <= 21
    assert found[-1].first_row + len(found[-1].pings) == 100
    for one, other in pairwise(found):
        assert other.first_row == one.first_row + len(one.pings) - 4


def test_pings_too_long_for_any_strip_are_an_error_that_says_where():
    with pytest.raises(SurveyFileError, match=r"survey, row 4: samples: got 'over 4000 bytes in 5 pings'"):
        list(strips(pings(100, samples=1000), 50, 20, max_bytes=2000))


@pytest.mark.parametrize(("length", "overlap"), [(0, 0), (10, 10), (10, -1)])
def test_lengths_that_cannot_be_are_refused(length, overlap):
    with pytest.raises(ValueError, match="expected more than the overlap"):
        list(strips(pings(3), length, overlap))


def test_it_reads_no_farther_than_it_must():
    read = []

    def stream():
        for ping in pings(1000):
            read.append(ping.number)
            yield ping

    first = next(strips(stream(), 10, 2))
    assert len(first.pings) == 10
    assert len(read) <= 16
