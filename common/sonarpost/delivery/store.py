"""The durable store of one service: what it has accepted, what it owes, and what it must remember.

One SQLite file a service (WAL, synchronous=FULL). A record from outside is committed to `inbox` before it is
acknowledged. Handling a record removes it from the inbox, adds what it leads to in `outbox` and changes `state` in
**one** transaction, so a process killed at any moment neither loses nor doubles anything.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import sqlite3
import threading
import uuid
from collections.abc import Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from sonarpost.delivery import rows, store_schema
from sonarpost.delivery.store_schema import SCHEMA_VERSION
from sonarpost.delivery.transaction import QUEUE_MARK, InboxItem, OutboxItem, Transaction
from sonarpost.errors import DeliveryError

log = logging.getLogger(__name__)

CACHE_KB = 8000
"""Most memory for pages: what is on its way need not be read from the disk to be deleted."""
_ITEM = "consumer, seq, key, encoding, priority, payload, sha256, place, created_utc_s"


@dataclass(frozen=True, slots=True)
class QueueDepth:
    """What waits in one queue of the outbox.

    Attributes:
        oldest_utc_s: When the oldest record was queued; None where nothing waits.
    """

    records: int
    size_bytes: int
    oldest_utc_s: float | None


class Store:
    """A service's durable store; safe to use from several threads (one writer at a time).

    Raises:
        DeliveryError: The file cannot be opened or is not a store of this version.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.RLock()
        self._reader_lock = threading.Lock()
        self._outbox_listeners: list[threading.Event] = []
        self._begun: set[tuple[str, int]] = set()
        self.inbox_changed = threading.Event()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._lock_file = _only_user(path)
        except OSError as error:
            raise DeliveryError(f"{path}: cannot be opened as a sonarpost store: {error}") from error
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
            self._db.execute("PRAGMA foreign_keys=ON")
            # Some builds of SQLite overwrite what is deleted: every record would be written to the disk once more.
            self._db.execute("PRAGMA secure_delete=OFF")
            self._db.execute(f"PRAGMA cache_size={-CACHE_KB}")
            self._db.executescript(store_schema.TABLES)
            with self.transaction():
                self.origin = self._meta("origin", uuid.uuid4().bytes)
                version = self._meta("version", str(SCHEMA_VERSION).encode())
            if version == b"1":
                self._db.executescript(f"BEGIN IMMEDIATE; {store_schema.FROM_VERSION_1} COMMIT;")
                version = str(SCHEMA_VERSION).encode()
            if version == str(SCHEMA_VERSION).encode():
                self._db.executescript(store_schema.INDEXES)
            self._reader = sqlite3.connect(self.path, check_same_thread=False, isolation_level=None, timeout=10)
            self._reader.execute("PRAGMA query_only=ON")
        except sqlite3.Error as error:
            raise DeliveryError(f"{self.path}: cannot be opened as a sonarpost store: {error}") from error
        if version != str(SCHEMA_VERSION).encode():
            self._reader.close()
            self._db.close()
            raise DeliveryError(f"{self.path}: store version {version!r}, expected {SCHEMA_VERSION}")

    def _meta(self, name: str, initial: bytes) -> bytes:
        self._db.execute("INSERT OR IGNORE INTO meta VALUES (?, ?)", (name, initial))
        row = self._db.execute("SELECT value FROM meta WHERE name = ?", (name,)).fetchone()
        return bytes(row[0])

    @contextmanager
    def transaction(self) -> Iterator[Transaction]:
        """Open a write transaction: committed (and on the disk) when the block ends, rolled back when it raises.

        Raises:
            DeliveryError: The database refused (a full disk, for example); nothing of the block was kept.
        """
        with self._lock:
            tx = Transaction(self._db, self._begun)
            try:
                self._db.execute("BEGIN IMMEDIATE")
                yield tx
                tx.flush()
                self._db.execute("COMMIT")
            except BaseException as error:
                self._roll_back()
                if isinstance(error, sqlite3.Error):
                    raise DeliveryError(f"{self.path}: {error}") from error
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
        try:
            if self._db.in_transaction:
                self._db.execute("ROLLBACK")
        except sqlite3.ProgrammingError:
            # The store is closed, and what was not committed is gone with it.
            log.debug("Nothing to roll back: %s is closed", self.path)

    def _query(self, sql: str, args: tuple[object, ...] = ()) -> list[tuple[object, ...]]:
        with self._lock:
            try:
                return self._db.execute(sql, args).fetchall()
            except sqlite3.Error as error:
                raise DeliveryError(f"{self.path}: {error}") from error

    def _read(self, sql: str, args: tuple[object, ...] = ()) -> list[tuple[object, ...]]:
        """Query what is committed, without waiting for a transaction that waits for the disk."""
        with self._reader_lock:
            try:
                return self._reader.execute(sql, args).fetchall()
            except sqlite3.Error as error:
                raise DeliveryError(f"{self.path}: {error}") from error

    def consumers(self) -> tuple[str, ...]:
        """Return the consumers to whom something is owed."""
        return tuple(str(row[0]) for row in self._read("SELECT DISTINCT consumer FROM outbox"))

    def owed(self, consumer: str, limit: int) -> tuple[OutboxItem, ...]:
        """Return what is owed to `consumer`, most urgent first, then oldest first."""
        return self.owed_items(consumer, self.owed_numbers(consumer, limit))

    def owed_numbers(self, queue: str, limit: int) -> tuple[int, ...]:
        """Return the numbers of what is owed, most urgent first, then oldest first."""
        found = self._read(
            "SELECT seq FROM outbox WHERE consumer = ? ORDER BY priority, place, seq LIMIT ?", (queue, limit)
        )
        return tuple(_int(row[0]) for row in found)

    def owed_items(self, queue: str, numbers: Sequence[int]) -> tuple[OutboxItem, ...]:
        """Return the records of these numbers that are still owed, in the order of the numbers."""
        sql = f"SELECT {_ITEM} FROM outbox WHERE consumer = ? AND seq BETWEEN ? AND ?"  # noqa: S608 constants
        found = {}
        for first, last in rows.runs(numbers):
            for c, s, k, e, p, d, h, at, t in self._read(sql, (queue, first, last)):
                seq = _int(s)
                found[seq] = OutboxItem(
                    str(c), seq, str(k), str(e), _int(p), _bytes(d), _bytes(h), _int(at), float(str(t))
                )
        return tuple(found[number] for number in numbers if number in found)

    def begin(self, queue: str, seq: int) -> bool:
        """Say that a record is about to be sent, so that no newer edition replaces it; False when one already has."""
        return bool(self.begin_all(queue, (seq,)))

    def begin_all(self, queue: str, numbers: Sequence[int]) -> Set[int]:
        """Say that records are about to be sent; return which of them are still owed."""
        sql = "SELECT seq FROM outbox WHERE consumer = ? AND seq BETWEEN ? AND ?"
        with self._lock:
            there = {_int(row[0]) for run in rows.runs(numbers) for row in self._query(sql, (queue, *run))}
            self._begun.update((queue, seq) for seq in there)
        return there

    def end(self, queue: str, *numbers: int) -> None:
        """Take back what `begin` said."""
        # Without the lock, whose holder may wait for the disk: what a transaction still finds begun it leaves alone.
        for seq in numbers:
            self._begun.discard((queue, seq))

    def settled_upto(self, queue: str) -> int:
        """Return the highest number with which, and with all below it, the queue is done."""
        # One statement: a record that is queued between two would be told to its consumer as done with.
        found = self._read(
            "SELECT COALESCE((SELECT MIN(seq) - 1 FROM outbox WHERE consumer = ?1),"
            " (SELECT seq FROM outbox_next WHERE consumer = ?1), 0)",
            (queue,),
        )
        return _int(found[0][0])

    def origin_of(self, queue: str) -> bytes:
        """Return the 16 bytes by which a queue's consumer knows it.

        A plain consumer's is the store's own; every `queue_of` has another, as its numbers begin at 1 again and might
        come to a consumer that knows them from elsewhere (a site that was renamed).
        """
        if QUEUE_MARK not in queue:
            return self.origin
        return hashlib.sha256(self.origin + queue.encode()).digest()[:16]

    def queue_depth(self, queue: str, most_priority: int = 7) -> QueueDepth:
        """Return what waits in one queue, of priorities 1 to `most_priority`."""
        records, size, oldest = self._read(
            "SELECT COUNT(*), COALESCE(SUM(LENGTH(payload)), 0), MIN(created_utc_s) FROM outbox"
            " WHERE consumer = ? AND priority <= ?",
            (queue, most_priority),
        )[0]
        return QueueDepth(int(str(records)), int(str(size)), None if oldest is None else float(str(oldest)))

    def outbox_depth(self) -> int:
        """Return how many records are owed to all consumers."""
        return int(str(self._read("SELECT COUNT(*) FROM outbox")[0][0]))

    def inbox_depth(self) -> int:
        """Return how many accepted records are not handled yet."""
        return int(str(self._read("SELECT COUNT(*) FROM inbox")[0][0]))

    def refused_count(self) -> int:
        """Return how many records lie in the refused table."""
        return int(str(self._read("SELECT COUNT(*) FROM refused")[0][0]))

    def reusable_bytes(self) -> int:
        """Return how much lies free inside the file: it never becomes smaller."""
        pages, size = self._read("PRAGMA freelist_count")[0][0], self._read("PRAGMA page_size")[0][0]
        return int(str(pages)) * int(str(size))

    def pending(self, limit: int = 1, after_id: int = 0, max_bytes: int | None = None) -> tuple[InboxItem, ...]:
        """Return accepted records not handled yet, oldest first, with an id above `after_id`.

        Args:
            limit: Most records.
            after_id: Only later ones.
            max_bytes: Most bytes of payload, but one record at least; no limit by default.
        """
        if max_bytes is not None:
            limit = self._how_many_within(limit, after_id, max_bytes)
        found = self._read("SELECT id, key, payload FROM inbox WHERE id > ? ORDER BY id LIMIT ?", (after_id, limit))
        return tuple(InboxItem(_int(i), str(k), _bytes(p)) for i, k, p in found)

    def _how_many_within(self, limit: int, after_id: int, max_bytes: int) -> int:
        sizes = self._read("SELECT LENGTH(payload) FROM inbox WHERE id > ? ORDER BY id LIMIT ?", (after_id, limit))
        total = 0
        for count, (size,) in enumerate(sizes):
            total += _int(size)
            if total > max_bytes:
                return max(count, 1)
        return limit

    def get_state(self, name: str) -> bytes | None:
        """Return what is remembered under `name`, or None."""
        found = self._query("SELECT value FROM state WHERE name = ?", (name,))
        return _bytes(found[0][0]) if found else None

    def state_names(self, prefix: str) -> tuple[str, ...]:
        """Return the names that begin with `prefix` under which something is remembered."""
        found = self._query("SELECT name FROM state WHERE name >= ? AND name < ?", (prefix, prefix + "\U0010ffff"))
        return tuple(str(row[0]) for row in found)

    def close(self) -> None:
        """Close the file."""
        with self._lock, self._reader_lock:
            self._reader.close()
            self._db.close()
            self._lock_file.close()


def _only_user(path: Path) -> IO[bytes]:
    """Lock the store for this process; the kernel lets go when it ends, however it ends.

    Raises:
        DeliveryError: Another process has it: two of them would handle every record twice.
    """
    file = path.with_name(f"{path.name}.lock").open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.close()
        raise DeliveryError(f"{path}: in use by another process of this service") from error
    return file


def _int(value: object) -> int:
    assert isinstance(value, int)
    return value


def _bytes(value: object) -> bytes:
    assert isinstance(value, bytes)
    return value
