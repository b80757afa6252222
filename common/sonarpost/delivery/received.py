"""What a consumer has received: the digests of accepted records, and the chunks of records that are not complete yet.

A record is a duplicate only if key, origin, sequence number **and** digest were accepted before. The same number with
another digest is a new record: a producer whose store was restored from an older copy assigns numbers again.

A window belongs to one key. Access control of the router decides which peer may write to a key, so that no peer can
change the window of another one. A window is read once in a transaction and written once at its end.

The chunks of a record belong to (key, origin, sequence number, digest), so that no other record can replace them. They
are temporary: they expire, and their number and size are limited for each writer (`keys.writer_of`) and in total.
"""

from __future__ import annotations

import hashlib
import sqlite3
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Literal

from sonarpost.delivery.records import ReceivedChunk
from sonarpost.keys import writer_of

KEPT_DIGESTS = 65_536
"""Numbers below this distance from the highest one are deleted after the producer has stated that it holds none."""
MAX_DIGESTS = 1_000_000
"""Maximum number of digests in a window; beyond it the lower half of the numbers is deleted."""
MAX_WINDOWS = 1024
"""Maximum number of windows of one writer (`keys.writer_of`); the least recently used one is deleted."""
PRUNE_EVERY = 4096
"""Number of added records after which a window is checked for digests to delete."""


class DuplicateWindow:
    """Accepted records of one origin on one key.

    Args:
        connection: Connection with an open transaction.
        key: Key expression of the records.
        origin: Identity of the producer's queue, 16 bytes.

    Attributes:
        highest: Highest accepted sequence number, 0 before the first record.
        highest_sha256: Digest of the record that had this number last.
    """

    def __init__(self, connection: sqlite3.Connection, key: str, origin: bytes) -> None:
        self._db = connection
        self._key = key
        self._origin = origin
        row = connection.execute(
            "SELECT id, highest, sha256, digests FROM received_window WHERE key = ? AND origin = ?", (key, origin)
        ).fetchone()
        self._id: int | None = None
        self.highest = 0
        self.highest_sha256 = b""
        self._digests = 0
        if row is not None:
            self._id, self.highest, self.highest_sha256, self._digests = row
        self._stored_highest = self.highest
        self._done_up_to = 0
        self._new: defaultdict[int, set[bytes]] = defaultdict(set)

    def contains(self, seq: int, sha256: bytes) -> bool:
        """Return whether a record with this number and digest was accepted."""
        if seq in self._new and sha256 in self._new[seq]:
            return True
        if self._id is None or seq > self._stored_highest:
            return False
        found = self._db.execute(
            "SELECT 1 FROM received WHERE window = ? AND seq = ? AND sha256 = ?", (self._id, seq, sha256)
        ).fetchone()
        return found is not None

    def other_digest(self, seq: int, sha256: bytes) -> bytes | None:
        """Return the digest of another accepted record with this number, or None."""
        if self._id is None or seq > self._stored_highest:
            return None
        found = self._db.execute(
            "SELECT sha256 FROM received WHERE window = ? AND seq = ? AND sha256 <> ?", (self._id, seq, sha256)
        ).fetchone()
        return None if found is None else bytes(found[0])

    def add(self, seq: int, sha256: bytes, done_up_to: int = 0) -> None:
        """Add an accepted record.

        Args:
            seq: Its sequence number.
            sha256: Its digest.
            done_up_to: The producer states that it no longer holds this number and all below it. It only permits to
                delete old digests; it never marks a number as received.
        """
        self._new[seq].add(sha256)
        self._done_up_to = max(self._done_up_to, done_up_to)
        if seq >= self.highest:
            self.highest, self.highest_sha256 = seq, sha256

    def write(self) -> None:
        """Write the added records; called before the transaction is committed."""
        if not self._new:
            return
        rows = [(seq, digest) for seq, digests in sorted(self._new.items()) for digest in digests]
        self._new.clear()
        before, self._digests = self._digests, self._digests + len(rows)
        values = (self.highest, self.highest_sha256, self._digests, time.time_ns())
        if self._id is None or not self._update(values):
            self._id = self._create(values)
        self._db.executemany("INSERT INTO received VALUES (?, ?, ?)", [(self._id, *row) for row in rows])
        self._stored_highest = self.highest
        if before // PRUNE_EVERY != self._digests // PRUNE_EVERY:
            self._prune()

    def _update(self, values: tuple[int, bytes, int, int]) -> bool:
        """Update the row of the window; return False if a new window of the same transaction has displaced it."""
        updated = self._db.execute(
            "UPDATE received_window SET highest = ?, sha256 = ?, digests = ?, used_ns = ? WHERE id = ?",
            (*values, self._id),
        )
        return updated.rowcount == 1

    def _create(self, values: tuple[int, bytes, int, int]) -> int:
        writer = writer_of(self._key)
        inserted = self._db.execute(
            "INSERT INTO received_window (key, origin, writer, highest, sha256, digests, used_ns)"
            " VALUES (?, ?, ?, ?, ?, ?, ?)",
            (self._key, self._origin, writer, *values),
        )
        self._db.execute(
            "DELETE FROM received_window WHERE writer = ? AND id NOT IN"
            " (SELECT id FROM received_window WHERE writer = ? ORDER BY used_ns DESC, id DESC LIMIT ?)",
            (writer, writer, MAX_WINDOWS),
        )
        return int(inserted.lastrowid or 0)

    def _prune(self) -> None:
        delete_up_to = min(self._done_up_to, self.highest - KEPT_DIGESTS)
        if self._digests > MAX_DIGESTS:
            (median,) = self._db.execute(
                "SELECT seq FROM received WHERE window = ? ORDER BY seq LIMIT 1 OFFSET ?",
                (self._id, self._digests // 2),
            ).fetchone() or (0,)
            delete_up_to = max(delete_up_to, int(median))
        if delete_up_to > 0:
            deleted = self._db.execute("DELETE FROM received WHERE window = ? AND seq <= ?", (self._id, delete_up_to))
            self._digests -= deleted.rowcount
            self._db.execute("UPDATE received_window SET digests = ? WHERE id = ?", (self._digests, self._id))


EXPIRE_AFTER_S = 86_400
"""Time after the last chunk at which an incomplete record is deleted: longer than the outage of a slow link."""
MAX_WRITER_RECORDS, MAX_WRITER_BYTES = 16, 16 * 1024 * 1024
"""Limits for one writer."""
MAX_RECORDS, MAX_BYTES = 256, 256 * 1024 * 1024
"""Limits for a store."""

_Row = tuple[int, str, bytes, int]
"""Number of the row, writer, origin, received bytes."""
WRITER_COLUMN: Literal[1] = 1
ORIGIN_COLUMN: Literal[2] = 2


class PartialRecords:
    """Incomplete records of a store.

    Args:
        connection: Connection with an open transaction.
    """

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._db = connection
        self._rows_known: bool | None = None

    def add(self, key: str, chunk: ReceivedChunk) -> bytes | int:
        """Add a chunk of a record.

        A chunk that does not follow the stored ones is not stored. A transfer therefore resumes after a restart of
        either side. If the complete record does not match its digest, its chunks are deleted.

        Returns:
            The complete record, or the next offset to send. A record in a single chunk is returned unchecked.
        """
        if chunk.offset == 0 and len(chunk.data) == chunk.size:
            if self._has_rows() and hashlib.sha256(chunk.data).digest() == chunk.sha256:
                self._db.execute(
                    "DELETE FROM partial WHERE key = ? AND origin = ? AND seq = ? AND sha256 = ?",
                    (key, chunk.origin, chunk.seq, chunk.sha256),
                )
            return chunk.data
        partial_id, received = self._find(key, chunk)
        if chunk.offset != received:
            return received
        received += len(chunk.data)
        if received < chunk.size:
            self._db.execute("INSERT INTO partial_piece VALUES (?, ?, ?)", (partial_id, chunk.offset, chunk.data))
            self._db.execute("UPDATE partial SET has = ? WHERE id = ?", (received, partial_id))
            self._apply_limits(partial_id, key)
            return received
        chunks = self._db.execute(
            "SELECT data FROM partial_piece WHERE partial = ? ORDER BY start", (partial_id,)
        ).fetchall()
        self._delete(partial_id)
        payload = b"".join(bytes(row[0]) for row in chunks) + chunk.data
        return payload if hashlib.sha256(payload).digest() == chunk.sha256 else 0

    def _has_rows(self) -> bool:
        """Return whether the store had incomplete records at the first call in the transaction, or has got some."""
        if self._rows_known is None:
            (found,) = self._db.execute("SELECT EXISTS (SELECT 1 FROM partial)").fetchone()
            self._rows_known = bool(found)
        return self._rows_known

    def _find(self, key: str, chunk: ReceivedChunk) -> tuple[int, int]:
        """Return (id, received bytes) of an incomplete record, which is created if it is not stored."""
        now_ns = time.time_ns()
        which = (key, chunk.origin, chunk.seq, chunk.sha256)
        row = self._db.execute(
            "SELECT id, has FROM partial WHERE key = ? AND origin = ? AND seq = ? AND sha256 = ?", which
        ).fetchone()
        if row is not None:
            self._db.execute("UPDATE partial SET touched_ns = ? WHERE id = ?", (now_ns, row[0]))
            return int(row[0]), int(row[1])
        self._db.execute("DELETE FROM partial WHERE touched_ns < ?", (now_ns - EXPIRE_AFTER_S * 1_000_000_000,))
        self._rows_known = True
        inserted = self._db.execute(
            "INSERT INTO partial (key, origin, seq, sha256, writer, has, touched_ns) VALUES (?, ?, ?, ?, ?, 0, ?)",
            (*which, writer_of(key), now_ns),
        )
        partial_id = int(inserted.lastrowid or 0)
        self._apply_limits(partial_id, key)
        return partial_id, 0

    def _apply_limits(self, current: int, key: str) -> None:
        """Delete the oldest records of the largest origin: of the writer of `key`, then of the largest writer."""
        writer = writer_of(key)
        rows: list[_Row] = self._db.execute(
            "SELECT id, writer, origin, has FROM partial ORDER BY touched_ns, id"
        ).fetchall()
        while True:
            of_writer = [row for row in rows if row[1] == writer]
            if _exceeds(of_writer, MAX_WRITER_RECORDS, MAX_WRITER_BYTES):
                candidates = of_writer
            elif _exceeds(rows, MAX_RECORDS, MAX_BYTES):
                candidates = _largest_group(rows, WRITER_COLUMN)
            else:
                return
            candidates = _largest_group(candidates, ORIGIN_COLUMN)
            # The record in progress goes last: deleting it first would block a transfer for ever.
            oldest = next((row for row in candidates if row[0] != current), candidates[0])
            self._delete(oldest[0])
            rows.remove(oldest)

    def reclaim(self) -> int:
        """Delete the incomplete records of the writer with the most bytes; return the number of bytes."""
        rows = self._db.execute("SELECT writer, SUM(has) FROM partial GROUP BY writer").fetchall()
        if not rows:
            return 0
        writer, size_bytes = max(rows, key=lambda row: int(row[1]))
        self._db.execute("DELETE FROM partial WHERE writer = ?", (writer,))
        return int(size_bytes)

    def _delete(self, partial_id: int) -> None:
        self._db.execute("DELETE FROM partial WHERE id = ?", (partial_id,))


def _exceeds(rows: Sequence[_Row], max_records: int, max_bytes: int) -> bool:
    return len(rows) > max_records or sum(row[3] for row in rows) > max_bytes


def _largest_group(rows: Sequence[_Row], column: Literal[1, 2]) -> list[_Row]:
    """Return the rows of the writer or origin that holds the most bytes."""
    sizes = Counter[str | bytes]()
    for row in rows:
        sizes[row[column]] += row[3] + 1  # counts records without bytes as well
    largest = sizes.most_common(1)[0][0]
    return [row for row in rows if row[column] == largest]
