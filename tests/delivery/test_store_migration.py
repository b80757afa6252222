"""Stores of version 2: origins of queued records, numbers that were received."""

import hashlib
import sqlite3
from contextlib import closing

import pytest
from builders.store_steps import queued_items, record, send

STORE_ORIGIN = b"o" * 16
PRODUCER = b"p" * 16
POISONED = b"q" * 16
VERSION_2 = """
CREATE TABLE meta (name TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID;
CREATE TABLE outbox (
    consumer TEXT NOT NULL, seq INTEGER NOT NULL, key TEXT NOT NULL, encoding TEXT NOT NULL, priority INTEGER NOT NULL,
    payload BLOB NOT NULL, sha256 BLOB NOT NULL, created_utc_s REAL NOT NULL,
    topic TEXT NOT NULL DEFAULT '', edition INTEGER NOT NULL DEFAULT 0, place INTEGER NOT NULL DEFAULT 0,
    PRIMARY KEY (consumer, seq));
CREATE TABLE outbox_next (consumer TEXT PRIMARY KEY, seq INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE inbox (
    id INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT NOT NULL, payload BLOB NOT NULL, origin BLOB, seq INTEGER,
    received_utc_s REAL NOT NULL);
CREATE TABLE seen (origin BLOB NOT NULL, seq INTEGER NOT NULL, PRIMARY KEY (origin, seq)) WITHOUT ROWID;
CREATE TABLE seen_upto (origin BLOB PRIMARY KEY, seq INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE refused_before (
    origin BLOB NOT NULL, seq INTEGER NOT NULL, PRIMARY KEY (origin, seq)) WITHOUT ROWID;
CREATE TABLE partial (
    id INTEGER PRIMARY KEY AUTOINCREMENT, origin BLOB NOT NULL, seq INTEGER NOT NULL, size INTEGER NOT NULL,
    sha256 BLOB NOT NULL, has INTEGER NOT NULL, touched_ns INTEGER NOT NULL, UNIQUE (origin, seq));
CREATE TABLE partial_piece (
    partial INTEGER NOT NULL REFERENCES partial (id) ON DELETE CASCADE, start INTEGER NOT NULL, data BLOB NOT NULL,
    PRIMARY KEY (partial, start));
INSERT INTO outbox_next VALUES ('c2', 7), ('c2@north', 3), ('empty', 5);
"""


VERSION_1 = """
CREATE TABLE meta (name TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID;
CREATE TABLE outbox (
    consumer TEXT NOT NULL, seq INTEGER NOT NULL, key TEXT NOT NULL, encoding TEXT NOT NULL, priority INTEGER NOT NULL,
    payload BLOB NOT NULL, sha256 BLOB NOT NULL, created_utc_s REAL NOT NULL, PRIMARY KEY (consumer, seq));
CREATE INDEX outbox_order ON outbox (consumer, priority, seq);
CREATE TABLE outbox_next (consumer TEXT PRIMARY KEY, seq INTEGER NOT NULL) WITHOUT ROWID;
INSERT INTO outbox_next VALUES ('c2', 3);
"""


def make(path, version, tables, queued, *more):
    """Write a store of an earlier version with queued records, which are (queue, seq)."""
    with closing(sqlite3.connect(path)) as old, old:
        old.executescript(tables)
        old.execute("INSERT INTO meta VALUES ('origin', ?), ('version', ?)", (STORE_ORIGIN, version))
        for queue, seq in queued:
            row = (queue, seq, "k", "e", 4, b"payload", hashlib.sha256(b"payload").digest(), 1.0)
            columns = "consumer, seq, key, encoding, priority, payload, sha256, created_utc_s"
            old.execute(f"INSERT INTO outbox ({columns}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)
        for statement, values in more:
            old.execute(statement, values)


def test_store_of_version_1_is_migrated(open_store, tmp_path):
    make(tmp_path / "s.db", b"1", VERSION_1, [("c2", 1), ("c2", 2), ("c2", 3)])
    for _ in range(2):
        store = open_store()
        assert store.origin == STORE_ORIGIN
    assert send(store, b"new", consumer="c2") == [4]
    items = queued_items(store, "c2", 9)
    assert [item.payload for item in items] == [b"payload"] * 3 + [b"new"]
    assert [item.origin for item in items[:3]] == [STORE_ORIGIN] * 3
    assert items[3].origin not in (STORE_ORIGIN, b"")


@pytest.fixture
def store(open_store, tmp_path):
    """A store of version 2, opened for the second time."""
    make(
        tmp_path / "s.db",
        b"2",
        VERSION_2,
        [("c2", 6), ("c2", 7), ("c2@north", 3)],
        ("UPDATE outbox SET place = seq", ()),
        ("INSERT INTO seen_upto VALUES (?, 10), (?, ?)", (PRODUCER, POISONED, (1 << 62) - 1)),
        ("INSERT INTO seen VALUES (?, 12), (?, ?)", (PRODUCER, POISONED, 1 << 62)),
        ("INSERT INTO inbox (key, payload, received_utc_s) VALUES ('k', x'01', 1.0)", ()),
    )
    open_store()
    return open_store()


def test_queued_records_keep_their_origin_and_new_ones_get_another(store):
    for queue in ("c2", "c2@north", "empty"):
        send(store, b"new", consumer=queue)
    default, north, empty = (queued_items(store, queue, 9) for queue in ("c2", "c2@north", "empty"))
    assert [item.seq for item in (*default, *north, *empty)] == [6, 7, 8, 3, 4, 6]
    assert {item.origin for item in default[:2]} == {STORE_ORIGIN}
    assert north[0].origin == hashlib.sha256(STORE_ORIGIN + b"c2@north").digest()[:16]
    new_origins = {default[2].origin, north[1].origin, empty[0].origin}
    assert len(new_origins) == 3
    assert not new_origins & {STORE_ORIGIN, north[0].origin, b""}
    assert store.inbox_depth() == 1


def test_numbers_received_by_version_2_are_not_accepted_again(store):
    with store.transaction() as tx:
        received = [seq for seq in range(1, 15) if tx.was_received("k", record(seq, b"x", PRODUCER))]
        assert received == [*range(1, 11), 12]
        assert not tx.was_received("k", record(5, b"x", b"r" * 16))
        # Numbers that no producer assigned are discarded.
        assert not tx.was_received("k", record(5, b"x", POISONED))
