"""Tables of a store and their version."""

from __future__ import annotations

import sqlite3
import uuid

VERSION = 4

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

_INDEXES = """
CREATE INDEX IF NOT EXISTS outbox_place ON outbox (consumer, priority, place, seq);
CREATE INDEX IF NOT EXISTS outbox_topic ON outbox (consumer, topic, edition) WHERE topic <> '';
"""


def prepare(db: sqlite3.Connection) -> tuple[bytes, bytes]:
    """Create the tables of a new store.

    Args:
        db: Connection without an open transaction.

    Returns:
        Version of the schema as text, which differs from `VERSION` for a store of another version, whose tables are
        not changed; and the random number of the store, 16 bytes.

    Raises:
        sqlite3.Error: The file cannot be read or written.
    """
    current = str(VERSION).encode()
    version = _stored_version(db)
    if version not in (current, None):
        return version, b""
    db.executescript(_TABLES)
    with db:
        db.execute("BEGIN IMMEDIATE")
        origin = _meta(db, "origin", uuid.uuid4().bytes)
        _meta(db, "version", current)
    db.executescript(_INDEXES)
    return current, origin


def _stored_version(db: sqlite3.Connection) -> bytes | None:
    """Return the version of a store; None for a new one."""
    if not db.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'meta'").fetchall():
        return None
    row = db.execute("SELECT value FROM meta WHERE name = 'version'").fetchone()
    return None if row is None else bytes(row[0])


def _meta(db: sqlite3.Connection, name: str, initial: bytes) -> bytes:
    db.execute("INSERT OR IGNORE INTO meta VALUES (?, ?)", (name, initial))
    row = db.execute("SELECT value FROM meta WHERE name = ?", (name,)).fetchone()
    return bytes(row[0])
