"""The durable store's outbox: numbers without gaps, the most urgent first, what was refused kept, listeners told."""

from __future__ import annotations

import hashlib
import threading
from pathlib import Path

import pytest
from builders.store_steps import fail_within, send
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import OutboxItem


def test_what_is_owed_is_as_it_was_given(store: Store) -> None:
    assert send(store, b"payload") == [1]
    assert store.owed("c", 9) == (OutboxItem("c", 1, "k", "e", 4, b"payload", hashlib.sha256(b"payload").digest()),)
    assert store.owed("other", 9) == ()


def test_numbers_run_without_gaps_a_consumer_and_are_never_used_again(tmp_path: Path) -> None:
    store = Store(tmp_path / "s.db")
    assert send(store, b"1", b"2") == [1, 2]
    assert send(store, b"1", consumer="d") == [1]
    with store.transaction() as tx:
        tx.acknowledged("c", 1)
        tx.acknowledged("c", 2)
    origin = store.origin
    store.close()
    store = Store(tmp_path / "s.db")
    assert send(store, b"3") == [3]
    assert store.origin == origin
    store.close()


def test_a_transaction_that_failed_uses_no_number(store: Store) -> None:
    with pytest.raises(ZeroDivisionError):
        fail_within(store, lambda tx: tx.send("k", "c", b"lost", encoding="e"))
    assert send(store, b"1") == [1]
    assert [item.payload for item in store.owed("c", 9)] == [b"1"]


@given(st.lists(st.integers(1, 7), max_size=12))
@settings(max_examples=20)
def test_the_most_urgent_is_owed_first_then_the_oldest(
    tmp_path_factory: pytest.TempPathFactory, priorities: list[int]
) -> None:
    store = Store(tmp_path_factory.mktemp("order") / "s.db")
    for priority in priorities:
        send(store, b"x", priority=priority)
    owed = [(item.priority, item.seq) for item in store.owed("c", 99)]
    assert owed == sorted(owed)
    assert len(owed) == len(priorities)
    assert store.owed("c", 3) == store.owed("c", 99)[:3]
    store.close()


def test_two_stores_have_two_origins(tmp_path: Path) -> None:
    a, b = Store(tmp_path / "a.db"), Store(tmp_path / "b.db")
    assert a.origin != b.origin
    assert len(a.origin) == len(b.origin) == 16
    a.close()
    b.close()


def test_what_was_refused_is_kept_with_its_reason(store: Store) -> None:
    send(store, b"bad")
    with store.transaction() as tx:
        tx.rejected(store.owed("c", 1)[0], "no such record")
    assert (store.outbox_depth(), store.refused_count()) == (0, 1)
    assert store._query("SELECT direction, key, payload, reason FROM refused") == [
        ("out", "k", b"bad", "no such record")
    ]


def test_of_what_was_refused_the_latest_are_kept_and_the_beginning_of_each(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sonarpost.delivery.transaction.REFUSED_KEPT", 5)
    monkeypatch.setattr("sonarpost.delivery.transaction.REFUSED_BYTES", 3)
    for number in range(12):
        with store.transaction() as tx:
            tx.quarantine("in", "k", b"%02d and more" % number, "no")
    assert store.refused_count() == 5
    kept = [payload for (payload,) in store._query("SELECT payload FROM refused ORDER BY id")]
    assert kept == [b"%02d " % number for number in range(7, 12)]


def test_listeners_hear_of_commits_and_not_of_failures(store: Store) -> None:
    event = threading.Event()
    store.listen_outbox(event)
    with pytest.raises(ZeroDivisionError):
        fail_within(store, lambda tx: (tx.send("k", "c", b"x", encoding="e"), tx.accept("k", b"x")))
    assert not event.is_set()
    assert not store.inbox_changed.is_set()
    send(store, b"x")
    assert event.is_set()
    assert not store.inbox_changed.is_set()
    event.clear()
    store.unlisten_outbox(event)
    with store.transaction() as tx:
        tx.send("k", "c", b"x", encoding="e")
        tx.accept("k", b"x")
    assert not event.is_set()
    assert store.inbox_changed.is_set()
