"""Inbox of the durable store: deduplication, persistence until handled, limits of a read."""

from __future__ import annotations

from pathlib import Path

import pytest
from builders.store_steps import ORIGIN
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarpost.delivery.store import Store


def test_record_stays_in_the_inbox_until_handled(tmp_path: Path) -> None:
    store = Store(tmp_path / "s.db")
    with store.transaction() as tx:
        assert tx.accept("k", b"1")
        assert tx.accept("k", b"2")
    store.close()
    store = Store(tmp_path / "s.db")
    first, second = store.inbox_items(9)
    assert (first.payload, second.payload) == (b"1", b"2")
    with store.transaction() as tx:
        tx.remove_handled(first)
    assert store.inbox_items(9) == (second,)
    assert store.inbox_depth() == 1
    store.close()


@given(st.lists(st.tuples(st.sampled_from([b"a" * 16, b"b" * 16]), st.integers(1, 30)), max_size=80))
@settings(max_examples=30)
def test_each_sequence_number_is_accepted_once_in_any_order(
    tmp_path_factory: pytest.TempPathFactory, arrivals: list[tuple[bytes, int]]
) -> None:
    store = Store(tmp_path_factory.mktemp("seen") / "s.db")
    accepted = set()
    for origin, seq in arrivals:
        with store.transaction() as tx:
            assert tx.was_received(origin, seq) == ((origin, seq) in accepted)
            assert tx.accept("k", b"x", origin, seq) == ((origin, seq) not in accepted)
        accepted.add((origin, seq))
    assert store.inbox_depth() == len(accepted)
    # Only numbers above the first gap are stored individually.
    kept = {(bytes(o), s) for o, s in store._query("SELECT origin, seq FROM seen")}  # type: ignore[arg-type]
    above_gap = set()
    for origin in (b"a" * 16, b"b" * 16):
        numbers = {seq for o, seq in accepted if o == origin}
        upto = 0
        while upto + 1 in numbers:
            upto += 1
        above_gap |= {(origin, seq) for seq in numbers if seq > upto}
    assert kept == above_gap
    store.close()


def test_refused_record_is_never_accepted(store: Store) -> None:
    with store.transaction() as tx:
        assert not tx.was_refused(ORIGIN, 1)
        tx.mark_refused(ORIGIN, 1)
        tx.mark_refused(ORIGIN, 1)
        assert tx.was_refused(ORIGIN, 1)
        assert not tx.accept("k", b"x", ORIGIN, 1)
    assert store.inbox_depth() == 0


@pytest.mark.parametrize(("max_bytes", "count"), [(None, 4), (0, 1), (10, 1), (29, 2), (30, 3), (1000, 4)])
def test_inbox_read_is_limited_in_bytes(store: Store, max_bytes: int | None, count: int) -> None:
    with store.transaction() as tx:
        for _ in range(4):
            tx.accept("k", bytes(10))
    assert len(store.inbox_items(9, max_bytes=max_bytes)) == count
    assert len(store.inbox_items(1, max_bytes=max_bytes)) == 1
