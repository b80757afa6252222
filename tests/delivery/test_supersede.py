"""Editions, quotas and queues in a store: what is dropped, what stays, and what a consumer makes of the gaps."""

from __future__ import annotations

import hashlib
import sqlite3
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarpost.delivery.protocol import attachment, parse_chunk
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import OutboxItem, Topic, consumer_of, queue_of
from sonarpost.errors import PayloadError


def send(store: Store, topic: str, edition: int, *, priority: int = 6, queue: str = "c2", size: int = 3) -> int:
    with store.transaction() as tx:
        payload = f"{topic}{edition}".encode().ljust(size, b".")
        return tx.send("k", queue, payload, encoding="", priority=priority, topic=Topic(topic, edition))


def owed(store: Store, queue: str = "c2") -> list[str]:
    return [item.payload.decode().rstrip(".") for item in store.owed(queue, 99)]


def test_a_newer_edition_takes_the_place_and_the_priority_of_older_ones(store: Store) -> None:
    send(store, "a", 1, priority=5)
    send(store, "b", 1, priority=5)
    send(store, "c", 1, priority=6)
    assert send(store, "a", 2, priority=6) == 4
    assert owed(store) == ["a2", "b1", "c1"]
    assert [item.priority for item in store.owed("c2", 9)] == [5, 5, 6]


def test_an_edition_on_its_way_stays_and_the_newest_always_does(store: Store) -> None:
    send(store, "a", 1)
    assert store.begin("c2", 1)
    send(store, "a", 2)
    send(store, "a", 3)
    assert owed(store) == ["a1", "a3"]
    store.end("c2", 1)
    assert not store.begin("c2", 2), "it has been replaced, and must not be sent any more"


def test_an_older_edition_that_comes_late_is_not_queued(store: Store) -> None:
    send(store, "a", 3)
    assert send(store, "a", 2) == 0
    assert owed(store) == ["a3"]


def test_queues_and_topics_know_nothing_of_each_other(store: Store) -> None:
    send(store, "a", 1)
    send(store, "a", 2, queue="c2@shore-2")
    send(store, "b", 5)
    assert (owed(store), owed(store, "c2@shore-2")) == (["a1", "b5"], ["a2"])
    assert consumer_of(queue_of("c2", "shore-2")) == consumer_of("c2") == "c2"


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(1, 6), st.booleans()), max_size=25))
@settings(max_examples=40)
def test_whatever_comes_in_whatever_order_the_newest_edition_is_sent(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, int, bool]]
) -> None:
    store = Store(tmp_path_factory.mktemp("editions") / "s.db")
    newest: dict[str, int] = {}
    sent: dict[str, set[int]] = {}
    for topic, edition, take_one in steps:
        send(store, topic, edition)
        newest[topic] = max(newest.get(topic, 0), edition)
        if take_one:
            for item in store.owed("c2", 1):
                assert store.begin("c2", item.seq)
                name = item.payload.decode().rstrip(".")
                sent.setdefault(name[0], set()).add(int(name[1:]))
                with store.transaction() as tx:
                    tx.acknowledged("c2", item.seq)
                store.end("c2", item.seq)
    for name in owed(store):
        sent.setdefault(name[0], set()).add(int(name[1:]))
    assert {topic: max(editions) for topic, editions in sent.items()} == newest
    store.close()


def test_a_quota_drops_the_least_urgent_first_then_the_oldest_and_never_what_is_urgent(store: Store) -> None:
    for seq, (topic, priority) in enumerate([("a", 5), ("b", 6), ("c", 6), ("d", 2), ("e", 5)], 1):
        assert send(store, topic, 1, priority=priority, size=100) == seq
    with store.transaction() as tx:
        assert tx.drop_oldest("c2", 350, 2) == 2
    assert owed(store) == ["d1", "a1", "e1"]
    with store.transaction() as tx:
        assert tx.drop_oldest("c2", 0, 2) == 2
    assert owed(store) == ["d1"]


def test_a_quota_leaves_what_is_on_its_way(store: Store) -> None:
    send(store, "a", 1, size=100)
    send(store, "b", 1, size=100)
    assert store.begin("c2", 1)
    with store.transaction() as tx:
        assert tx.drop_oldest("c2", 0, 2) == 1
    assert owed(store) == ["a1"]


def test_the_depth_of_a_queue(store: Store) -> None:
    assert store.queue_depth("c2").oldest_utc_s is None
    send(store, "a", 1, size=70)
    send(store, "b", 1, size=30)
    depth = store.queue_depth("c2")
    assert (depth.records, depth.size_bytes) == (2, 100)
    assert depth.oldest_utc_s is not None


def test_every_queue_has_an_origin_of_its_own(store: Store) -> None:
    """A site that is renamed has a queue whose numbers begin anew, and the same consumer behind it."""
    origins = {store.origin_of(queue) for queue in ("c2", "c2@a", "c2@b")}
    assert len(origins) == 3
    assert store.origin_of("c2") == store.origin
    assert {len(origin) for origin in origins} == {16}


def test_what_a_producer_is_done_with_needs_no_memory(tmp_path: Path, store: Store) -> None:
    for edition in range(1, 8):
        send(store, "a", edition)
    assert store.settled_upto("c2") == 6
    consumer = Store(tmp_path / "consumer.db")
    with consumer.transaction() as tx:
        tx.mark_refused(b"o" * 16, 3)
        tx.settle_upto(b"o" * 16, 6)
        assert tx.accept("k", b"x", b"o" * 16, 7)
        assert not tx.accept("k", b"x", b"o" * 16, 5)
        tx.settle_upto(b"o" * 16, 2)
        assert tx.was_seen(b"o" * 16, 7)
    assert consumer._query("SELECT COUNT(*) FROM seen") == [(0,)]
    assert consumer._query("SELECT COUNT(*) FROM refused_before") == [(0,)]
    consumer.close()
    with store.transaction() as tx:
        tx.acknowledged("c2", 7)
    assert store.settled_upto("c2") == 7


@pytest.mark.parametrize("statement", [1, 2])
def test_a_record_that_is_queued_meanwhile_is_not_told_to_be_done_with(store: Store, statement: int) -> None:
    statements = 0

    def queue_meanwhile(_: str) -> None:
        nonlocal statements
        statements += 1
        if statements == statement:
            send(store, "a", 1)

    store._reader.set_trace_callback(queue_meanwhile)
    settled = store.settled_upto("c2")
    store._reader.set_trace_callback(None)
    assert all(settled < item.seq for item in store.owed("c2", 9))


def test_a_producer_cannot_settle_what_it_asks_for() -> None:
    item = OutboxItem("c2", 5, "k", "", 4, b"data", hashlib.sha256(b"data").digest())
    assert parse_chunk(attachment(b"o" * 16, item, settled=4), b"data", "k").settled == 4
    with pytest.raises(PayloadError, match="settled: got 5, expected a number below seq"):
        parse_chunk(attachment(b"o" * 16, item, settled=5), b"data", "k")


def test_a_store_of_version_1_goes_on_where_it_was(tmp_path: Path) -> None:
    path = tmp_path / "s.db"
    old = sqlite3.connect(path)
    old.executescript(
        """
        CREATE TABLE meta (name TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID;
        CREATE TABLE outbox (
            consumer TEXT NOT NULL, seq INTEGER NOT NULL, key TEXT NOT NULL, encoding TEXT NOT NULL,
            priority INTEGER NOT NULL, payload BLOB NOT NULL, sha256 BLOB NOT NULL, created_utc_s REAL NOT NULL,
            PRIMARY KEY (consumer, seq));
        CREATE INDEX outbox_order ON outbox (consumer, priority, seq);
        CREATE TABLE outbox_next (consumer TEXT PRIMARY KEY, seq INTEGER NOT NULL) WITHOUT ROWID;
        INSERT INTO outbox_next VALUES ('c2', 3);
        """
    )
    old.execute("INSERT INTO meta VALUES ('origin', ?), ('version', ?)", (b"o" * 16, b"1"))
    for seq in (1, 2, 3):
        row = ("c2", seq, "k", "e", 6, f"p{seq}".encode(), bytes(32), 1.0)
        old.execute("INSERT INTO outbox VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)
    old.commit()
    old.close()
    for _ in range(2):
        store = Store(path)
        assert store.origin == b"o" * 16
        assert owed(store)[:3] == ["p1", "p2", "p3"]
        store.close()
    store = Store(path)
    assert send(store, "a", 1) == 4
    assert owed(store) == ["p1", "p2", "p3", "a1"]
    store.close()
