"""The store of a stopped service: its state, and a copy of its readable rows.

Rows are copied one by one. After an unreadable row the reading continues at the next readable one, so that damage costs
the rows of the damaged pages only. The first page holds the list of tables: without it nothing is copied.
"""

from __future__ import annotations

import sqlite3
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from sonarpost.delivery import watermark
from sonarpost.delivery.schema import VERSION
from sonarpost.delivery.store import Store, lock_exclusively
from sonarpost.delivery.watermark import LostRecords, Marks
from sonarpost.errors import StoredFileError
from sonarpost.files import sync_folder

MAX_PROBLEMS = 20

NEAR_ROWS = 10_000
"""Rows after a damaged one that are tried singly; beyond them the distance doubles."""
MAX_ROWID = 2**63 - 1
TABLES_BY_ID = ("outbox", "inbox", "refused", "state", "received_window", "sqlite_sequence")
TABLES_BY_KEY = ("meta", "outbox_next", "received")
"""Incomplete records are not copied: their senders repeat them."""

T = TypeVar("T")
Cells = tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class QueueContents:
    """Contents of an outbox queue, of the inbox or of the quarantine.

    Attributes:
        name: Name of the outbox queue; `(inbox)` or `(quarantine)`.
        records: Number of records.
        size_bytes: Sum of their payload sizes.
        oldest_utc_s: When the oldest record was added; None if there is none.
        last: Highest number assigned.
    """

    name: str
    records: int
    size_bytes: int
    oldest_utc_s: float | None
    last: int


@dataclass(slots=True)
class StoreState:
    """Result of `inspect`.

    Attributes:
        problems: Damage that SQLite reports, and tables that cannot be read; empty if the file is sound.
        version: Schema version, empty if it cannot be read.
        queues: Contents of the tables.
        side_car: State of the side-car: `as the store`, `older than the store`, `none`, or the reason why it cannot be
            read.
        unreported: Records that can be lost with lost commits that no service has reported yet.
        lost: Report that an operator has not cleared.
    """

    problems: list[str] = field(default_factory=list)
    version: str = ""
    queues: list[QueueContents] = field(default_factory=list)
    side_car: str = ""
    unreported: LostRecords | None = None
    lost: LostRecords | None = None

    @property
    def is_sound(self) -> bool:
        """Whether the file is undamaged, has the expected version and no lost commits."""
        version = str(VERSION)
        return not self.problems and self.version == version and self.unreported is None and self.lost is None


def open_unchanged(path: Path) -> sqlite3.Connection:
    """Open a store read-only; a write-ahead log is read, and stays.

    Raises:
        StoredFileError: It cannot be opened.
    """
    if not path.is_file():
        raise StoredFileError(str(path), "", "no such file", "the store of a service, for example relay.db")
    try:
        db = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, isolation_level=None)
        db.execute("PRAGMA cell_size_check=ON")
    except sqlite3.Error as error:
        raise StoredFileError(str(path), "", str(error), "the store of a service") from error
    return db


def inspect(path: Path) -> StoreState:
    """Inspect a store that no service uses. Nothing is changed.

    Raises:
        StoredFileError: There is no such file.
    """
    found = StoreState()
    db = open_unchanged(path)
    try:

        def read(what: str, query: Callable[[], T], otherwise: T) -> T:
            try:
                return query()
            except sqlite3.Error as error:
                found.problems.append(f"{what}: {error}")
                return otherwise

        found.problems += read("file", lambda: _integrity_problems(db), [])
        found.version = read("schema version", lambda: _version(db), "")
        found.queues += read("outbox", lambda: _queues(db), [])
        found.queues += read("inbox", lambda: [_table(db, "inbox", "received_utc_s")], [])
        found.queues += read("quarantine", lambda: [_table(db, "refused", "at_utc_s", "quarantine")], [])
        marks = read("numbers", lambda: Marks.of_store(db), None)
        found.lost = read("report of lost commits", lambda: watermark.lost_records(db), None)
    finally:
        db.close()
    found.problems = list(dict.fromkeys(found.problems))
    _compare(path, marks, found)
    return found


def _integrity_problems(db: sqlite3.Connection) -> list[str]:
    rows = [str(row[0]) for row in db.execute(f"PRAGMA integrity_check({MAX_PROBLEMS})")]
    return [line for row in rows for line in row.splitlines() if line and row != "ok"]


def _version(db: sqlite3.Connection) -> str:
    row = db.execute("SELECT value FROM meta WHERE name = 'version'").fetchone()
    return "" if row is None else bytes(row[0]).decode(errors="replace")


def _queues(db: sqlite3.Connection) -> list[QueueContents]:
    rows = db.execute(
        "SELECT consumer, seq, (SELECT COUNT(*) FROM outbox o WHERE o.consumer = n.consumer),"
        " (SELECT COALESCE(SUM(LENGTH(payload)), 0) FROM outbox o WHERE o.consumer = n.consumer),"
        " (SELECT MIN(created_utc_s) FROM outbox o WHERE o.consumer = n.consumer)"
        " FROM outbox_next n ORDER BY consumer"
    ).fetchall()
    return [QueueContents(str(queue), count, size, oldest, last) for queue, last, count, size, oldest in rows]


def _table(db: sqlite3.Connection, table: str, time_column: str, name: str = "") -> QueueContents:
    count, size, oldest, last = db.execute(
        f"SELECT COUNT(*), COALESCE(SUM(LENGTH(payload)), 0), MIN({time_column}),"  # noqa: S608 literals
        f" COALESCE((SELECT seq FROM sqlite_sequence WHERE name = '{table}'), 0) FROM {table}"
    ).fetchone()
    return QueueContents(f"({name or table})", count, size, oldest, last)


def _compare(path: Path, marks: Marks | None, found: StoreState) -> None:
    try:
        side_car = watermark.read(path)
    except StoredFileError as error:
        found.side_car = str(error)
        return
    if side_car is None:
        found.side_car = "none"
    elif marks is None:
        found.side_car = "not compared: the numbers of the store cannot be read"
    else:
        found.unreported = watermark.compare(side_car, marks, time.time())
        behind = found.unreported is not None
        found.side_car = "newer than the store" if behind else _agreement(side_car, marks)


def _agreement(side_car: Marks, marks: Marks) -> str:
    same = side_car.inbox.last == marks.inbox.last and {q: n.last for q, n in side_car.queues.items()} == {
        q: n.last for q, n in marks.queues.items()
    }
    return "as the store" if same else "older than the store"


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
            Store(new, page_bytes=source.execute("PRAGMA page_size").fetchone()[0]).close()
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
