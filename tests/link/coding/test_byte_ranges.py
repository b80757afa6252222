"""Byte ranges and partial bytes, compared with sets and maps of positions."""

import re
from itertools import pairwise

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import FrameError
from sonarpost.link.coding.byte_ranges import (
    MAX_PARTIAL_BYTES,
    PartialBytes,
    Ranges,
    add_range,
    count_positions,
    covered_within,
    gaps_within,
)

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


PIECE = st.tuples(st.integers(0, 40), st.binary(min_size=1, max_size=12))


@given(st.lists(PIECE, max_size=12))
def test_partial_bytes_behave_like_a_map_of_positions(pieces: list[tuple[int, bytes]]) -> None:
    partial = PartialBytes()
    truth: dict[int, int] = {}
    for start, piece in pieces:
        new = dict(enumerate(piece, start))
        is_new, conflict = partial.write(start, piece)
        assert is_new == bool(new.keys() - truth.keys())
        assert conflict == any(truth[i] != new[i] for i in new.keys() & truth.keys())
        truth = new | truth
        assert {i: partial.data[i] for i in positions(partial.received)} == truth
        assert partial.received_bytes == len(truth)
        assert positions(((0, partial.prefix_bytes),)) <= truth.keys()
        assert partial.prefix_bytes not in truth
    copy = PartialBytes.unpack(partial.pack())
    assert (copy.data, copy.received) == (partial.data, partial.received)


@pytest.mark.parametrize(
    ("packed", "expected"),
    [
        (b"", "msgpack"),
        (b"\xc1", "msgpack"),
        (msgpack.packb(5), "expected a list"),
        (msgpack.packb([4]), "pieces: got 'nothing'"),
        (msgpack.packb([-1, []]), "length: got -1, expected 0..65535"),
        (msgpack.packb([MAX_PARTIAL_BYTES + 1, []]), "length: got 65536, expected 0..65535"),
        (msgpack.packb([4, [[3, b"ab"]]]), "expected bytes within 4"),
        (msgpack.packb([4, [[-1, b"ab"]]]), "pieces[0][0]: got -1, expected 0..65535"),
        (msgpack.packb([4, [[0, b""]]]), "expected bytes within 4"),
    ],
)
def test_malformed_partial_bytes_are_refused(packed: bytes, expected: str) -> None:
    with pytest.raises(FrameError, match=re.escape(expected)):
        PartialBytes.unpack(packed)
