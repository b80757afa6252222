"""Copy the readable rows of a damaged store into a new one.

Rows are read one by one. After an unreadable row the reading continues at the next readable one, so that damage costs
the rows of the damaged pages only. The first page holds the list of tables: without it nothing is copied.
"""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sonarpost.delivery.inspection import open_unchanged
from sonarpost.delivery.schema import VERSION
from sonarpost.delivery.store import Store, lock_exclusively
from sonarpost.errors import StoredFileError
from sonarpost.files import sync_folder

NEAR_ROWS = 10_000
"""Rows after a damaged one that are tried singly; beyond them the distance doubles."""
MAX_ROWID = 2**63 - 1
TABLES_BY_ID = ("outbox", "inbox", "refused", "state", "received_window", "sqlite_sequence")
TABLES_BY_KEY = ("meta", "outbox_next", "received")
"""Incomplete records are not copied: their senders repeat them."""

Cells = tuple[Any, ...]


@dataclass(slots=True)
class TableResult:
    """Result for one table.

    Attributes:
        name: Name of the table.
        recovered: Number of copied rows.
        unreadable: First and last row identifier of each unreadable range; None for an unknown end.
        error: Error of SQLite if rows without identifiers are unreadable, empty if all were read.
    """

    name: str
    recovered: int = 0
    unreadable: list[tuple[int, int | None]] = field(default_factory=list)
    error: str = ""

    @property
    def is_complete(self) -> bool:
        """Whether every row was copied."""
        return not (self.unreadable or self.error)


def salvage(path: Path, out: Path) -> list[TableResult]:
    """Copy the readable rows of a store into a new file. The damaged store is not changed.

    Args:
        path: The damaged store; no service may use it.
        out: File to create.

    Raises:
        StoredFileError: There is no such store of this version, or its first page cannot be read.
        DeliveryError: A service uses the store.
        OSError: `out` exists or cannot be written.
    """
    if out.exists():
        raise FileExistsError(f"{out} exists")
    with closing(open_unchanged(path)) as source, lock_exclusively(path):
        try:
            version = source.execute("SELECT value FROM meta WHERE name = 'version'").fetchone()
        except sqlite3.Error as error:
            raise StoredFileError(str(path), "", str(error), "a store whose first page can be read") from error
        if version != (str(VERSION).encode(),):
            raise StoredFileError(str(path), "version", version, str(VERSION))
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=".salvage.") as folder:
            new = Path(folder) / "new.db"
            Store(new).close()
            with closing(sqlite3.connect(new, isolation_level=None)) as target, target:
                target.execute("BEGIN")
                target.execute("DELETE FROM sqlite_sequence")
                results = [_copy(source, target, name, has_ids=True) for name in TABLES_BY_ID]
                results += [_copy(source, target, name, has_ids=False) for name in TABLES_BY_KEY]
            new.rename(out)
    sync_folder(out.parent)
    return results


def _copy(source: sqlite3.Connection, target: sqlite3.Connection, name: str, *, has_ids: bool) -> TableResult:
    result = TableResult(name)
    columns = [row[1] for row in target.execute(f"PRAGMA table_info({name})")]
    sql = f"INSERT OR REPLACE INTO {name} ({', '.join(columns)}) VALUES ({', '.join('?' * len(columns))})"  # noqa: S608
    for row in _rows_by_id(source, result, columns) if has_ids else _rows(source, result, columns):
        result.recovered += target.execute(sql, row).rowcount
    return result


def _rows_by_id(db: sqlite3.Connection, result: TableResult, columns: Sequence[str]) -> Iterator[Cells]:
    """Yield the readable rows of a table with row identifiers."""
    # `>=`: a search for a greater identifier than the last one of a damaged page would read this page.
    sql = f"SELECT rowid, {', '.join(columns)} FROM {result.name} NOT INDEXED WHERE rowid >= ? ORDER BY rowid"  # noqa: S608
    start = 0
    while True:
        with suppress(sqlite3.Error):
            for row in db.execute(sql, (start,)):
                yield row[1:]
                start = int(row[0]) + 1
            return
        # The cursor reads one row ahead, and drops the last row before an error: continue with single rows.
        following = _next_readable(db, sql, start)
        if following is None:
            result.unreadable.append((start, None))
            return
        if int(following[0]) > start:
            result.unreadable.append((start, int(following[0]) - 1))
        yield following[1:]
        start = int(following[0]) + 1


def _next_readable(db: sqlite3.Connection, sql: str, start: int) -> Cells | None:
    """Return the next readable row from `start` on, with its identifier; None if there is none."""

    def row_from(number: int) -> tuple[bool, Cells | None]:
        """Return whether the first row from `number` on can be read, and the row, None for the end of the table."""
        try:
            return True, db.execute(f"{sql} LIMIT 1", (number,)).fetchone()
        except sqlite3.Error:
            return False, None

    step = before = 0
    while start + step < MAX_ROWID:
        readable, found = row_from(start + step)
        if readable:
            break
        before = step
        step += 1 if step < NEAR_ROWS else step
    else:
        return None
    while step - before > 1:
        middle = (step + before) // 2
        readable, nearer = row_from(start + middle)
        step, before, found = (middle, before, nearer) if readable else (step, middle, found)
    return found


def _rows(db: sqlite3.Connection, result: TableResult, columns: Sequence[str]) -> Iterator[Cells]:
    """Yield the rows of a table without row identifiers, up to the first unreadable one."""
    try:
        yield from db.execute(f"SELECT {', '.join(columns)} FROM {result.name}")  # noqa: S608
    except sqlite3.Error as error:
        result.error = str(error)
