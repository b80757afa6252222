"""The writes of one transaction on a service's store, and the records that go in and out of it."""

from __future__ import annotations

import hashlib
import sqlite3
import time
from collections.abc import Set
from dataclasses import dataclass, field

# Bounds on what strangers can make a store keep: whatever is beyond them, the oldest goes.
REFUSED_KEPT = 1000
REFUSED_BYTES = 256 * 1024
PARTIALS_KEPT = 64


QUEUE_MARK = "@"


def queue_of(consumer: str, place: str) -> str:
    """Return the name of the queue for a consumer that is on several platforms, for example `c2@shore-2`.

    Queues know nothing of each other: each has numbers and an origin of its own, and one that is not answered holds no
    other back.
    """
    return f"{consumer}{QUEUE_MARK}{place}"


def consumer_of(queue: str) -> str:
    """Return the name by which a queue's consumer answers."""
    return queue.partition(QUEUE_MARK)[0]


@dataclass(frozen=True, slots=True)
class Topic:
    """What a record is an edition of: in a queue, a newer edition takes the place of older ones that have not begun."""

    name: str
    edition: int


@dataclass(frozen=True, slots=True)
class OutboxItem:
    """A record that its consumer has not acknowledged yet; `consumer` is the name of the queue."""

    consumer: str
    seq: int
    key: str
    encoding: str
    priority: int
    payload: bytes
    sha256: bytes
    place: int = field(default=0, compare=False)
    created_utc_s: float = field(default=0.0, compare=False)


@dataclass(frozen=True, slots=True)
class Chunk:
    """A piece of a record on its way, as the hand-over query carries it."""

    origin: bytes
    seq: int
    size: int
    sha256: bytes
    offset: int
    data: bytes
    settled: int = 0


@dataclass(frozen=True, slots=True)
class InboxItem:
    """A record that was accepted and not yet handled."""

    id: int
    key: str
    payload: bytes


class Transaction:
    """The writes of one transaction; made by `Store.transaction`, atomic with everything else in it."""

    def __init__(self, connection: sqlite3.Connection, begun: Set[tuple[str, int]] = frozenset()) -> None:
        self._db = connection
        self._begun = begun
        self.wrote_outbox = False
        self.wrote_inbox = False
        self.superseded = 0

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
        if topic is not None:
            if self._has_newer(consumer, topic):
                return 0
            place, priority = self._supersede(consumer, topic, priority)
        row = self._db.execute(
            "INSERT INTO outbox_next VALUES (?, 1) ON CONFLICT (consumer) DO UPDATE SET seq = seq + 1 RETURNING seq",
            (consumer,),
        ).fetchone()
        seq = int(row[0])
        named = ("", 0) if topic is None else (topic.name, topic.edition)
        digest = hashlib.sha256(payload).digest()
        self._db.execute(
            "INSERT INTO outbox (consumer, seq, key, encoding, priority, payload, sha256, created_utc_s,"
            " topic, edition, place) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (consumer, seq, key, encoding, priority, payload, digest, time.time(), *named, place or seq),
        )
        self.wrote_outbox = True
        return seq

    def _has_newer(self, queue: str, topic: Topic) -> bool:
        found = self._db.execute(
            "SELECT 1 FROM outbox WHERE consumer = ? AND topic = ? AND topic <> '' AND edition > ? LIMIT 1",
            (queue, topic.name, topic.edition),
        ).fetchone()
        return found is not None

    def _supersede(self, queue: str, topic: Topic, priority: int) -> tuple[int | None, int]:
        """Drop older editions that have not begun; return the first place and the most urgent priority among them."""
        rows = self._db.execute(
            "SELECT seq, place, priority FROM outbox WHERE consumer = ? AND topic = ? AND topic <> '' AND edition < ?",
            (queue, topic.name, topic.edition),
        ).fetchall()
        place: int | None = None
        for seq, its_place, its_priority in rows:
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
        total = int(
            self._db.execute(
                "SELECT COALESCE(SUM(LENGTH(payload)), 0) FROM outbox WHERE consumer = ?", (queue,)
            ).fetchone()[0]
        )
        dropped = 0
        rows = self._db.execute(
            "SELECT seq, LENGTH(payload) FROM outbox WHERE consumer = ? AND priority > ? ORDER BY priority DESC, place",
            (queue, above_priority),
        ).fetchall()
        for seq, size in rows:
            if total <= max_bytes:
                break
            if (queue, seq) not in self._begun:
                self.acknowledged(queue, seq)
                total -= size
                dropped += 1
        return dropped

    def drop_queue(self, queue: str) -> int:
        """Drop everything a queue holds; return how many records that were."""
        return self._db.execute("DELETE FROM outbox WHERE consumer = ?", (queue,)).rowcount

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

    def mark_refused(self, origin: bytes, seq: int) -> None:
        """Remember that (origin, seq) was refused, so that the same is answered when it is asked again."""
        if self._first_time(origin, seq):
            self._db.execute("INSERT INTO refused_before VALUES (?, ?)", (origin, seq))

    def was_refused(self, origin: bytes, seq: int) -> bool:
        """Tell whether (origin, seq) was refused before."""
        found = self._db.execute("SELECT 1 FROM refused_before WHERE origin = ? AND seq = ?", (origin, seq)).fetchone()
        return found is not None

    def _first_time(self, origin: bytes, seq: int) -> bool:
        if self.was_seen(origin, seq):
            return False
        self._db.execute("INSERT INTO seen VALUES (?, ?)", (origin, seq))
        self._forget_pieces(origin, seq)
        self._compact(origin)
        return True

    def was_seen(self, origin: bytes, seq: int) -> bool:
        """Tell whether (origin, seq) was accepted before."""
        if seq <= self._watermark(origin):
            return True
        return self._db.execute("SELECT 1 FROM seen WHERE origin = ? AND seq = ?", (origin, seq)).fetchone() is not None

    def settle_upto(self, origin: bytes, seq: int) -> None:
        """Remember that the producer is done with all up to `seq`: what it dropped leaves gaps in its numbers."""
        if seq <= self._watermark(origin):
            return
        self._db.execute("INSERT OR REPLACE INTO seen_upto VALUES (?, ?)", (origin, seq))
        for table in ("seen", "refused_before", "partial"):
            self._db.execute(f"DELETE FROM {table} WHERE origin = ? AND seq <= ?", (origin, seq))  # noqa: S608 constants
        self._compact(origin)

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

    def _partial(self, chunk: Chunk) -> tuple[int, int]:
        """Return number and length of what is there of a record, begun anew where it is of another content."""
        which = (chunk.origin, chunk.seq)
        row = self._db.execute(
            "SELECT id, has, size, sha256 FROM partial WHERE origin = ? AND seq = ?", which
        ).fetchone()
        if row is not None and (row[2], row[3]) == (chunk.size, chunk.sha256):
            self._db.execute("UPDATE partial SET touched_ns = ? WHERE id = ?", (time.time_ns(), row[0]))
            return int(row[0]), int(row[1])
        self._forget_pieces(*which)
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
