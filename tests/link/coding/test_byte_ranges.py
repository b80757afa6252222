"""Byte ranges, compared with sets of positions."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from sonarpost.link.coding.byte_ranges import Ranges, add_range, count_positions, covered_within, gaps_within

SPAN = st.tuples(st.integers(0, 40), st.integers(0, 40)).map(lambda p: (min(p), max(p)))


def positions(ranges: Ranges) -> set[int]:
    return {i for start, stop in ranges for i in range(start, stop)}


@given(st.lists(SPAN, max_size=12), SPAN)
def test_ranges_behave_like_sets_of_positions(spans: list[tuple[int, int]], window: tuple[int, int]) -> None:
    ranges: Ranges = ()
    truth: set[int] = set()
    for start, stop in spans:
        ranges = add_range(ranges, start, stop)
        truth |= set(range(start, stop))
        assert positions(ranges) == truth
        assert count_positions(ranges) == len(truth)
        assert all(a < b for a, b in ranges)
        assert all(first[1] < second[0] for first, second in pairwise(ranges))
    inside = set(range(*window))
    assert positions(covered_within(ranges, *window)) == truth & inside
    assert positions(gaps_within(ranges, *window)) == inside - truth
