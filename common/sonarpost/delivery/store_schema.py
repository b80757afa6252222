"""The tables of a service's store."""

from __future__ import annotations

SCHEMA_VERSION = 2

TABLES = """
CREATE TABLE IF NOT EXISTS meta (name TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS outbox (
    consumer TEXT NOT NULL, seq INTEGER NOT NULL, key TEXT NOT NULL, encoding TEXT NOT NULL, priority INTEGER NOT NULL,
    payload BLOB NOT NULL, sha256 BLOB NOT NULL, created_utc_s REAL NOT NULL,
    topic TEXT NOT NULL DEFAULT '', edition INTEGER NOT NULL DEFAULT 0, place INTEGER NOT NULL DEFAULT 0,
    PRIMARY KEY (consumer, seq));
CREATE TABLE IF NOT EXISTS outbox_next (consumer TEXT PRIMARY KEY, seq INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS inbox (
    id INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT NOT NULL, payload BLOB NOT NULL, origin BLOB, seq INTEGER,
    received_utc_s REAL NOT NULL);
CREATE TABLE IF NOT EXISTS seen (origin BLOB NOT NULL, seq INTEGER NOT NULL, PRIMARY KEY (origin, seq)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS seen_upto (origin BLOB PRIMARY KEY, seq INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS refused_before (
    origin BLOB NOT NULL, seq INTEGER NOT NULL, PRIMARY KEY (origin, seq)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS partial (
    id INTEGER PRIMARY KEY AUTOINCREMENT, origin BLOB NOT NULL, seq INTEGER NOT NULL, size INTEGER NOT NULL,
    sha256 BLOB NOT NULL, has INTEGER NOT NULL, touched_ns INTEGER NOT NULL, UNIQUE (origin, seq));
CREATE TABLE IF NOT EXISTS partial_piece (
    partial INTEGER NOT NULL REFERENCES partial (id) ON DELETE CASCADE, start INTEGER NOT NULL, data BLOB NOT NULL,
    PRIMARY KEY (partial, start));
CREATE TABLE IF NOT EXISTS refused (
    id INTEGER PRIMARY KEY AUTOINCREMENT, direction TEXT NOT NULL, key TEXT NOT NULL, payload BLOB NOT NULL,
    reason TEXT NOT NULL, at_utc_s REAL NOT NULL);
CREATE TABLE IF NOT EXISTS state (name TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID;
"""

# Version 1 had no editions: what it owed keeps its order.
FROM_VERSION_1 = """
ALTER TABLE outbox ADD COLUMN topic TEXT NOT NULL DEFAULT '';
ALTER TABLE outbox ADD COLUMN edition INTEGER NOT NULL DEFAULT 0;
ALTER TABLE outbox ADD COLUMN place INTEGER NOT NULL DEFAULT 0;
UPDATE outbox SET place = seq;
DROP INDEX IF EXISTS outbox_order;
UPDATE meta SET value = CAST('2' AS BLOB) WHERE name = 'version';
"""
INDEXES = """
CREATE INDEX IF NOT EXISTS outbox_place ON outbox (consumer, priority, place, seq);
CREATE INDEX IF NOT EXISTS outbox_topic ON outbox (consumer, topic, edition) WHERE topic <> '';
"""
