"""Writes to a service's store: one open transaction, and a unit of work that is committed later."""

from __future__ import annotations

import hashlib
import logging
import sqlite3
import time
import uuid
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from functools import cache
from itertools import chain
from typing import Final

from sonarpost import wire
from sonarpost.archive.retention import Stored, select_for_removal, vehicle_source
from sonarpost.delivery.received import DuplicateWindow, PartialRecords
from sonarpost.delivery.records import InboxItem, OutboxItem, Place, ReceivedChunk, Topic
from sonarpost.keys import writer_of
from sonarpost.limits import limit
from sonarpost.logs import kv
from sonarpost.messages import Record

log = logging.getLogger(__name__)

_OLDEST: Final = "the largest source loses its oldest"
MAX_QUARANTINED: Final = limit(1000, "records", "shares", "quarantine", "sender", "quarantined records", _OLDEST)
MAX_QUARANTINE_BYTES: Final = limit(
    256 * 1024 * 1024, "bytes", "shares", "quarantine", "sender", "size of the quarantine", _OLDEST
)
MAX_QUARANTINED_BYTES: Final = limit(
    256 * 1024, "bytes", "claims", "quarantine", "sender", "record that was not accepted before", "it is cut"
)

ROW_BYTES: Final = 1024
"""Size of a quarantined record in addition to its payload, for the shares."""

# Each statement releases the interpreter lock and waits to get it back: multi-row statements are much faster.
ROWS_PER_STATEMENT = 32

_OUTBOX = "consumer, seq, key, encoding, priority, payload, sha256, created_utc_s, topic, edition, place, origin"
_INBOX = "key, payload, origin, seq, received_utc_s"


class UnitOfWork:
    """Everything that handling one record leads to: records to send, state to change; committed all or nothing.

    Attributes:
        payload: Bytes of the handled record as received; empty if no record caused this unit of work.
        counts: Increments of the health counters.
    """

    def __init__(self, payload: bytes = b"") -> None:
        self.payload = payload
        self.counts: defaultdict[str, int] = defaultdict(int)
        self._writes: list[Callable[[Transaction], object]] = []

    def send(self, key: str, queue: str, record: Record, *, priority: int = 4, topic: Topic | None = None) -> None:
        """Queue a record; see `Transaction.send`."""
        self.send_payload(key, queue, wire.encode(record), type(record), priority=priority, topic=topic)

    def send_payload(
        self,
        key: str,
        queue: str,
        payload: bytes,
        record_type: type[Record],
        *,
        priority: int = 4,
        topic: Topic | None = None,
    ) -> None:
        """Queue an encoded record; fields that this version does not know are preserved."""
        encoding = wire.encoding_of(record_type)
        self._writes.append(lambda tx: tx.send(key, queue, payload, encoding=encoding, priority=priority, topic=topic))

    def put_state(self, name: str, value: bytes) -> None:
        """Store `value` under `name`."""
        self._writes.append(lambda tx: tx.put_state(name, value))

    def put_states(self, prefix: str, values: Mapping[str, bytes | None]) -> None:
        """Store each value under its name below `prefix`; delete the names whose value is None."""
        for name, value in values.items():
            if value is None:
                self.delete_state(prefix + name)
            else:
                self.put_state(prefix + name, value)

    def delete_state(self, name: str) -> None:
        """Delete the value under `name`."""
        self._writes.append(lambda tx: tx.delete_state(name))

    def quarantine(self, key: str, payload: bytes, reason: str) -> None:
        """Store data that cannot be used, with the reason, in the store's `refused` table."""
        self._writes.append(lambda tx: tx.quarantine("in", key, payload, reason))

    def remove_from_inbox(self, item: InboxItem) -> None:
        """Remove the handled record from the inbox."""
        self._writes.append(lambda tx: tx.remove_handled(item))

    def count(self, name: str, by: int = 1) -> None:
        """Increase a health counter when the unit of work is committed."""
        self.counts[name] += by

    def write(self, tx: Transaction) -> None:
        """Write everything into an open transaction."""
        for write in self._writes:
            write(tx)


class Transaction:
    """Writes of one transaction, created by `Store.transaction`.

    New outbox and inbox records and removals are collected and written in multi-row statements: before another
    statement depends on them, or at the end by `flush`.

    Attributes:
        wrote_inbox: Whether a record was added to the inbox and has to be handled.
        numbered_inbox: Whether a record was accepted, and handled or not.
        first_places: Place of the first new record of each queue.
        partial_records: Chunks of records that are not complete yet.
        superseded: Number of queued records that newer editions replaced.
        states_discarded: Number of states that could not be read.
    """

    def __init__(self, connection: sqlite3.Connection, in_flight: Set[tuple[str, int]] = frozenset()) -> None:
        self._db = connection
        self._in_flight = in_flight
        self.wrote_inbox = self.numbered_inbox = False
        self.superseded = self.states_discarded = 0
        self._windows: dict[tuple[str, bytes], DuplicateWindow] = {}
        self._numbers: dict[str, tuple[int, bytes]] = {}
        self._new_outbox: list[tuple[object, ...]] = []
        self._new_topics: set[tuple[str, str]] = set()
        self.first_places: dict[str, Place] = {}
        self._new_inbox: list[tuple[object, ...]] = []
        self.partial_records = PartialRecords(connection)
        self._new_states: list[tuple[str, bytes]] = []
        self._handled: list[int] = []
        self._handled_at_once = 0

    @property
    def assigned(self) -> dict[str, int]:
        """Highest number of each queue in which numbers were assigned."""
        return {queue: seq for queue, (seq, _) in self._numbers.items()}

    def flush(self) -> None:
        """Write the collected changes; `Store.transaction` calls it before the commit."""
        self._flush_outbox()
        if self._new_inbox:
            _insert_rows(self._db, "INTO inbox", _INBOX, self._new_inbox)
            self._new_inbox.clear()
        self._flush_states()
        for first, last in runs(self._handled):
            self._db.execute("DELETE FROM inbox WHERE id BETWEEN ? AND ?", (first, last))
        self._handled.clear()
        if self._handled_at_once:
            # They have numbers as well, by which the watermark shows that their commit was lost.
            sql = "UPDATE sqlite_sequence SET seq = seq + ? WHERE name = 'inbox'"
            if self._db.execute(sql, (self._handled_at_once,)).rowcount == 0:
                self._db.execute("INSERT INTO sqlite_sequence VALUES ('inbox', ?)", (self._handled_at_once,))
            self._handled_at_once = 0
        for window in self._windows.values():
            window.write()

    def _flush_outbox(self) -> None:
        if self._new_outbox:
            _insert_rows(self._db, "INTO outbox", _OUTBOX, self._new_outbox)
            self._write_numbers()
            self._new_outbox.clear()
            self._new_topics.clear()

    def _flush_states(self) -> None:
        if self._new_states:
            _insert_rows(self._db, "OR IGNORE INTO state", "name, value", self._new_states)
            self._new_states.clear()

    def _write_numbers(self) -> None:
        rows = [(queue, *number) for queue, number in self._numbers.items()]
        self._db.executemany("INSERT OR REPLACE INTO outbox_next (consumer, seq, origin) VALUES (?, ?, ?)", rows)

    # Outbox

    def send(
        self, key: str, queue: str, payload: bytes, *, encoding: str, priority: int = 4, topic: Topic | None = None
    ) -> int:
        """Queue a record.

        Args:
            key: Key expression of the record.
            queue: Name of the service that acknowledges it, or of a queue for it (`queue_of`).
            payload: The record's bytes.
            encoding: Zenoh encoding of the payload.
            priority: 1 (first) to 7 (last), as Zenoh's priorities.
            topic: Replaces older editions that are not in flight; the record inherits their position and priority.

        Returns:
            The sequence number, consecutive from 1 in each queue; 0 if the queue already holds a newer edition.
        """
        position = None
        name, edition = ("", 0) if topic is None else (topic.name, topic.edition)
        if name:
            editions = self._editions(queue, name)
            if any(row[1] > edition for row in editions):
                return 0
            position, priority = self._supersede(queue, [row for row in editions if row[1] < edition], priority)
        seq, origin = self._last_number(queue)
        seq += 1
        place = (priority, position or seq)
        self._numbers[queue] = (seq, origin)
        self.first_places[queue] = min(place, self.first_places.get(queue, place))
        digest = hashlib.sha256(payload).digest()
        self._new_outbox.append(
            (queue, seq, key, encoding, priority, payload, digest, time.time(), name, edition, position or seq, origin)
        )
        if name:
            self._new_topics.add((queue, name))
        return seq

    def _last_number(self, queue: str) -> tuple[int, bytes]:
        """Return the last sequence number of a queue and the queue's origin, which is random for a new queue."""
        if queue not in self._numbers:
            row = self._db.execute("SELECT seq, origin FROM outbox_next WHERE consumer = ?", (queue,)).fetchone()
            self._numbers[queue] = (int(row[0]), bytes(row[1])) if row else (0, uuid.uuid4().bytes)
        return self._numbers[queue]

    def renew_origin(self, queue: str) -> None:
        """Assign a new random origin to a queue; records that are already queued keep the present one.

        For a store that was restored from an older copy: it assigns sequence numbers again that its consumer, and
        watchers, have received with other content.
        """
        seq, _ = self._last_number(queue)
        self._flush_outbox()
        self._numbers[queue] = (seq, uuid.uuid4().bytes)
        self._write_numbers()

    def _editions(self, queue: str, topic: str) -> list[tuple[int, int, int, int]]:
        """Return (seq, edition, position, priority) of a topic's records in a queue."""
        if (queue, topic) in self._new_topics:
            self._flush_outbox()
        return self._db.execute(
            "SELECT seq, edition, place, priority FROM outbox WHERE consumer = ? AND topic = ? AND topic <> ''",
            (queue, topic),
        ).fetchall()

    def _supersede(
        self, queue: str, older: Iterable[tuple[int, int, int, int]], priority: int
    ) -> tuple[int | None, int]:
        """Delete older editions; return the first position and the most urgent priority among them."""
        position: int | None = None
        for seq, _, its_position, its_priority in older:
            # An edition in flight is completed: otherwise frequent new editions could block delivery for ever.
            if (queue, seq) in self._in_flight:
                continue
            self.remove_acknowledged(queue, (seq,))
            self.superseded += 1
            position = its_position if position is None else min(position, its_position)
            priority = min(priority, its_priority)
        return position, priority

    def drop_oldest(self, queue: str, max_bytes: int, protected_priority: int) -> int:
        """Drop records until the queue holds at most `max_bytes`: of the vehicle with the most, the least urgent first.

        Records of equal priority are dropped oldest first. Records in flight stay, and so do records of
        `protected_priority` or more urgent.

        Returns:
            Number of dropped records.
        """
        self._flush_outbox()
        stored: list[Stored[int]] = []
        for seq, size_bytes, priority, place, topic in self._db.execute(
            "SELECT seq, LENGTH(payload), priority, place, topic FROM outbox WHERE consumer = ?", (queue,)
        ):
            if priority <= protected_priority or (queue, seq) in self._in_flight:
                max_bytes -= size_bytes
            else:
                vehicle = topic[: topic.find("/") + 1]
                stored.append(Stored(seq, place, size_bytes, -priority, vehicle_source(vehicle)))
        dropped = select_for_removal(stored, 0.0, None, max(0, max_bytes))
        self.remove_acknowledged(queue, sorted(dropped))
        return len(dropped)

    def drop_queue(self, queue: str) -> int:
        """Drop all records of a queue; return their number."""
        self._flush_outbox()
        return self._db.execute("DELETE FROM outbox WHERE consumer = ?", (queue,)).rowcount

    def remove_acknowledged(self, queue: str, numbers: Iterable[int]) -> None:
        """Remove records that the consumer has committed."""
        self._flush_outbox()
        for first, last in runs(numbers):
            self._db.execute("DELETE FROM outbox WHERE consumer = ? AND seq BETWEEN ? AND ?", (queue, first, last))

    def quarantine_refused(self, item: OutboxItem, reason: str) -> None:
        """Move a record that the consumer refused from the outbox to the quarantine."""
        self.quarantine("out", item.key, item.payload, reason, is_accepted=True)
        self.remove_acknowledged(item.queue, (item.seq,))

    # Inbox

    def is_inbox_empty(self) -> bool:
        """Return whether every record that was accepted before this transaction is handled."""
        return self._db.execute("SELECT 1 FROM inbox LIMIT 1").fetchone() is None

    def accept(self, key: str, payload: bytes, chunk: ReceivedChunk | None = None, *, is_handled: bool = False) -> None:
        """Add a record to the inbox.

        Args:
            key: Key expression of the record.
            payload: The complete record.
            chunk: The last chunk of the record, which identifies it; None for a plain publication.
            is_handled: It is handled in this transaction: only its identity is stored.
        """
        origin, seq = (None, None) if chunk is None else (chunk.origin, chunk.seq)
        if chunk is not None:
            self._window(key, chunk.origin).add(chunk.seq, chunk.sha256, chunk.done_up_to)
        self.numbered_inbox = True
        if is_handled:
            self._handled_at_once += 1
            return
        self._new_inbox.append((key, payload, origin, seq, time.time()))
        self.wrote_inbox = True

    def remove_handled(self, item: InboxItem) -> None:
        """Remove a handled record from the inbox."""
        self._handled.append(item.id)

    def quarantine(self, direction: str, key: str, payload: bytes, reason: str, *, is_accepted: bool = False) -> None:
        """Store a record that cannot be handled, with the reason, within the limits of this module.

        Args:
            direction: `in` for a received record, `out` for one that its consumer has refused.
            key: Its key.
            payload: Its bytes.
            reason: Why it cannot be handled.
            is_accepted: Whether no sender has it any more: it is not cut.
        """
        self._db.execute(
            "INSERT INTO refused (direction, key, payload, reason, at_utc_s) VALUES (?, ?, ?, ?, ?)",
            (direction, key, payload if is_accepted else payload[:MAX_QUARANTINED_BYTES], reason, time.time()),
        )
        count, size_bytes = self._db.execute("SELECT COUNT(*), SUM(LENGTH(payload)) FROM refused").fetchone()
        if count <= MAX_QUARANTINED and size_bytes <= MAX_QUARANTINE_BYTES:
            return
        rows: dict[str, list[tuple[int, int]]] = {}
        for number, its_key, its_bytes in self._db.execute("SELECT id, key, LENGTH(payload) FROM refused ORDER BY id"):
            rows.setdefault(writer_of(its_key), []).append((number, its_bytes))
        while count > MAX_QUARANTINED or size_bytes > MAX_QUARANTINE_BYTES:
            largest = max(rows.values(), key=lambda found: sum(its_bytes + ROW_BYTES for _, its_bytes in found))
            number, its_bytes = largest.pop(0)
            self._db.execute("DELETE FROM refused WHERE id = ?", (number,))
            count, size_bytes = count - 1, size_bytes - its_bytes

    def requeue(self, number: int) -> None:
        """Move a quarantined record to the inbox."""
        row = self._db.execute("DELETE FROM refused WHERE id = ? RETURNING key, payload", (number,)).fetchone()
        self.accept(str(row[0]), bytes(row[1]))

    def was_received(self, key: str, chunk: ReceivedChunk) -> bool:
        """Return whether the record of a chunk was accepted before: same key, origin, number and digest."""
        return self._window(key, chunk.origin).contains(chunk.seq, chunk.sha256)

    def accepted_number(self, key: str, chunk: ReceivedChunk) -> tuple[int, bytes]:
        """Return what shows a producer that its store is older than its last delivery.

        Returns:
            The number of the chunk and the digest of another record that was accepted with it; without such a record
            the highest number accepted from this queue on this key, 0 for none, and the digest of its record.
        """
        window = self._window(key, chunk.origin)
        other = window.other_digest(chunk.seq, chunk.sha256)
        return (window.highest, window.highest_sha256) if other is None else (chunk.seq, other)

    def _window(self, key: str, origin: bytes) -> DuplicateWindow:
        window = self._windows.get((key, origin))
        if window is None:
            window = self._windows[key, origin] = DuplicateWindow(self._db, key, origin)
        return window

    # State

    def get_state(self, name: str) -> bytes | None:
        """Return the value under `name`, with the changes of this transaction; None if there is none."""
        self._flush_states()
        found = self._db.execute("SELECT value FROM state WHERE name = ?", (name,)).fetchone()
        return None if found is None else bytes(found[0])

    def state_names(self, prefix: str) -> list[str]:
        """Return the names of all values that start with `prefix`, with the changes of this transaction."""
        self._flush_states()
        found = self._db.execute("SELECT name FROM state WHERE name >= ? AND name < ?", (prefix, prefix + "\U0010ffff"))
        return [str(name) for (name,) in found]

    def add_state(self, name: str, value: bytes) -> None:
        """Store `value` under `name` if there is no value; `Store.get_state` finds it after the transaction."""
        self._new_states.append((name, value))

    def put_state(self, name: str, value: bytes) -> None:
        """Store `value` under `name`."""
        self._flush_states()
        self._db.execute(
            "INSERT INTO state VALUES (?, ?) ON CONFLICT (name) DO UPDATE SET value = excluded.value", (name, value)
        )

    def delete_state(self, name: str) -> None:
        """Delete the value under `name`."""
        self._flush_states()
        self._db.execute("DELETE FROM state WHERE name = ?", (name,))

    def delete_states(self, prefix: str, names: Iterable[str], queue: str = "") -> None:
        """Delete the values under `prefix` and each name, except where the name is a topic of a record in `queue`."""
        self._flush_states()
        self._flush_outbox()
        self._db.executemany(
            "DELETE FROM state WHERE name = ? AND NOT EXISTS"
            " (SELECT 1 FROM outbox WHERE consumer = ? AND topic = ? AND topic <> '')",
            [(prefix + name, queue, name) for name in names],
        )

    def discard_state(self, name: str, value: bytes, reason: str) -> None:
        """Move a value that cannot be read from `name` to the quarantine."""
        log.error("Stored state discarded: it cannot be read", extra=kv(state=name, reason=reason))
        self.quarantine("in", f"state {name}", value, reason)
        self._flush_states()
        self._db.execute("DELETE FROM state WHERE name = ? AND value = ?", (name, value))
        self.states_discarded += 1


@cache
def _insert_statement(into: str, columns: str, values: int, rows: int) -> str:
    row = "(" + ", ".join("?" * values) + ")"
    return f"INSERT {into} ({columns}) VALUES {', '.join([row] * rows)}"  # noqa: S608 constants


def _insert_rows(db: sqlite3.Connection, into: str, columns: str, rows: Sequence[tuple[object, ...]]) -> None:
    for first in range(0, len(rows), ROWS_PER_STATEMENT):
        part = rows[first : first + ROWS_PER_STATEMENT]
        if len(part) < ROWS_PER_STATEMENT:
            db.executemany(_insert_statement(into, columns, len(part[0]), 1), part)
        else:
            statement = _insert_statement(into, columns, len(part[0]), len(part))
            db.execute(statement, tuple(chain.from_iterable(part)))


def runs(numbers: Iterable[int]) -> Iterator[tuple[int, int]]:
    """Yield the runs of consecutive numbers as (first, last), in ascending order."""
    first: int | None = None
    last = 0
    for number in sorted(numbers):
        if first is not None and number == last + 1:
            last = number
            continue
        if first is not None:
            yield first, last
        first = last = number
    if first is not None:
        yield first, last
