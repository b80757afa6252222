"""Inbox of the durable store: duplicates, persistence until handled, limits of a read."""

import pytest
from builders.store_steps import record
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.delivery import received
from sonarpost.delivery.store import Store


def test_record_stays_in_the_inbox_until_handled(store, open_store):
    with store.transaction() as tx:
        tx.accept("k", b"1")
        tx.accept("k", b"2")
    store = open_store()
    first, second = store.inbox_items(9)
    assert (first.payload, second.payload) == (b"1", b"2")
    with store.transaction() as tx:
        tx.remove_handled(first)
    assert store.inbox_items(9) == (second,)
    assert store.inbox_depth() == 1


ARRIVAL = st.tuples(
    st.sampled_from(["k/a", "k/b"]),
    st.sampled_from([b"a" * 16, b"b" * 16]),
    st.integers(1, 30),
    st.sampled_from([b"x", b"y"]),
    st.integers(0, 29),
)


@given(st.lists(ARRIVAL, max_size=80))
def test_record_is_a_duplicate_only_with_the_same_key_origin_number_and_digest(tmp_path_factory, arrivals):
    store = Store(tmp_path_factory.mktemp("seen") / "s.db")
    accepted = set()
    for key, origin, seq, payload, done_up_to in arrivals:
        chunk = record(seq, payload, origin, done_up_to)
        with store.transaction() as tx:
            numbers = {n for k, o, n, _ in accepted if (k, o) == (key, origin)}
            other = (key, origin, seq, b"y" if payload == b"x" else b"x")
            expected = seq if other in accepted else max(numbers, default=0)
            assert tx.accepted_number(key, chunk)[0] == expected
            assert tx.was_received(key, chunk) == ((key, origin, seq, payload) in accepted)
            if not tx.was_received(key, chunk):
                tx.accept(key, payload, chunk)
            assert tx.was_received(key, chunk)
        accepted.add((key, origin, seq, payload))
    assert store.inbox_depth() == len(accepted)
    store.close()


def receive(store, key, *chunks):
    with store.transaction() as tx:
        for chunk in chunks:
            tx.accept(key, chunk.data, chunk)


def digests(store):
    return {int(row[0]) for row in store._query("SELECT seq FROM received")}


def test_statement_of_the_producer_never_marks_a_number_as_received(store):
    receive(store, "k", record(1 << 62, b"valid", done_up_to=(1 << 62) - 1))
    with store.transaction() as tx:
        assert not tx.was_received("k", record(1, b"later record"))


def test_only_old_digests_below_the_statement_are_deleted(store, monkeypatch):
    monkeypatch.setattr(received, "KEPT_DIGESTS", 10)
    monkeypatch.setattr(received, "PRUNE_EVERY", 20)
    receive(store, "k", *(record(seq, b"x") for seq in range(1, 40)))
    assert digests(store) == set(range(1, 40))
    receive(store, "k", record(40, b"x", done_up_to=5))
    assert digests(store) == set(range(6, 41))
    receive(store, "k", *(record(seq, b"x", done_up_to=59) for seq in range(41, 66)))
    assert digests(store) == set(range(56, 66))


def test_number_of_digests_is_limited(store, monkeypatch):
    monkeypatch.setattr(received, "MAX_DIGESTS", 30)
    monkeypatch.setattr(received, "PRUNE_EVERY", 10)
    for first in range(1, 101, 10):
        receive(store, "k", *(record(seq, b"x") for seq in range(first, first + 10)))
        assert len(digests(store)) <= 40
    assert 100 in digests(store)


def test_window_that_is_displaced_in_its_own_transaction_is_written_again(store, monkeypatch):
    """Records of other peers in the transaction are not affected."""
    monkeypatch.setattr(received, "MAX_WINDOWS", 2)
    for number in (1, 2):
        receive(store, "k", record(1, b"x", bytes([number]) * 16))
    with store.transaction() as tx:
        for number in (3, 1):
            chunk = record(2, b"y", bytes([number]) * 16)
            assert not tx.was_received("k", chunk)
            tx.accept("k", chunk.data, chunk)
    with store.transaction() as tx:
        assert tx.was_received("k", record(2, b"y", bytes([1]) * 16))
        assert tx.was_received("k", record(2, b"y", bytes([3]) * 16))


def test_least_recently_used_window_of_a_writer_is_deleted(store, monkeypatch):
    """A console that writes under many names and origins does not displace the window of a vessel."""
    monkeypatch.setattr(received, "MAX_WINDOWS", 3)
    vessel_key = "sonarpost/v1/shore/inbox/vessel-1"
    receive(store, vessel_key, record(1, b"image"))
    for number in range(8):
        key = f"sonarpost/v1/shore/tasking/vessel-{number}/comment"
        receive(store, key, record(1, b"comment", bytes([number]) * 16))
    assert len(store._query("SELECT 1 FROM received_window")) == 4
    assert len(store._query("SELECT 1 FROM received")) == 4
    with store.transaction() as tx:
        assert tx.was_received(vessel_key, record(1, b"image"))
        assert tx.was_received(key, record(1, b"comment", bytes([7]) * 16))
        assert not tx.was_received("sonarpost/v1/shore/tasking/vessel-0/comment", record(1, b"comment", bytes(16)))


@pytest.mark.parametrize(("max_bytes", "count"), [(None, 4), (0, 1), (10, 1), (29, 2), (30, 3), (1000, 4)])
def test_inbox_read_is_limited_in_bytes(store, max_bytes, count):
    with store.transaction() as tx:
        for _ in range(4):
            tx.accept("k", bytes(10))
    assert len(store.inbox_items(9, max_bytes=max_bytes)) == count
    assert len(store.inbox_items(1, max_bytes=max_bytes)) == 1
