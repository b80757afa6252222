"""Record of the sequence numbers that were already received from one producer queue.

The window holds one number up to which everything is known, and single numbers above it that arrived out of order. It
is read once in a transaction and written once at its end, so that a batch of records costs no statement for each.
"""

from __future__ import annotations

import sqlite3


class DuplicateWindow:
    """Sequence numbers of one origin that were accepted or refused.

    Args:
        connection: Connection with an open transaction.
        origin: Identity of the producer's queue, 16 bytes.
    """

    def __init__(self, connection: sqlite3.Connection, origin: bytes) -> None:
        self._db = connection
        self._origin = origin
        upto, above, refused, chunks = connection.execute(
            "SELECT COALESCE((SELECT seq FROM seen_upto WHERE origin = ?1), 0),"
            " EXISTS (SELECT 1 FROM seen WHERE origin = ?1), EXISTS (SELECT 1 FROM refused_before WHERE origin = ?1),"
            " EXISTS (SELECT 1 FROM partial WHERE origin = ?1)",
            (origin,),
        ).fetchone()
        self._upto = self._stored_upto = int(upto)
        self._has_above = bool(above)
        self._has_refused = bool(refused)
        self.has_chunks = bool(chunks)
        """Whether the store can hold chunks of an incomplete record of this origin."""
        self._new: set[int] = set()

    def __contains__(self, seq: int) -> bool:
        return seq <= self._upto or seq in self._new or (self._has_above and self._is_stored(seq))

    def _is_stored(self, seq: int) -> bool:
        row = self._db.execute("SELECT 1 FROM seen WHERE origin = ? AND seq = ?", (self._origin, seq)).fetchone()
        return row is not None

    def add(self, seq: int) -> None:
        """Add a number."""
        if seq == self._upto + 1:
            self._upto = seq
            self._extend()
        elif seq not in self:
            self._new.add(seq)

    def _extend(self) -> None:
        """Move the lower edge over the known numbers that follow it, so that the window stays small."""
        while True:
            following = self._upto + 1
            if following in self._new:
                self._new.discard(following)
            elif not (self._has_above and self._is_stored(following)):
                return
            self._upto = following

    def advance(self, seq: int) -> None:
        """Add all numbers up to `seq`: the producer no longer holds them, sent or dropped."""
        if seq <= self._upto:
            return
        self._upto = seq
        self._new = {number for number in self._new if number > seq}
        for table, has_rows in (("refused_before", self._has_refused), ("partial", self.has_chunks)):
            if has_rows:
                sql = f"DELETE FROM {table} WHERE origin = ? AND seq <= ?"  # noqa: S608 constants
                self._db.execute(sql, (self._origin, seq))
        self._extend()

    def mark_refused(self, seq: int) -> None:
        """Store that a number was refused."""
        self._has_refused = True
        self._db.execute("INSERT INTO refused_before VALUES (?, ?)", (self._origin, seq))

    def was_refused(self, seq: int) -> bool:
        """Return whether a number was refused."""
        if not self._has_refused:
            return False
        sql = "SELECT 1 FROM refused_before WHERE origin = ? AND seq = ?"
        return self._db.execute(sql, (self._origin, seq)).fetchone() is not None

    def write(self) -> None:
        """Write the changes; called before the transaction is committed."""
        if self._upto > self._stored_upto:
            self._db.execute("INSERT OR REPLACE INTO seen_upto VALUES (?, ?)", (self._origin, self._upto))
            self._stored_upto = self._upto
            if self._has_above:
                self._db.execute("DELETE FROM seen WHERE origin = ? AND seq <= ?", (self._origin, self._upto))
        if self._new:
            self._db.executemany("INSERT INTO seen VALUES (?, ?)", [(self._origin, seq) for seq in sorted(self._new)])
            self._has_above = True
            self._new.clear()
