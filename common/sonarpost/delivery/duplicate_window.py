"""Records that were accepted from one producer queue on one key, with their digests.

A record is a duplicate only if key, origin, sequence number **and** digest were accepted before. The same number with
another digest is a new record: a producer whose store was restored from an older copy assigns numbers again.

A window belongs to one key. Access control of the router decides which peer may write to a key, so that no peer can
change the window of another one. A window is read once in a transaction and written once at its end.
"""

from __future__ import annotations

import sqlite3
import time
from collections import defaultdict

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
