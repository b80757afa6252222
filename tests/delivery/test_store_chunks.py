"""Chunks of large records in the durable store: any order, repeated, lost, damaged, too many."""

from __future__ import annotations

import hashlib
import itertools
import random

import pytest
from builders.store_steps import ORIGIN
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarpost.delivery.records import ReceivedChunk
from sonarpost.delivery.store import Store


def chunks(data: bytes, *cuts: int, seq: int = 1) -> list[ReceivedChunk]:
    sha = hashlib.sha256(data).digest()
    edges = [0, *cuts, len(data)]
    return [ReceivedChunk(ORIGIN, seq, len(data), sha, a, data[a:b]) for a, b in itertools.pairwise(edges)]


def add(store: Store, chunk: ReceivedChunk) -> bytes | int:
    with store.transaction() as tx:
        return tx.add_chunk(chunk)


def partials(store: Store) -> int:
    return len(store._query("SELECT 1 FROM partial"))


@given(data=st.binary(min_size=1, max_size=60), seed=st.integers(0, 2**32))
@settings(max_examples=30)
def test_chunks_in_any_order_and_number_complete_the_record(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, seed: int
) -> None:
    """Behave like a producer: repeat or lose chunks, continue at the requested offset."""
    folder, chance = tmp_path_factory.mktemp("chunks"), random.Random(seed)
    store = Store(folder / "s.db")
    sha = hashlib.sha256(data).digest()
    offset: bytes | int = 0
    for _ in range(1000):
        assert isinstance(offset, int)
        if chance.random() < 0.2:
            store.close()
            store = Store(folder / "s.db")
        start = offset if chance.random() < 0.6 else chance.randrange(len(data))
        offset = add(
            store, ReceivedChunk(ORIGIN, 1, len(data), sha, start, data[start : start + chance.randint(1, 20)])
        )
        if isinstance(offset, bytes):
            break
    assert offset == data
    assert partials(store) == 0
    store.close()


def test_chunk_out_of_order_returns_the_required_offset(store: Store) -> None:
    first, second, third = chunks(b"0123456789", 4, 8)
    assert add(store, second) == 0
    assert add(store, first) == 4
    assert add(store, first) == 4
    assert add(store, third) == 4
    assert add(store, second) == 8
    assert add(store, third) == b"0123456789"


def test_chunks_of_two_records_do_not_mix(store: Store) -> None:
    a, b = chunks(b"aaaa", 2), chunks(b"bbbb", 2, seq=2)
    assert add(store, a[0]) == add(store, b[0]) == 2
    assert (add(store, a[1]), add(store, b[1])) == (b"aaaa", b"bbbb")


def test_other_record_with_the_same_number_restarts_the_transfer(store: Store) -> None:
    add(store, chunks(b"old record", 5)[0])
    new = chunks(b"new record", 5)
    assert add(store, new[1]) == 0
    assert add(store, new[0]) == 5
    assert add(store, new[1]) == b"new record"


def test_damaged_record_restarts_the_transfer(store: Store) -> None:
    first, second = chunks(b"0123456789", 5)
    bad = ReceivedChunk(ORIGIN, 1, first.size, first.sha256, 0, b"0x234")
    assert add(store, bad) == 5
    assert add(store, second) == 0
    assert partials(store) == 0
    assert add(store, first) == 5
    assert add(store, second) == b"0123456789"


def test_accepting_a_record_deletes_its_chunks(store: Store) -> None:
    add(store, chunks(b"0123456789", 5)[0])
    with store.transaction() as tx:
        tx.accept("k", b"0123456789", ORIGIN, 1)
    assert partials(store) == 0


def test_only_the_most_recent_partial_records_are_kept(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sonarpost.delivery.transaction.MAX_PARTIAL_RECORDS", 3)
    firsts = {seq: chunks(b"0123456789", 4, seq=seq) for seq in range(1, 5)}
    for seq in (1, 2, 3):
        assert add(store, firsts[seq][0]) == 4
    assert add(store, firsts[1][0]) == 4  # touched again
    assert add(store, firsts[4][0]) == 4
    assert partials(store) == 3
    # The second record was deleted; its producer starts again at offset 0.
    assert add(store, firsts[2][1]) == 0
    assert add(store, firsts[1][1]) == b"0123456789"
