"""Chunks of records that are not complete yet.

The chunks of a record belong to (key, origin, sequence number, digest), so that no other record can replace them. They
are temporary: they expire, and their number and size are limited for each writer (`keys.writer_of`) and in total.
"""

from __future__ import annotations

import hashlib
import sqlite3
import time
from collections import Counter
from collections.abc import Sequence
from typing import Literal

from sonarpost.delivery.records import ReceivedChunk
from sonarpost.keys import writer_of

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
