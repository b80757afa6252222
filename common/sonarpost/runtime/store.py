"""The durable store of one service: what it has accepted, what it owes, and what it must remember.

One SQLite file a service (WAL, synchronous=FULL). A record from outside is committed to `inbox` before it is
acknowledged. Handling a record removes it from the inbox, adds what it leads to in `outbox` and changes `state` in
**one** transaction, so a process killed at any moment neither loses nor doubles anything.
"""

from __future__ import annotations

import fcntl
import hashlib
import sqlite3
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from sonarpost.errors import HandoffError

SCHEMA_VERSION = 1

# Bounds on what strangers can make a store keep: whatever is beyond them, the oldest goes.
REFUSED_KEPT = 1000
REFUSED_BYTES = 256 * 1024
PARTIALS_KEPT = 64

_SCHEMA = """
CREATE TABLE IF NOT EXISTS meta (name TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS outbox (
    consumer TEXT NOT NULL, seq INTEGER NOT NULL, key TEXT NOT NULL, encoding TEXT NOT NULL, priority INTEGER NOT NULL,
    payload BLOB NOT NULL, sha256 BLOB NOT NULL, created_utc_s REAL NOT NULL, PRIMARY KEY (consumer, seq));
CREATE INDEX IF NOT EXISTS outbox_order ON outbox (consumer, priority, seq);
CREATE TABLE IF NOT EXISTS outbox_next (consumer TEXT PRIMARY KEY, seq INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS inbox (
    id INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT NOT NULL, payload BLOB NOT NULL, origin BLOB, seq INTEGER,
    received_utc_s REAL NOT NULL);
CREATE TABLE IF NOT EXISTS seen (origin BLOB NOT NULL, seq INTEGER NOT NULL, PRIMARY KEY (origin, seq)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS seen_upto (origin BLOB PRIMARY KEY, seq INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS partial (
    origin BLOB NOT NULL, seq INTEGER NOT NULL, size INTEGER NOT NULL, sha256 BLOB NOT NULL, data BLOB NOT NULL,
    touched_utc_s REAL NOT NULL, PRIMARY KEY (origin, seq));
CREATE TABLE IF NOT EXISTS refused (
    id INTEGER PRIMARY KEY AUTOINCREMENT, direction TEXT NOT NULL, key TEXT NOT NULL, payload BLOB NOT NULL,
    reason TEXT NOT NULL, at_utc_s REAL NOT NULL);
CREATE TABLE IF NOT EXISTS state (name TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID;
"""


@dataclass(frozen=True, slots=True)
class OutboxItem:
    """A record that its consumer has not acknowledged yet."""

    consumer: str
    seq: int
    key: str
    encoding: str
    priority: int
    payload: bytes
    sha256: bytes


@dataclass(frozen=True, slots=True)
class Chunk:
    """A piece of a record on its way, as the hand-over query carries it."""

    origin: bytes
    seq: int
    size: int
    sha256: bytes
    offset: int
    data: bytes


@dataclass(frozen=True, slots=True)
class InboxItem:
    """A record that was accepted and not yet handled."""

    id: int
    key: str
    payload: bytes


class Transaction:
    """The writes of one transaction; made by `Store.transaction`, atomic with everything else in it."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._db = connection
        self.wrote_outbox = False
        self.wrote_inbox = False

    def send(self, key: str, consumer: str, payload: bytes, *, encoding: str, priority: int = 4) -> int:
        """Owe `payload` to `consumer` under `key`; return its sequence number (from 1, without gaps, a consumer).

        Args:
            key: Key expression the record is published on.
            consumer: Name of the service that acknowledges it.
            payload: The record's bytes.
            encoding: Zenoh encoding of the payload.
            priority: 1 (first) to 7 (last), as Zenoh's priorities.
        """
        row = self._db.execute(
            "INSERT INTO outbox_next VALUES (?, 1) ON CONFLICT (consumer) DO UPDATE SET seq = seq + 1 RETURNING seq",
            (consumer,),
        ).fetchone()
        seq = int(row[0])
        self._db.execute(
            "INSERT INTO outbox VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
            (consumer, seq, key, encoding, priority, payload, hashlib.sha256(payload).digest(), time.time()),
        )
        self.wrote_outbox = True
        return seq

    def acknowledged(self, consumer: str, seq: int) -> None:
        """Forget what the consumer has committed."""
        self._db.execute("DELETE FROM outbox WHERE consumer = ? AND seq = ?", (consumer, seq))

    def rejected(self, item: OutboxItem, reason: str) -> None:
        """Keep what the consumer refused apart, where a person can find it."""
        self.refuse("out", item.key, item.payload, reason)
        self.acknowledged(item.consumer, item.seq)

    def accept(self, key: str, payload: bytes, origin: bytes | None = None, seq: int | None = None) -> bool:
        """Put a record into the inbox; False when (origin, seq) was accepted before."""
        if origin is not None and seq is not None and not self._first_time(origin, seq):
            return False
        self._db.execute(
            "INSERT INTO inbox (key, payload, origin, seq, received_utc_s) VALUES (?, ?, ?, ?, ?)",
            (key, payload, origin, seq, time.time()),
        )
        self.wrote_inbox = True
        return True

    def done(self, item: InboxItem) -> None:
        """Remove a handled record from the inbox."""
        self._db.execute("DELETE FROM inbox WHERE id = ?", (item.id,))

    def refuse(self, direction: str, key: str, payload: bytes, reason: str) -> None:
        """Keep a record that cannot be handled, with the reason: the latest 1000, of each at most 256 kB."""
        row = self._db.execute(
            "INSERT INTO refused (direction, key, payload, reason, at_utc_s) VALUES (?, ?, ?, ?, ?) RETURNING id",
            (direction, key, payload[:REFUSED_BYTES], reason, time.time()),
        ).fetchone()
        self._db.execute("DELETE FROM refused WHERE id <= ?", (int(row[0]) - REFUSED_KEPT,))

    def mark_seen(self, origin: bytes, seq: int) -> bool:
        """Remember (origin, seq) without an inbox record; False when it was known."""
        return self._first_time(origin, seq)

    def _first_time(self, origin: bytes, seq: int) -> bool:
        if self.was_seen(origin, seq):
            return False
        self._db.execute("INSERT INTO seen VALUES (?, ?)", (origin, seq))
        self._db.execute("DELETE FROM partial WHERE origin = ? AND seq = ?", (origin, seq))
        self._compact(origin)
        return True

    def was_seen(self, origin: bytes, seq: int) -> bool:
        """Tell whether (origin, seq) was accepted before."""
        if seq <= self._watermark(origin):
            return True
        return self._db.execute("SELECT 1 FROM seen WHERE origin = ? AND seq = ?", (origin, seq)).fetchone() is not None

    def _watermark(self, origin: bytes) -> int:
        row = self._db.execute("SELECT seq FROM seen_upto WHERE origin = ?", (origin,)).fetchone()
        return int(row[0]) if row else 0

    def _compact(self, origin: bytes) -> None:
        """Fold the unbroken run of accepted numbers into one, so that memory of the past stays small."""
        upto = before = self._watermark(origin)
        while self._db.execute("SELECT 1 FROM seen WHERE origin = ? AND seq = ?", (origin, upto + 1)).fetchone():
            upto += 1
        if upto > before:
            self._db.execute("INSERT OR REPLACE INTO seen_upto VALUES (?, ?)", (origin, upto))
            self._db.execute("DELETE FROM seen WHERE origin = ? AND seq <= ?", (origin, upto))

    def add_chunk(self, chunk: Chunk) -> bytes | int:
        """Add one chunk of a large record; return the whole record's bytes, or the offset wanted next.

        A chunk that does not continue what is there is not stored: the returned offset says where to go on, which
        makes a transfer resumable over restarts of either side.
        """
        which = (chunk.origin, chunk.seq)
        row = self._db.execute("SELECT size, sha256, data FROM partial WHERE origin = ? AND seq = ?", which).fetchone()
        data = bytes(row[2]) if row and (row[0], row[1]) == (chunk.size, chunk.sha256) else b""
        if chunk.offset == len(data):
            data += chunk.data
        if len(data) >= chunk.size:
            self._db.execute("DELETE FROM partial WHERE origin = ? AND seq = ?", which)
            return data if hashlib.sha256(data).digest() == chunk.sha256 else 0
        self._db.execute(
            "INSERT OR REPLACE INTO partial VALUES (?, ?, ?, ?, ?, ?)",
            (*which, chunk.size, chunk.sha256, data, time.time()),
        )
        self._db.execute(
            "DELETE FROM partial WHERE rowid NOT IN (SELECT rowid FROM partial ORDER BY touched_utc_s DESC LIMIT ?)",
            (PARTIALS_KEPT,),
        )
        return len(data)

    def put_state(self, name: str, value: bytes) -> None:
        """Remember `value` under `name`."""
        self._db.execute("INSERT OR REPLACE INTO state VALUES (?, ?)", (name, value))

    def delete_state(self, name: str) -> None:
        """Forget `name`."""
        self._db.execute("DELETE FROM state WHERE name = ?", (name,))

    def get_state(self, name: str) -> bytes | None:
        """Return what is remembered under `name`, or None."""
        row = self._db.execute("SELECT value FROM state WHERE name = ?", (name,)).fetchone()
        return bytes(row[0]) if row else None


class Store:
    """A service's durable store; safe to use from several threads (one writer at a time).

    Raises:
        HandoffError: The file cannot be opened or is not a store of this version.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.RLock()
        self._outbox_listeners: list[threading.Event] = []
        self.inbox_changed = threading.Event()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._lock_file = _only_user(path)
        except OSError as error:
            raise HandoffError(f"{path}: cannot be opened as a sonarpost store: {error}") from error
        try:
            self._open()
        except BaseException:
            self._lock_file.close()
            raise

    def _open(self) -> None:
        try:
            self._db = sqlite3.connect(self.path, check_same_thread=False, isolation_level=None, timeout=10)
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=FULL")
            self._db.executescript(_SCHEMA)
        except sqlite3.Error as error:
            raise HandoffError(f"{self.path}: cannot be opened as a sonarpost store: {error}") from error
        with self.transaction():
            self.origin = self._meta("origin", uuid.uuid4().bytes)
            version = int(self._meta("version", str(SCHEMA_VERSION).encode()))
        if version != SCHEMA_VERSION:
            self._db.close()
            raise HandoffError(f"{self.path}: store version {version}, expected {SCHEMA_VERSION}")

    def _meta(self, name: str, initial: bytes) -> bytes:
        self._db.execute("INSERT OR IGNORE INTO meta VALUES (?, ?)", (name, initial))
        row = self._db.execute("SELECT value FROM meta WHERE name = ?", (name,)).fetchone()
        return bytes(row[0])

    @contextmanager
    def transaction(self) -> Iterator[Transaction]:
        """Open a write transaction: committed (and on the disk) when the block ends, rolled back when it raises.

        Raises:
            HandoffError: The database refused (a full disk, for example); nothing of the block was kept.
        """
        with self._lock:
            tx = Transaction(self._db)
            try:
                self._db.execute("BEGIN IMMEDIATE")
                yield tx
                self._db.execute("COMMIT")
            except BaseException as error:
                self._roll_back()
                if isinstance(error, sqlite3.Error):
                    raise HandoffError(f"{self.path}: {error}") from error
                raise
        if tx.wrote_outbox:
            for event in tuple(self._outbox_listeners):
                event.set()
        if tx.wrote_inbox:
            self.inbox_changed.set()

    def listen_outbox(self, event: threading.Event) -> None:
        """Set `event` whenever the outbox has grown."""
        self._outbox_listeners.append(event)

    def unlisten_outbox(self, event: threading.Event) -> None:
        """Stop setting `event`."""
        self._outbox_listeners.remove(event)

    def _roll_back(self) -> None:
        if self._db.in_transaction:
            self._db.execute("ROLLBACK")

    def _query(self, sql: str, args: tuple[object, ...] = ()) -> list[tuple[object, ...]]:
        with self._lock:
            try:
                return self._db.execute(sql, args).fetchall()
            except sqlite3.Error as error:
                raise HandoffError(f"{self.path}: {error}") from error

    def consumers(self) -> tuple[str, ...]:
        """Return the consumers to whom something is owed."""
        return tuple(str(row[0]) for row in self._query("SELECT DISTINCT consumer FROM outbox"))

    def owed(self, consumer: str, limit: int) -> tuple[OutboxItem, ...]:
        """Return what is owed to `consumer`, most urgent first, then oldest first."""
        rows = self._query(
            "SELECT consumer, seq, key, encoding, priority, payload, sha256 FROM outbox WHERE consumer = ?"
            " ORDER BY priority, seq LIMIT ?",
            (consumer, limit),
        )
        return tuple(
            OutboxItem(str(c), int(str(s)), str(k), str(e), int(str(p)), _bytes(d), _bytes(h))
            for c, s, k, e, p, d, h in rows
        )

    def outbox_depth(self) -> int:
        """Return how many records are owed to all consumers."""
        return int(str(self._query("SELECT COUNT(*) FROM outbox")[0][0]))

    def inbox_depth(self) -> int:
        """Return how many accepted records are not handled yet."""
        return int(str(self._query("SELECT COUNT(*) FROM inbox")[0][0]))

    def refused_count(self) -> int:
        """Return how many records lie in the refused table."""
        return int(str(self._query("SELECT COUNT(*) FROM refused")[0][0]))

    def pending(self, limit: int = 1, after_id: int = 0) -> tuple[InboxItem, ...]:
        """Return accepted records not handled yet, oldest first, with an id above `after_id`."""
        rows = self._query("SELECT id, key, payload FROM inbox WHERE id > ? ORDER BY id LIMIT ?", (after_id, limit))
        return tuple(InboxItem(int(str(i)), str(k), _bytes(p)) for i, k, p in rows)

    def get_state(self, name: str) -> bytes | None:
        """Return what is remembered under `name`, or None."""
        rows = self._query("SELECT value FROM state WHERE name = ?", (name,))
        return _bytes(rows[0][0]) if rows else None

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._db.close()
            self._lock_file.close()


def _only_user(path: Path) -> IO[bytes]:
    """Lock the store for this process; the kernel lets go when it ends, however it ends.

    Raises:
        HandoffError: Another process has it: two of them would handle every record twice.
    """
    file = path.with_name(f"{path.name}.lock").open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.close()
        raise HandoffError(f"{path}: in use by another process of this service") from error
    return file


def _bytes(value: object) -> bytes:
    assert isinstance(value, bytes)
    return value
