"""Durable store of one service: accepted records, queued records and state in one SQLite file.

The file uses WAL and synchronous=FULL, except to delete acknowledged records. A received record is committed to `inbox`
before it is acknowledged. Handling a record removes it from the inbox, adds new records to `outbox` and changes `state`
in **one** transaction. A process that is killed at any moment therefore neither loses nor duplicates a record.
"""

from __future__ import annotations

import fcntl
import logging
import sqlite3
import struct
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import IO, Any, TypeVar

import msgpack

from sonarpost.delivery import schema
from sonarpost.delivery.records import InboxItem, OutboxItem, Place, QuarantinedRecord
from sonarpost.delivery.transaction import MAX_QUARANTINED_BYTES, Transaction, runs
from sonarpost.delivery.watermark import LOST, LostRecords, Watermark, lost_records
from sonarpost.delivery.watermark import SUFFIX as SIDE_CAR_SUFFIX
from sonarpost.errors import BadInputError, DeliveryError
from sonarpost.files import make_private

log = logging.getLogger(__name__)

T = TypeVar("T")
D = TypeVar("D")

UNREADABLE = (
    BadInputError,
    ArithmeticError,
    AttributeError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
    msgpack.UnpackException,
    struct.error,
)
"""Errors of a parser that mean that a stored value is invalid. A lack of memory, for example, does not."""

CACHE_KB = 8000
"""Page cache: records in flight are deleted without reading them from the disk."""
BUSY_TIMEOUT_S = 10
"""Longest wait for another process that reads or copies the file."""
TRUNCATE_TIMEOUT_MS = 200
"""Longest wait for other processes that read the write-ahead log, before its space is returned to the disk."""
CHECKPOINT_BYTES = 4_096_000
"""Size of the write-ahead log at which its pages are copied into the file."""
MAX_CHECKED_BYTES = 268_435_456
"""Maximum size of a file whose pages are checked at the start: 256 MiB take about 0.3 s on a fast disk."""

_ITEM = "consumer, seq, key, encoding, priority, payload, sha256, place, origin"


@dataclass(frozen=True, slots=True)
class QueueDepth:
    """Contents of one outbox queue.

    Attributes:
        records: Number of queued records.
        size_bytes: Sum of their payload sizes.
        oldest_utc_s: When the oldest record was queued; None for an empty queue.
    """

    records: int
    size_bytes: int
    oldest_utc_s: float | None


class Store:
    """Durable store of a service, safe for several threads (one writer at a time).

    Attributes:
        path: The SQLite file.
        origin: Random number of the store, 16 bytes; each queue has its own.
        inbox_changed: Set when a record was added to the inbox.
        on_queued: Called after a transaction for each queue with new records, with the place of the first one.
        lost: Report of lost commits that no operator has cleared; None if there is none.
        states_discarded: Number of states that could not be read since the start; see `readable`.

    Args:
        path: The SQLite file.
        page_bytes: Size of its pages, a power of two from 512 to 65536. A transaction writes whole pages: small ones
            suit frequent small changes. An existing file keeps its size.

    Raises:
        DeliveryError: The file cannot be opened or is not a store of this version.
    """

    def __init__(self, path: Path, *, page_bytes: int = 4096) -> None:
        self.path = path
        self._page_bytes = page_bytes
        self._lock = threading.RLock()
        self._reader_lock = threading.Lock()
        self.on_queued: Callable[[str, Place], object] | None = None
        self._in_flight: set[tuple[str, int]] = set()
        self._watermark = Watermark(path)
        self.lost: LostRecords | None = None
        self.states_discarded = 0
        self.inbox_changed = threading.Event()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._lock_file = lock_exclusively(path)
            for existing in _files_of(path):
                make_private(existing)
        except OSError as error:
            raise DeliveryError(f"{path}: cannot be opened as a sonarpost store: {error}") from error
        with ExitStack() as on_error:
            on_error.callback(self._lock_file.close)
            self._open(on_error)
            on_error.pop_all()

    def _open(self, on_error: ExitStack) -> None:
        try:
            self._db = sqlite3.connect(self.path, check_same_thread=False, isolation_level=None, timeout=BUSY_TIMEOUT_S)
            on_error.callback(self._db.close)
            self._db.execute(f"PRAGMA page_size={self._page_bytes}")
            self._db.execute("PRAGMA journal_mode=WAL")
            page_bytes = int(self._db.execute("PRAGMA page_size").fetchone()[0])
            self._db.execute(f"PRAGMA wal_autocheckpoint={CHECKPOINT_BYTES // page_bytes}")
            self._db.execute("PRAGMA foreign_keys=ON")
            # Some builds of SQLite overwrite deleted content, which writes every record to the disk a second time.
            self._db.execute("PRAGMA secure_delete=OFF")
            self._db.execute(f"PRAGMA cache_size={-CACHE_KB}")
            self._require_sound()
            version, self.origin = schema.prepare(self._db)
            self._reader = sqlite3.connect(
                self.path, check_same_thread=False, isolation_level=None, timeout=BUSY_TIMEOUT_S
            )
            on_error.callback(self._reader.close)
            self._reader.execute("PRAGMA query_only=ON")
        except sqlite3.Error as error:
            reason = f"cannot be opened as a sonarpost store: {_reason(error, self.path)}"
            raise DeliveryError(f"{self.path}: {reason}") from error
        if version != str(schema.VERSION).encode():
            raise DeliveryError(f"{self.path}: store version {version!r}, expected {schema.VERSION}")
        self._check_watermark()

    def _require_sound(self) -> None:
        """Check the pages of the file; a large file would delay the start."""
        if self.path.stat().st_size <= MAX_CHECKED_BYTES:
            problem = str(self._db.execute("PRAGMA quick_check(1)").fetchone()[0])
            if problem != "ok":
                raise DeliveryError(f"{self.path}: {problem}; {_salvage_hint(self.path)}")

    def _check_watermark(self) -> None:
        """Report lost commits, then write the side-car of this store."""
        with self.transaction():
            self._watermark.check(self._db)
            self.lost = lost_records(self._db)
        with self.transaction():
            self._watermark.start(self._db)

    @contextmanager
    def transaction(self, *, durable: bool = True) -> Iterator[Transaction]:
        """Open a write transaction: committed when the block ends, rolled back when it raises.

        Args:
            durable: Flush it to the disk; without, a power cut can undo it until the next durable one.

        Raises:
            DeliveryError: The database reported an error, for example a full disk; nothing was written.
        """
        with self._lock:
            tx = Transaction(self._db, self._in_flight)
            try:
                # The connection commits at the end of its block, and rolls back after an exception.
                self._db.execute(f"PRAGMA synchronous={'FULL' if durable else 'NORMAL'}")
                with self._db:
                    self._db.execute("BEGIN IMMEDIATE")
                    yield tx
                    tx.flush()
                if tx.assigned or tx.numbered_inbox:
                    self._watermark.committed(self._db, tx.assigned.items(), inbox=tx.numbered_inbox)
            except sqlite3.Error as error:
                raise DeliveryError(f"{self.path}: {_reason(error, self.path)}") from error
            self.states_discarded += tx.states_discarded
        if tx.wrote_inbox:
            self.inbox_changed.set()
        if (on_queued := self.on_queued) is not None:
            for queue, place in tx.first_places.items():
                on_queued(queue, place)

    def _query(self, sql: str, args: tuple[object, ...] = ()) -> list[tuple[Any, ...]]:
        """Query the writing connection, after the transaction in progress."""
        return self._fetch(self._db, self._lock, sql, args)

    def _read(self, sql: str, args: tuple[object, ...] = ()) -> list[tuple[Any, ...]]:
        """Query committed data without waiting for a transaction in progress."""
        return self._fetch(self._reader, self._reader_lock, sql, args)

    def _fetch(
        self, db: sqlite3.Connection, lock: AbstractContextManager[object], sql: str, args: tuple[object, ...]
    ) -> list[tuple[Any, ...]]:
        with lock:
            try:
                return db.execute(sql, args).fetchall()
            except sqlite3.Error as error:
                raise DeliveryError(f"{self.path}: {_reason(error, self.path)}") from error

    def _read_int(self, sql: str, args: tuple[object, ...] = ()) -> int:
        return int(self._read(sql, args)[0][0])

    # Outbox

    def queues(self) -> tuple[str, ...]:
        """Return the names of the queues that hold records."""
        return tuple(str(row[0]) for row in self._read("SELECT DISTINCT consumer FROM outbox"))

    def queued_numbers(self, queue: str, limit: int) -> tuple[int, ...]:
        """Return the first `limit` sequence numbers of a queue: most urgent first, then oldest first."""
        found = self._read(
            "SELECT seq FROM outbox WHERE consumer = ? ORDER BY priority, place, seq LIMIT ?", (queue, limit)
        )
        return tuple(int(row[0]) for row in found)

    def queued_items(self, queue: str, numbers: Sequence[int]) -> tuple[OutboxItem, ...]:
        """Return those of the numbered records that are still queued, in the order of `numbers`."""
        sql = f"SELECT {_ITEM} FROM outbox WHERE consumer = ? AND seq BETWEEN ? AND ?"  # noqa: S608 constants
        items = [OutboxItem(*row) for run in runs(numbers) for row in self._read(sql, (queue, *run))]
        found = {item.seq: item for item in items}
        return tuple(found[number] for number in numbers if number in found)

    def mark_in_flight(self, queue: str, numbers: Sequence[int]) -> Set[int]:
        """Protect records from replacement by newer editions; return the numbers that are still queued."""
        sql = "SELECT seq FROM outbox WHERE consumer = ? AND seq BETWEEN ? AND ?"
        with self._lock:
            queued = {int(row[0]) for run in runs(numbers) for row in self._query(sql, (queue, *run))}
            self._in_flight.update((queue, seq) for seq in queued)
        return queued

    def clear_in_flight(self, queue: str, *numbers: int) -> None:
        """Undo `mark_in_flight`."""
        # Without the lock, whose holder can wait for the disk; a transaction in progress ignores marked records.
        for seq in numbers:
            self._in_flight.discard((queue, seq))

    def done_up_to(self, queue: str) -> int:
        """Return the highest number for which this and all lower numbers have left the queue."""
        # One statement: a record queued between two statements would be reported to its consumer as done.
        return self._read_int(
            "SELECT COALESCE((SELECT MIN(seq) - 1 FROM outbox WHERE consumer = ?),"
            " (SELECT seq FROM outbox_next WHERE consumer = ?), 0)",
            (queue, queue),
        )

    def is_older_than(self, queue: str, origin: bytes, highest: int, sha256: bytes) -> bool:
        """Return whether this file is older than the last delivery of a queue: it was restored from a copy.

        Args:
            queue: Name of the queue.
            origin: Origin to which the consumer's statement refers.
            highest: Sequence number that the consumer has accepted.
            sha256: Digest of the record with this number.
        """
        found = self._query("SELECT seq, origin FROM outbox_next WHERE consumer = ?", (queue,))
        if not found or bytes(found[0][1]) != origin:
            return False
        if highest > found[0][0]:
            return True
        items = self.queued_items(queue, [highest])
        return bool(items) and items[0].origin == origin and items[0].sha256 != sha256

    def queue_depth(self, queue: str, max_priority: int = 7) -> QueueDepth:
        """Return the contents of one queue, counting priorities 1 to `max_priority`."""
        records, size, oldest = self._read(
            "SELECT COUNT(*), COALESCE(SUM(LENGTH(payload)), 0), MIN(created_utc_s) FROM outbox"
            " WHERE consumer = ? AND priority <= ?",
            (queue, max_priority),
        )[0]
        return QueueDepth(int(records), int(size), oldest)

    def outbox_depth(self) -> int:
        """Return the number of records in all queues."""
        return self._read_int("SELECT COUNT(*) FROM outbox")

    # Inbox, quarantine and state

    def inbox_depth(self) -> int:
        """Return the number of accepted records that are not handled yet."""
        return self._read_int("SELECT COUNT(*) FROM inbox")

    def refused_count(self) -> int:
        """Return the number of quarantined records."""
        return self._read_int("SELECT COUNT(*) FROM refused")

    def quarantined(self) -> list[QuarantinedRecord]:
        """Return the quarantined records, oldest first."""
        rows = self._read(
            "SELECT id, at_utc_s, direction, key, LENGTH(payload), reason,"
            " direction = 'in' AND instr(key, ' ') = 0 AND LENGTH(payload) <> ? FROM refused ORDER BY id",
            (MAX_QUARANTINED_BYTES,),
        )
        return [QuarantinedRecord(*row) for row in rows]

    def reusable_bytes(self) -> int:
        """Return the free space inside the file in bytes; the file itself never shrinks."""
        return self._read_int("PRAGMA freelist_count") * self._read_int("PRAGMA page_size")

    def truncate_log(self) -> None:
        """Return the space of the write-ahead log to the disk, unless a reader still needs the log.

        The log keeps the size that it once had, for example while a reader delayed its checkpoint.

        Raises:
            DeliveryError: The log cannot be written to the file, for example because the disk is full.
        """
        with self._lock:
            # Without a long wait for a reader of another process: a transaction would wait too.
            self._query(f"PRAGMA busy_timeout={TRUNCATE_TIMEOUT_MS}")
            try:
                self._query("PRAGMA wal_checkpoint(TRUNCATE)")
            finally:
                self._query(f"PRAGMA busy_timeout={BUSY_TIMEOUT_S * 1000}")

    def inbox_items(self, limit: int = 1, max_bytes: int | None = None) -> tuple[InboxItem, ...]:
        """Return accepted records that are not handled yet, oldest first.

        Args:
            limit: Maximum number of records.
            max_bytes: Maximum sum of the payload sizes, at least one record; None for no limit.
        """
        if max_bytes is not None:
            sizes = self._read("SELECT LENGTH(payload) FROM inbox ORDER BY id LIMIT ?", (limit,))
            if not sizes:
                return ()
            totals = accumulate(size for (size,) in sizes)
            limit = max(1, sum(total <= max_bytes for total in totals))
        found = self._read("SELECT id, key, payload FROM inbox ORDER BY id LIMIT ?", (limit,))
        return tuple(InboxItem(*row) for row in found)

    def get_state(self, name: str) -> bytes | None:
        """Return the value under `name`, or None."""
        found = self._query("SELECT value FROM state WHERE name = ?", (name,))
        return bytes(found[0][0]) if found else None

    def state_names(self, prefix: str) -> tuple[str, ...]:
        """Return the names of all values that start with `prefix`."""
        found = self._query("SELECT name FROM state WHERE name >= ? AND name < ?", (prefix, prefix + "\U0010ffff"))
        return tuple(str(row[0]) for row in found)

    def states(self, prefix: str) -> dict[str, bytes]:
        """Return all values whose names start with `prefix`, by the rest of their names."""
        found = self._query(
            "SELECT name, value FROM state WHERE name >= ? AND name < ?", (prefix, prefix + "\U0010ffff")
        )
        return {str(name).removeprefix(prefix): bytes(value) for name, value in found}

    def read_state(self, name: str, parse: Callable[[bytes], T], otherwise: D) -> T | D:
        """Parse the value under `name`; return `otherwise` if there is none or it is discarded. See `readable`."""
        value = self.get_state(name)
        if value is None:
            return otherwise
        return self.readable({name: value}, lambda _, data: parse(data)).get(name, otherwise)

    def read_states(self, prefix: str, parse: Callable[[str, bytes], T]) -> dict[str, T]:
        """Parse all values whose names start with `prefix`, by the rest of their names. See `readable`."""
        values = {prefix + name: value for name, value in self.states(prefix).items()}
        found = self.readable(values, lambda name, value: parse(name.removeprefix(prefix), value))
        return {name.removeprefix(prefix): parsed for name, parsed in found.items()}

    def readable(self, values: Mapping[str, bytes], parse: Callable[[str, bytes], T]) -> dict[str, T]:
        """Parse values of states, each on its own. Those that cannot be parsed are moved to the quarantine.

        Each of these is logged and counted in `states_discarded`, which degrades the health of the service.

        Args:
            values: Values by their complete names.
            parse: Receives the name and the value. An error of `UNREADABLE` means that the value is invalid.

        Raises:
            DeliveryError: The store cannot be written, or a transaction is open in this thread.
        """
        parsed: dict[str, T] = {}
        errors: dict[str, str] = {}
        for name, value in values.items():
            try:
                parsed[name] = parse(name, value)
            except UNREADABLE as error:
                errors[name] = str(error) if isinstance(error, BadInputError) else f"{type(error).__name__}: {error}"
        if errors:
            with self.transaction() as tx:
                for name, reason in errors.items():
                    tx.discard_state(name, values[name], reason)
        return parsed

    def clear_lost(self) -> LostRecords | None:
        """Delete the report of lost commits; return it."""
        with self.transaction():
            self._db.execute("DELETE FROM meta WHERE name = ?", (LOST,))
        lost, self.lost = self.lost, None
        return lost

    def close(self) -> None:
        """Close the file."""
        with self._lock, self._reader_lock:
            self._reader.close()
            self._db.close()
            self._watermark.close()
            self._lock_file.close()


def _files_of(path: Path) -> list[Path]:
    """Return the files of a store: the database itself, which may be missing, and the present ones beside it."""
    beside = [path.with_name(f"{path.name}{suffix}") for suffix in ("-wal", "-shm", ".lock", SIDE_CAR_SUFFIX)]
    return [path, *(each for each in beside if each.is_file())]


def _salvage_hint(path: Path) -> str:
    return f"stop the service and recover the records: sonarpost store salvage {path} --out NEW"


def _reason(error: sqlite3.Error, path: Path) -> str:
    """Return the text of an error; for a damaged file, with the command that recovers its records."""
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    damaged = code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
    return f"{error}; {_salvage_hint(path)}" if damaged else str(error)


def lock_exclusively(path: Path) -> IO[bytes]:
    """Lock the store for this process; the kernel releases the lock when the process ends.

    Raises:
        DeliveryError: Another process holds the lock; two processes would handle every record twice.
    """
    file = path.with_name(f"{path.name}.lock").open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.close()
        raise DeliveryError(f"{path}: in use by another process of this service") from error
    return file
