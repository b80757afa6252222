"""The writes of one transaction on a service's store, and the records that go in and out of it."""

from __future__ import annotations

import hashlib
import sqlite3
import time
from collections.abc import Iterable, Set

from sonarpost.delivery import rows
from sonarpost.delivery.duplicate_window import DuplicateWindow
from sonarpost.delivery.items import QUEUE_MARK, InboxItem, OutboxItem, ReceivedChunk, Topic, consumer_of, queue_of

__all__ = ["QUEUE_MARK", "InboxItem", "OutboxItem", "ReceivedChunk", "Topic", "Transaction", "consumer_of", "queue_of"]

# Bounds on what strangers can make a store keep: whatever is beyond them, the oldest goes.
REFUSED_KEPT = 1000
REFUSED_BYTES = 256 * 1024
PARTIALS_KEPT = 64

_OUTBOX = "consumer, seq, key, encoding, priority, payload, sha256, created_utc_s, topic, edition, place"
_INBOX = "key, payload, origin, seq, received_utc_s"


class Transaction:
    """The writes of one transaction; made by `Store.transaction`, atomic with everything else in it.

    New records, and the ends of old ones, are collected and written together: before they matter to another statement,
    or by `flush` at the end.
    """

    def __init__(self, connection: sqlite3.Connection, begun: Set[tuple[str, int]] = frozenset()) -> None:
        self._db = connection
        self._begun = begun
        self.wrote_outbox = False
        self.wrote_inbox = False
        self.superseded = 0
        self._seen: dict[bytes, DuplicateWindow] = {}
        self._numbers: dict[str, int] = {}
        self._new_outbox: list[tuple[object, ...]] = []
        self._new_topics: set[tuple[str, str]] = set()
        self._new_inbox: list[tuple[object, ...]] = []
        self._done: list[int] = []

    def flush(self) -> None:
        """Write what was collected; `Store.transaction` does before it commits."""
        self._flush_outbox()
        if self._new_inbox:
            rows.insert(self._db, "inbox", _INBOX, self._new_inbox)
            self._new_inbox.clear()
        for first, last in rows.runs(self._done):
            self._db.execute("DELETE FROM inbox WHERE id BETWEEN ? AND ?", (first, last))
        self._done.clear()
        for seen in self._seen.values():
            seen.write()

    def _flush_outbox(self) -> None:
        if self._new_outbox:
            rows.insert(self._db, "outbox", _OUTBOX, self._new_outbox)
            self._db.executemany("INSERT OR REPLACE INTO outbox_next VALUES (?, ?)", self._numbers.items())
            self._new_outbox.clear()
            self._new_topics.clear()

    def send(
        self, key: str, consumer: str, payload: bytes, *, encoding: str, priority: int = 4, topic: Topic | None = None
    ) -> int:
        """Owe `payload` to `consumer` under `key`; return its sequence number (from 1, one after the other, a queue).

        Args:
            key: Key expression the record is published on.
            consumer: Name of the service that acknowledges it, or of a queue for it (`queue_of`).
            payload: The record's bytes.
            encoding: Zenoh encoding of the payload.
            priority: 1 (first) to 7 (last), as Zenoh's priorities.
            topic: Older editions in the queue whose transfer has not begun are dropped, and their place and priority
                are this one's; where the queue has a newer edition, nothing is queued and 0 is returned.
        """
        place = None
        name, edition = ("", 0) if topic is None else (topic.name, topic.edition)
        if name:
            others = self._editions(consumer, name)
            if any(row[1] > edition for row in others):
                return 0
            place, priority = self._supersede(consumer, [row for row in others if row[1] < edition], priority)
        seq = self._next_number(consumer)
        digest = hashlib.sha256(payload).digest()
        self._new_outbox.append(
            (consumer, seq, key, encoding, priority, payload, digest, time.time(), name, edition, place or seq)
        )
        if name:
            self._new_topics.add((consumer, name))
        self.wrote_outbox = True
        return seq

    def _next_number(self, queue: str) -> int:
        if queue not in self._numbers:
            row = self._db.execute("SELECT seq FROM outbox_next WHERE consumer = ?", (queue,)).fetchone()
            self._numbers[queue] = int(row[0]) if row else 0
        self._numbers[queue] += 1
        return self._numbers[queue]

    def _editions(self, queue: str, topic: str) -> list[tuple[int, int, int, int]]:
        """Return seq, edition, place and priority of what the queue has of a topic."""
        if (queue, topic) in self._new_topics:
            self._flush_outbox()
        return self._db.execute(
            "SELECT seq, edition, place, priority FROM outbox WHERE consumer = ? AND topic = ? AND topic <> ''",
            (queue, topic),
        ).fetchall()

    def _supersede(
        self, queue: str, older: Iterable[tuple[int, int, int, int]], priority: int
    ) -> tuple[int | None, int]:
        """Drop older editions that have not begun; return the first place and the most urgent priority among them."""
        place: int | None = None
        for seq, _, its_place, its_priority in older:
            # One on its way arrives: were it stopped for each newer one, nothing might ever arrive.
            if (queue, seq) in self._begun:
                continue
            self.acknowledged(queue, seq)
            self.superseded += 1
            place = its_place if place is None else min(place, its_place)
            priority = min(priority, its_priority)
        return place, priority

    def drop_oldest(self, queue: str, max_bytes: int, above_priority: int) -> int:
        """Drop records until the queue holds `max_bytes`, the least urgent first, then the oldest; return how many.

        What is as urgent as `above_priority` or more stays, and so does what is on its way.
        """
        self._flush_outbox()
        total = int(
            self._db.execute(
                "SELECT COALESCE(SUM(LENGTH(payload)), 0) FROM outbox WHERE consumer = ?", (queue,)
            ).fetchone()[0]
        )
        dropped = 0
        found = self._db.execute(
            "SELECT seq, LENGTH(payload) FROM outbox WHERE consumer = ? AND priority > ? ORDER BY priority DESC, place",
            (queue, above_priority),
        ).fetchall()
        for seq, size in found:
            if total <= max_bytes:
                break
            if (queue, seq) not in self._begun:
                self.acknowledged(queue, seq)
                total -= size
                dropped += 1
        return dropped

    def drop_queue(self, queue: str) -> int:
        """Drop everything a queue holds; return how many records that were."""
        self._flush_outbox()
        return self._db.execute("DELETE FROM outbox WHERE consumer = ?", (queue,)).rowcount

    def acknowledged(self, consumer: str, seq: int) -> None:
        """Forget what the consumer has committed."""
        self.all_acknowledged(consumer, (seq,))

    def all_acknowledged(self, consumer: str, numbers: Iterable[int]) -> None:
        """Forget several records that the consumer has committed."""
        self._flush_outbox()
        for first, last in rows.runs(numbers):
            self._db.execute("DELETE FROM outbox WHERE consumer = ? AND seq BETWEEN ? AND ?", (consumer, first, last))

    def rejected(self, item: OutboxItem, reason: str) -> None:
        """Keep what the consumer refused apart, where a person can find it."""
        self.quarantine("out", item.key, item.payload, reason)
        self.acknowledged(item.consumer, item.seq)

    def accept(self, key: str, payload: bytes, origin: bytes | None = None, seq: int | None = None) -> bool:
        """Put a record into the inbox; False when (origin, seq) was accepted before."""
        if origin is not None and seq is not None and not self._first_time(origin, seq):
            return False
        self._new_inbox.append((key, payload, origin, seq, time.time()))
        self.wrote_inbox = True
        return True

    def done(self, item: InboxItem) -> None:
        """Remove a handled record from the inbox."""
        self._done.append(item.id)

    def quarantine(self, direction: str, key: str, payload: bytes, reason: str) -> None:
        """Keep a record that cannot be handled, with the reason: the latest 1000, of each at most 256 kB."""
        row = self._db.execute(
            "INSERT INTO refused (direction, key, payload, reason, at_utc_s) VALUES (?, ?, ?, ?, ?) RETURNING id",
            (direction, key, payload[:REFUSED_BYTES], reason, time.time()),
        ).fetchone()
        self._db.execute("DELETE FROM refused WHERE id <= ?", (int(row[0]) - REFUSED_KEPT,))

    def mark_refused(self, origin: bytes, seq: int) -> None:
        """Remember that (origin, seq) was refused, so that the same is answered when it is asked again."""
        if self._first_time(origin, seq):
            self._seen_of(origin).refuse(seq)

    def was_refused(self, origin: bytes, seq: int) -> bool:
        """Tell whether (origin, seq) was refused before."""
        return self._seen_of(origin).was_refused(seq)

    def was_seen(self, origin: bytes, seq: int) -> bool:
        """Tell whether (origin, seq) was accepted before."""
        return self._seen_of(origin).has(seq)

    def settle_upto(self, origin: bytes, seq: int) -> None:
        """Remember that the producer is done with all up to `seq`: what it dropped leaves gaps in its numbers."""
        self._seen_of(origin).settle_upto(seq)

    def _seen_of(self, origin: bytes) -> DuplicateWindow:
        seen = self._seen.get(origin)
        if seen is None:
            seen = self._seen[origin] = DuplicateWindow(self._db, origin)
        return seen

    def _first_time(self, origin: bytes, seq: int) -> bool:
        seen = self._seen_of(origin)
        if seen.has(seq):
            return False
        seen.add(seq)
        self._forget_pieces(origin, seq)
        return True

    def add_chunk(self, chunk: ReceivedChunk) -> bytes | int:
        """Add one chunk of a large record; return the whole record's bytes, or the offset wanted next.

        A chunk that does not continue what is there is not stored: the returned offset says where to go on, which
        makes a transfer resumable over restarts of either side. Pieces that do not add up to their sha256 are
        forgotten and wanted again from 0; a record in one piece is returned as it is, for the caller to check.
        """
        if chunk.offset == 0 and len(chunk.data) == chunk.size:
            self._forget_pieces(chunk.origin, chunk.seq)
            return chunk.data
        number, has = self._partial(chunk)
        if chunk.offset != has:
            return has
        has += len(chunk.data)
        if has < chunk.size:
            self._db.execute("INSERT INTO partial_piece VALUES (?, ?, ?)", (number, chunk.offset, chunk.data))
            self._db.execute("UPDATE partial SET has = ? WHERE id = ?", (has, number))
            return has
        pieces = self._db.execute(
            "SELECT data FROM partial_piece WHERE partial = ? ORDER BY start", (number,)
        ).fetchall()
        self._forget_pieces(chunk.origin, chunk.seq)
        whole = b"".join(bytes(row[0]) for row in pieces) + chunk.data
        return whole if hashlib.sha256(whole).digest() == chunk.sha256 else 0

    def _partial(self, chunk: ReceivedChunk) -> tuple[int, int]:
        """Return number and length of what is there of a record, begun anew where it is of another content."""
        which = (chunk.origin, chunk.seq)
        row = self._db.execute(
            "SELECT id, has, size, sha256 FROM partial WHERE origin = ? AND seq = ?", which
        ).fetchone()
        if row is not None and (row[2], row[3]) == (chunk.size, chunk.sha256):
            self._db.execute("UPDATE partial SET touched_ns = ? WHERE id = ?", (time.time_ns(), row[0]))
            return int(row[0]), int(row[1])
        self._forget_pieces(*which)
        self._seen_of(chunk.origin).has_pieces = True
        inserted = self._db.execute(
            "INSERT INTO partial (origin, seq, size, sha256, has, touched_ns) VALUES (?, ?, ?, ?, 0, ?)",
            (*which, chunk.size, chunk.sha256, time.time_ns()),
        )
        self._db.execute(
            "DELETE FROM partial WHERE id NOT IN (SELECT id FROM partial ORDER BY touched_ns DESC, id DESC LIMIT ?)",
            (PARTIALS_KEPT,),
        )
        return int(inserted.lastrowid or 0), 0

    def _forget_pieces(self, origin: bytes, seq: int) -> None:
        if self._seen_of(origin).has_pieces:
            self._db.execute("DELETE FROM partial WHERE origin = ? AND seq = ?", (origin, seq))

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
