"""Copy the readable rows of a damaged store into a new one.

Rows are read one by one. After an unreadable row the reading continues at the next readable one, so that damage costs
the rows of the damaged pages only. Where the first page of the file is damaged, a copy with the first page of a new
store is read. Records whose digest is wrong are quarantined in the new store, not delivered.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sqlite3
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sonarpost.delivery.inspection import open_unchanged
from sonarpost.delivery.schema import VERSION
from sonarpost.delivery.store import Store, lock_exclusively
from sonarpost.errors import StoredFileError
from sonarpost.files import PRIVATE_FILE, sync_folder

PAGE_BYTES = 4096
HEADER_BYTES = 100
NEAR_ROWS = 10_000
"""Rows after a damaged one that are tried singly; beyond them the distance doubles."""
MAX_ROWID = 2**63 - 1
REQUIRED_TABLES = frozenset({"meta", "outbox", "outbox_next", "inbox", "refused", "state"})
INCOMPLETE = "partial"
"""Prefix of the tables with incomplete records. They are not copied: their senders repeat them."""

Cells = tuple[Any, ...]


@dataclass(slots=True)
class TableResult:
    """Result for one table.

    Attributes:
        name: Name of the table.
        recovered: Number of copied rows.
        wrong_digest: Records with a wrong digest, which were quarantined.
        unreadable: First and last row identifier of each unreadable range; None for an unknown end.
        error: Error of SQLite if rows without identifiers are unreadable, empty if all were read.
    """

    name: str
    recovered: int = 0
    wrong_digest: int = 0
    unreadable: list[tuple[int, int | None]] = field(default_factory=list)
    error: str = ""

    @property
    def is_complete(self) -> bool:
        """Whether every row was copied."""
        return not (self.wrong_digest or self.unreadable or self.error)


@dataclass(frozen=True, slots=True)
class SalvageResult:
    """Result of `salvage`.

    Attributes:
        tables: Result for each table.
        first_page: Replaced part of the first page: `header`, `page`, or empty.
    """

    tables: tuple[TableResult, ...]
    first_page: str

    @property
    def is_complete(self) -> bool:
        """Whether every row was copied."""
        return not self.first_page and all(table.is_complete for table in self.tables)


def salvage(path: Path, out: Path) -> SalvageResult:
    """Copy the readable rows of a store into a new file. The damaged store is not changed.

    Args:
        path: The damaged store; no service may use it.
        out: File to create.

    Raises:
        StoredFileError: There is no such store, or not even its list of tables can be read.
        DeliveryError: A service uses the store.
        OSError: `out` exists or cannot be written.
    """
    if not path.is_file():
        raise StoredFileError(str(path), "", "no such file", "the store of a service, for example relay.db")
    if out.exists():
        raise FileExistsError(f"{out} exists")
    with lock_exclusively(path), tempfile.TemporaryDirectory(dir=out.parent, prefix=".salvage.") as folder:
        source, first_page = _open_source(path, Path(folder))
        with closing(source):
            new = Path(folder) / "new.db"
            os.close(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, PRIVATE_FILE))
            with closing(sqlite3.connect(new, isolation_level=None)) as target:
                tables = _copy(source, target)
        new.rename(out)
    sync_folder(out.parent)
    return SalvageResult(tuple(tables), first_page)


def _open_source(path: Path, folder: Path) -> tuple[sqlite3.Connection, str]:
    """Open the store, or a copy with another first page if its list of tables cannot be read."""
    problem = ""
    for first_page in ("", "header", "page"):
        db = open_unchanged(_repaired_copy(path, folder, first_page) if first_page else path)
        try:
            if {name for (name,) in db.execute("SELECT name FROM sqlite_master")} >= REQUIRED_TABLES:
                return db, first_page
            problem = problem or "no tables of a store"
        except sqlite3.Error as error:
            problem = problem or str(error)
        db.close()
    raise StoredFileError(str(path), "", problem, "a store whose list of tables can be read")


def _repaired_copy(path: Path, folder: Path, part: str) -> Path:
    """Copy a store and replace the header of its first page, or all of it, by that of a new store."""
    template = folder / "template.db"
    if not template.exists():
        Store(template).close()
    page = bytearray(template.read_bytes()[:PAGE_BYTES])
    page[28:32] = (path.stat().st_size // PAGE_BYTES).to_bytes(4, "big")  # number of pages
    page[32:40] = bytes(8)  # no free pages
    copy = folder / f"{part}.db"
    shutil.copyfile(path, copy)
    log = path.with_name(f"{path.name}-wal")
    if log.exists():
        shutil.copyfile(log, copy.with_name(f"{copy.name}-wal"))
    with copy.open("r+b") as file:
        file.write(page[:HEADER_BYTES] if part == "header" else page)
    return copy


def _copy(source: sqlite3.Connection, target: sqlite3.Connection) -> list[TableResult]:
    schema = source.execute(
        "SELECT type, name, sql FROM sqlite_master WHERE sql IS NOT NULL AND name NOT LIKE 'sqlite_%'"
    ).fetchall()
    for _, _, sql in sorted(schema, key=lambda row: row[0] != "table"):
        target.execute(sql)
    names = [name for kind, name, _ in schema if kind == "table" and not name.startswith(INCOMPLETE)]
    # Records with a wrong digest are added to `refused`, after its own rows.
    names.sort(key=lambda name: name != "refused")
    with target:
        target.execute("BEGIN")
        results = [_copy_table(source, target, name) for name in (*names, "sqlite_sequence")]
        version = str(VERSION).encode()
        target.execute("INSERT OR IGNORE INTO meta VALUES ('version', ?)", (version,))
    return results


def _copy_table(source: sqlite3.Connection, target: sqlite3.Connection, name: str) -> TableResult:
    result = TableResult(name)
    info = target.execute(f"PRAGMA table_info({name})").fetchall()
    columns = [row[1] for row in info]
    keys = [row[1] for row in sorted(info, key=lambda row: row[5]) if row[5]]
    if name == "sqlite_sequence":
        target.execute("DELETE FROM sqlite_sequence")
    rows = _rows_by_id(source, result, columns) if _has_ids(target, name) else _rows(source, result, columns, keys)
    digest = (columns.index("payload"), columns.index("sha256")) if {"payload", "sha256"} <= set(columns) else None
    sql = f"INSERT OR IGNORE INTO {name} ({', '.join(columns)}) VALUES ({', '.join('?' * len(columns))})"  # noqa: S608
    for row in rows:
        if digest is not None and not _is_intact(row[digest[0]], row[digest[1]]):
            result.wrong_digest += 1
            _quarantine(target, str(row[columns.index("key")]), row[digest[0]])
            continue
        result.recovered += target.execute(sql, row).rowcount
    return result


def _has_ids(db: sqlite3.Connection, table: str) -> bool:
    try:
        db.execute(f"SELECT rowid FROM {table} LIMIT 0")  # noqa: S608 name from the schema
    except sqlite3.OperationalError:
        return False
    return True


def _is_intact(payload: object, digest: object) -> bool:
    return isinstance(payload, bytes) and hashlib.sha256(payload).digest() == digest


def _quarantine(target: sqlite3.Connection, key: str, payload: object) -> None:
    target.execute(
        "INSERT INTO refused (direction, key, payload, reason, at_utc_s) VALUES ('out', ?, ?, ?, ?)",
        (key, payload, "salvage: the digest of the record is wrong", time.time()),
    )


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


def _rows(db: sqlite3.Connection, result: TableResult, columns: Sequence[str], keys: Sequence[str]) -> Iterator[Cells]:
    """Yield the readable rows of a table without row identifiers: from both ends to the first unreadable one."""
    for direction in ("ASC", "DESC"):
        order = ", ".join(f"{key} {direction}" for key in keys)
        try:
            yield from db.execute(f"SELECT {', '.join(columns)} FROM {result.name} ORDER BY {order}")  # noqa: S608
        except sqlite3.Error as error:
            result.error = str(error)
            continue
        return
