"""What a consumer remembers of one producer's numbers, within one transaction.

All up to a number are known, and some above it that came out of order. Both are read when the origin is first met in
the transaction and written once at its end: records of one batch cost no statement each.
"""

from __future__ import annotations

import sqlite3


class DuplicateWindow:
    """The numbers of one origin that were accepted or refused.

    Args:
        connection: With an open transaction that nobody else writes in.
        origin: Identity of the producer's queue, 16 bytes.
    """

    def __init__(self, connection: sqlite3.Connection, origin: bytes) -> None:
        self._db = connection
        self._origin = origin
        upto, above, refused, pieces = connection.execute(
            "SELECT COALESCE((SELECT seq FROM seen_upto WHERE origin = ?1), 0),"
            " EXISTS (SELECT 1 FROM seen WHERE origin = ?1), EXISTS (SELECT 1 FROM refused_before WHERE origin = ?1),"
            " EXISTS (SELECT 1 FROM partial WHERE origin = ?1)",
            (origin,),
        ).fetchone()
        self._upto = self._stored_upto = int(upto)
        self._has_above = bool(above)
        self._has_refused = bool(refused)
        self.has_pieces = bool(pieces)
        """Whether the store may have pieces of a record of this origin."""
        self._new: set[int] = set()

    def has(self, seq: int) -> bool:
        """Tell whether a number was accepted or refused before."""
        return seq <= self._upto or seq in self._new or (self._has_above and self._is_stored(seq))

    def _is_stored(self, seq: int) -> bool:
        row = self._db.execute("SELECT 1 FROM seen WHERE origin = ? AND seq = ?", (self._origin, seq)).fetchone()
        return row is not None

    def add(self, seq: int) -> None:
        """Remember a number."""
        if seq == self._upto + 1:
            self._upto = seq
            self._close_up()
        elif not self.has(seq):
            self._new.add(seq)

    def _close_up(self) -> None:
        """Fold the unbroken run of known numbers into its end, so that memory of the past stays small."""
        while True:
            following = self._upto + 1
            if following in self._new:
                self._new.discard(following)
            elif not (self._has_above and self._is_stored(following)):
                return
            self._upto = following

    def settle_upto(self, seq: int) -> None:
        """Remember that the producer is done with all up to `seq`: what it dropped leaves gaps in its numbers."""
        if seq <= self._upto:
            return
        self._upto = seq
        self._new = {number for number in self._new if number > seq}
        tables = (("refused_before", self._has_refused), ("partial", self.has_pieces))
        for table in (name for name, has_rows in tables if has_rows):
            sql = f"DELETE FROM {table} WHERE origin = ? AND seq <= ?"  # noqa: S608 constants
            self._db.execute(sql, (self._origin, seq))
        self._close_up()

    def refuse(self, seq: int) -> None:
        """Remember that a number was refused."""
        self._has_refused = True
        self._db.execute("INSERT INTO refused_before VALUES (?, ?)", (self._origin, seq))

    def was_refused(self, seq: int) -> bool:
        """Tell whether a number was refused."""
        if not self._has_refused:
            return False
        sql = "SELECT 1 FROM refused_before WHERE origin = ? AND seq = ?"
        return self._db.execute(sql, (self._origin, seq)).fetchone() is not None

    def write(self) -> None:
        """Write what has changed; to be called before the transaction is committed."""
        if self._upto > self._stored_upto:
            self._db.execute("INSERT OR REPLACE INTO seen_upto VALUES (?, ?)", (self._origin, self._upto))
            self._stored_upto = self._upto
            if self._has_above:
                self._db.execute("DELETE FROM seen WHERE origin = ? AND seq <= ?", (self._origin, self._upto))
        if self._new:
            self._db.executemany("INSERT INTO seen VALUES (?, ?)", [(self._origin, seq) for seq in sorted(self._new)])
            self._has_above = True
            self._new.clear()
