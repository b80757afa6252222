"""Tables of a store, and the conversion of stores that earlier versions have written."""

from __future__ import annotations

import hashlib
import logging
import sqlite3
import uuid

from sonarpost.delivery.records import SITE_SEPARATOR
from sonarpost.logs import kv

log = logging.getLogger(__name__)

VERSION = 3

_TABLES = """
CREATE TABLE IF NOT EXISTS meta (name TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS outbox (
    consumer TEXT NOT NULL, seq INTEGER NOT NULL, key TEXT NOT NULL, encoding TEXT NOT NULL, priority INTEGER NOT NULL,
    payload BLOB NOT NULL, sha256 BLOB NOT NULL, created_utc_s REAL NOT NULL,
    topic TEXT NOT NULL DEFAULT '', edition INTEGER NOT NULL DEFAULT 0, place INTEGER NOT NULL DEFAULT 0,
    origin BLOB NOT NULL DEFAULT x'', PRIMARY KEY (consumer, seq));
CREATE TABLE IF NOT EXISTS outbox_next (
    consumer TEXT PRIMARY KEY, seq INTEGER NOT NULL, origin BLOB NOT NULL DEFAULT x'') WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS inbox (
    id INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT NOT NULL, payload BLOB NOT NULL, origin BLOB, seq INTEGER,
    received_utc_s REAL NOT NULL);
CREATE TABLE IF NOT EXISTS received_window (
    id INTEGER PRIMARY KEY, key TEXT NOT NULL, origin BLOB NOT NULL, writer TEXT NOT NULL, highest INTEGER NOT NULL,
    sha256 BLOB NOT NULL, digests INTEGER NOT NULL, used_ns INTEGER NOT NULL, UNIQUE (key, origin));
CREATE TABLE IF NOT EXISTS received (
    window INTEGER NOT NULL REFERENCES received_window (id) ON DELETE CASCADE, seq INTEGER NOT NULL,
    sha256 BLOB NOT NULL, PRIMARY KEY (window, seq, sha256)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS partial (
    id INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT NOT NULL, origin BLOB NOT NULL, seq INTEGER NOT NULL,
    sha256 BLOB NOT NULL, writer TEXT NOT NULL, has INTEGER NOT NULL, touched_ns INTEGER NOT NULL,
    UNIQUE (key, origin, seq, sha256));
CREATE TABLE IF NOT EXISTS partial_piece (
    partial INTEGER NOT NULL REFERENCES partial (id) ON DELETE CASCADE, start INTEGER NOT NULL, data BLOB NOT NULL,
    PRIMARY KEY (partial, start));
CREATE TABLE IF NOT EXISTS refused (
    id INTEGER PRIMARY KEY AUTOINCREMENT, direction TEXT NOT NULL, key TEXT NOT NULL, payload BLOB NOT NULL,
    reason TEXT NOT NULL, at_utc_s REAL NOT NULL);
CREATE TABLE IF NOT EXISTS state (name TEXT PRIMARY KEY, value BLOB NOT NULL);
"""

# Version 1 had no editions; queued records keep their order.
_MIGRATE_FROM_VERSION_1 = """
ALTER TABLE outbox ADD COLUMN topic TEXT NOT NULL DEFAULT '';
ALTER TABLE outbox ADD COLUMN edition INTEGER NOT NULL DEFAULT 0;
ALTER TABLE outbox ADD COLUMN place INTEGER NOT NULL DEFAULT 0;
UPDATE outbox SET place = seq;
DROP INDEX IF EXISTS outbox_order;
UPDATE meta SET value = CAST('2' AS BLOB) WHERE name = 'version';
"""
# Version 2 remembered received numbers without key and digest. Producers of that version can still repeat records that
# were received: their numbers stay in `seen` and `seen_upto`, for reading only.
# No producer has ever assigned numbers of 2^40 and above.
_MIGRATE_FROM_VERSION_2 = """
CREATE TABLE IF NOT EXISTS seen (origin BLOB NOT NULL, seq INTEGER NOT NULL, PRIMARY KEY (origin, seq)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS seen_upto (origin BLOB PRIMARY KEY, seq INTEGER NOT NULL) WITHOUT ROWID;
ALTER TABLE outbox ADD COLUMN origin BLOB NOT NULL DEFAULT x'';
ALTER TABLE outbox_next ADD COLUMN origin BLOB NOT NULL DEFAULT x'';
DROP TABLE IF EXISTS partial_piece;
DROP TABLE IF EXISTS partial;
DROP TABLE IF EXISTS refused_before;
DELETE FROM seen WHERE seq >= 1099511627776;
DELETE FROM seen_upto WHERE seq >= 1099511627776;
UPDATE meta SET value = CAST('3' AS BLOB) WHERE name = 'version';
"""
_INDEXES = """
CREATE INDEX IF NOT EXISTS outbox_place ON outbox (consumer, priority, place, seq);
CREATE INDEX IF NOT EXISTS outbox_topic ON outbox (consumer, topic, edition) WHERE topic <> '';
"""


def prepare(db: sqlite3.Connection, page_bytes: int) -> tuple[bytes, bytes]:
    """Create the tables of a new store, or convert those of an older one.

    Args:
        db: Connection without an open transaction.
        page_bytes: Size of the pages.

    Returns:
        Version of the schema as text, which differs from `VERSION` for a store of a newer version; and the random
        number of the store, 16 bytes.

    Raises:
        sqlite3.Error: The file cannot be read or written.
    """
    _convert_page_size(db, page_bytes)
    _migrate(db)
    db.executescript(_TABLES)
    _convert_state_table(db)
    with db:
        db.execute("BEGIN IMMEDIATE")
        origin = _meta(db, "origin", uuid.uuid4().bytes)
        version = _meta(db, "version", str(VERSION).encode())
    if version == str(VERSION).encode():
        db.executescript(_INDEXES)
    return version, origin


def has_legacy_windows(db: sqlite3.Connection) -> bool:
    """Return whether the store has numbers that were received by version 2 of the schema."""
    return _has_table(db, "seen_upto")


def _migrate(db: sqlite3.Connection) -> None:
    if not _has_table(db, "meta"):
        return
    row = db.execute("SELECT value FROM meta WHERE name = 'version'").fetchone()
    if row is not None and row[0] == b"1":
        db.executescript(f"BEGIN IMMEDIATE; {_MIGRATE_FROM_VERSION_1} COMMIT;")
    if row is not None and row[0] in (b"1", b"2"):
        with db:
            db.execute("BEGIN IMMEDIATE")
            for statement in _MIGRATE_FROM_VERSION_2.split(";"):
                db.execute(statement)
            _assign_origins(db)


def _assign_origins(db: sqlite3.Connection) -> None:
    """Give queued records the origin that version 2 used for their queue, and each queue a new one."""
    (store_origin,) = db.execute("SELECT value FROM meta WHERE name = 'origin'").fetchone()
    for (queue,) in db.execute("SELECT consumer FROM outbox_next").fetchall():
        origin = bytes(store_origin)
        if SITE_SEPARATOR in queue:
            origin = hashlib.sha256(origin + queue.encode()).digest()[:16]
        db.execute("UPDATE outbox SET origin = ? WHERE consumer = ?", (origin, queue))
        db.execute("UPDATE outbox_next SET origin = ? WHERE consumer = ?", (uuid.uuid4().bytes, queue))


def _has_table(db: sqlite3.Connection, name: str) -> bool:
    found = db.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?", (name,)).fetchone()
    return found is not None


def _meta(db: sqlite3.Connection, name: str, initial: bytes) -> bytes:
    db.execute("INSERT OR IGNORE INTO meta VALUES (?, ?)", (name, initial))
    row = db.execute("SELECT value FROM meta WHERE name = ?", (name,)).fetchone()
    return bytes(row[0])


def _convert_page_size(db: sqlite3.Connection, page_bytes: int) -> None:
    """Convert a file with another page size, which only works without a write-ahead log."""
    if db.execute("PRAGMA page_size").fetchone()[0] == page_bytes:
        return
    try:
        db.execute("PRAGMA journal_mode=DELETE")
        db.execute(f"PRAGMA page_size={page_bytes}")
        db.execute("VACUUM")
    except sqlite3.OperationalError as error:
        # A full disk: the file is still valid, and the next start tries again.
        log.warning("Store keeps its page size", extra=kv(reason=str(error)))
    db.execute("PRAGMA journal_mode=WAL")


def _convert_state_table(db: sqlite3.Connection) -> None:
    """Give the state table of an older store row numbers, with which a changed value keeps its place in the file."""
    if not db.execute("SELECT 1 FROM sqlite_master WHERE name = 'state' AND sql LIKE '%WITHOUT ROWID%'").fetchall():
        return
    with db:
        db.execute("BEGIN IMMEDIATE")
        db.execute("CREATE TABLE state_rows (name TEXT PRIMARY KEY, value BLOB NOT NULL)")
        db.execute("INSERT INTO state_rows SELECT name, value FROM state")
        db.execute("DROP TABLE state")
        db.execute("ALTER TABLE state_rows RENAME TO state")
