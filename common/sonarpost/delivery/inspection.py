"""State of the store of a stopped service: integrity, schema version, queues, lost commits."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from sonarpost.delivery import watermark
from sonarpost.delivery.schema import VERSION
from sonarpost.delivery.watermark import LostRecords, Marks
from sonarpost.errors import StoredFileError

MAX_PROBLEMS = 20

T = TypeVar("T")


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
