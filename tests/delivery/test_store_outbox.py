"""Outbox of the durable store: consecutive numbers, priority order, quarantine, notification."""

import hashlib

import pytest
from builders.store_steps import fail_within, queued_items, send
from hypothesis import given
from hypothesis import strategies as st

from sonarpost import keys
from sonarpost.delivery.records import OutboxItem
from sonarpost.delivery.store import Store


def test_queued_record_is_unchanged(store):
    assert send(store, b"payload") == [1]
    assert queued_items(store, "c", 9) == (
        OutboxItem("c", 1, "k", "e", 4, b"payload", hashlib.sha256(b"payload").digest()),
    )
    assert queued_items(store, "other", 9) == ()


def test_numbers_are_consecutive_in_a_queue_and_never_reused(store, open_store):
    assert send(store, b"1", b"2") == [1, 2]
    assert send(store, b"1", consumer="d") == [1]
    with store.transaction() as tx:
        tx.remove_acknowledged("c", (1,))
        tx.remove_acknowledged("c", (2,))
    origin = store.origin
    store = open_store()
    assert send(store, b"3") == [3]
    assert store.origin == origin


@given(st.lists(st.integers(1, 7), max_size=12))
def test_queue_order_is_priority_then_age(tmp_path_factory, priorities):
    store = Store(tmp_path_factory.mktemp("order") / "s.db")
    for priority in priorities:
        send(store, b"x", priority=priority)
    order = [(item.priority, item.seq) for item in queued_items(store, "c", 99)]
    assert order == sorted(order)
    assert len(order) == len(priorities)
    assert queued_items(store, "c", 3) == queued_items(store, "c", 99)[:3]
    store.close()


def test_refused_record_is_quarantined_whole_with_its_reason(store, monkeypatch):
    monkeypatch.setattr("sonarpost.delivery.transaction.MAX_QUARANTINED_BYTES", 2)
    send(store, b"bad")
    with store.transaction() as tx:
        tx.quarantine_refused(queued_items(store, "c", 1)[0], "no such record")
    assert (store.outbox_depth(), store.refused_count()) == (0, 1)
    assert store._query("SELECT direction, key, payload, reason FROM refused") == [
        ("out", "k", b"bad", "no such record")
    ]


def test_quarantine_keeps_the_latest_records_truncated(store, monkeypatch):
    monkeypatch.setattr("sonarpost.delivery.transaction.MAX_QUARANTINED", 5)
    monkeypatch.setattr("sonarpost.delivery.transaction.MAX_QUARANTINED_BYTES", 3)
    for number in range(12):
        with store.transaction() as tx:
            tx.quarantine("in", "k", b"%02d and more" % number, "no")
    assert store.refused_count() == 5
    kept = [payload for (payload,) in store._query("SELECT payload FROM refused ORDER BY id")]
    assert kept == [b"%02d " % number for number in range(7, 12)]


def test_records_of_one_sender_displace_none_of_another_from_the_quarantine(store, monkeypatch):
    monkeypatch.setattr("sonarpost.delivery.transaction.MAX_QUARANTINED", 5)
    monkeypatch.setattr("sonarpost.delivery.transaction.MAX_QUARANTINE_BYTES", 1000)
    with store.transaction() as tx:
        tx.quarantine("in", keys.shore_part("vessel-1"), b"of vessel-1", "no", is_accepted=True)
        for number in range(20):
            tx.quarantine("in", keys.shore_part("vessel-2"), bytes(number), "no")
        tx.quarantine("in", keys.shore_part("vessel-2"), bytes(990), "no")
    kept = store._query("SELECT key, LENGTH(payload) FROM refused ORDER BY id")
    assert [(keys.part_vessel(key), size) for key, size in kept] == [("vessel-1", 11)]
    with store.transaction() as tx:
        for number in range(20):
            tx.quarantine("in", keys.shore_part("vessel-2"), bytes(number), "no")
    kept = store._query("SELECT key, LENGTH(payload) FROM refused ORDER BY id")
    assert [(keys.part_vessel(key), size) for key, size in kept] == [
        ("vessel-1", 11),
        *(("vessel-2", size) for size in range(16, 20)),
    ]


def test_notification_of_commits_only(store):
    places = []
    store.on_queued = lambda queue, place: places.append((queue, place))
    with pytest.raises(ZeroDivisionError):
        fail_within(store, lambda tx: (tx.send("k", "c", b"x", encoding="e"), tx.accept("k", b"x")))
    assert not places
    assert not store.inbox_changed.is_set()
    send(store, b"x")
    assert places == [("c", (4, 1))]
    assert not store.inbox_changed.is_set()
    with store.transaction() as tx:
        tx.send("k", "other", b"x", encoding="e")
        tx.accept("k", b"x")
    assert places == [("c", (4, 1)), ("other", (4, 1))]
    assert store.inbox_changed.is_set()
