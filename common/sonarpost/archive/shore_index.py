"""Index of the records that a shore site has stored: `index.db` beside the files of c2.

The files are authoritative: c2 adds missing rows from the side-cars when it starts. c2 writes the index; commands read
it and mark exported images.
"""

from __future__ import annotations

import math
import sqlite3
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal, TypeVar

from sonarpost.errors import StoredFileError
from sonarpost.files import make_private
from sonarpost.messages import Decision, DeliveryState, TaskingKind

FILE_NAME = "index.db"
INDEX_VERSION = 5
BUSY_S = 10.0

_SCHEMA = """
CREATE TABLE IF NOT EXISTS image (
    vessel_id TEXT NOT NULL, name TEXT NOT NULL, vehicle_id TEXT NOT NULL, image_id TEXT NOT NULL,
    version INTEGER NOT NULL, first_frame_utc_s REAL NOT NULL, last_frame_utc_s REAL NOT NULL,
    relayed_utc_s REAL, accepted_utc_s REAL NOT NULL, complete INTEGER NOT NULL, missing_fraction REAL NOT NULL,
    height_px INTEGER NOT NULL, width_px INTEGER NOT NULL, codec TEXT NOT NULL, lat_deg REAL, lon_deg REAL,
    atd_class TEXT, atd_confidence REAL, size_bytes INTEGER NOT NULL, exported_utc_s REAL, removed_utc_s REAL,
    conflict INTEGER NOT NULL DEFAULT 0, files_sha256 TEXT NOT NULL DEFAULT '', verified_utc_s REAL,
    fault TEXT NOT NULL DEFAULT '', despeckle_strength REAL, p_mine_like REAL, p_other_object REAL,
    PRIMARY KEY (vessel_id, name)) WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS image_age ON image (accepted_utc_s) WHERE removed_utc_s IS NULL;
CREATE TABLE IF NOT EXISTS decision (
    vessel_id TEXT NOT NULL, decision_id TEXT NOT NULL, vehicle_id TEXT NOT NULL, image_id TEXT NOT NULL,
    image_version INTEGER NOT NULL, verdict TEXT NOT NULL, confidence REAL, mlo_class TEXT, remark TEXT NOT NULL,
    operator TEXT NOT NULL, decided_utc_s REAL NOT NULL, accepted_utc_s REAL NOT NULL,
    files_sha256 TEXT NOT NULL DEFAULT '', verified_utc_s REAL, fault TEXT NOT NULL DEFAULT '',
    PRIMARY KEY (vessel_id, decision_id)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS tasking (
    vessel_id TEXT NOT NULL, kind TEXT NOT NULL, record_id TEXT NOT NULL, vehicle_id TEXT NOT NULL, image_id TEXT,
    summary TEXT NOT NULL, author TEXT NOT NULL, issued_utc_s REAL NOT NULL, state TEXT NOT NULL, reason TEXT NOT NULL,
    changed_utc_s REAL NOT NULL, PRIMARY KEY (vessel_id, kind, record_id)) WITHOUT ROWID;
"""
_INDEXES = """
CREATE INDEX IF NOT EXISTS image_verified ON image (verified_utc_s) WHERE removed_utc_s IS NULL;
CREATE INDEX IF NOT EXISTS image_fault ON image (fault) WHERE fault <> '';
CREATE INDEX IF NOT EXISTS image_conflict ON image (conflict) WHERE conflict <> 0;
CREATE INDEX IF NOT EXISTS decision_verified ON decision (verified_utc_s);
CREATE INDEX IF NOT EXISTS decision_fault ON decision (fault) WHERE fault <> '';
"""


@dataclass(frozen=True, slots=True)
class ImageRow:
    """One version of an image.

    Attributes:
        name: File name without suffix, in the vessel's folder.
        relayed_utc_s: When the vessel's relay accepted it, by the vessel's clock; None if restored from the files.
        accepted_utc_s: When c2 stored it, by the shore's clock.
        size_bytes: Size of its three files, each counted as at least `shore_files.MIN_FILE_BYTES`.
        exported_utc_s: When it was last exported; None for never.
        removed_utc_s: When retention deleted its files; None while they exist.
        conflict: Whether another image has the plain file name, see `image_files`.
        files_sha256: SHA-256 digests of its files in the order of `shore_files.SUFFIXES`, separated by spaces.
        verified_utc_s: When its files were last compared with the index; None for never.
        fault: `missing`, `changed` or `unreadable` if the last comparison failed, else empty.
        despeckle_strength: As in `ReconstructedImage`.
        p_mine_like: As in `Contact`.
        p_other_object: As `p_mine_like`.
    """

    vessel_id: str
    name: str
    vehicle_id: str
    image_id: str
    version: int
    first_frame_utc_s: float
    last_frame_utc_s: float
    relayed_utc_s: float | None
    accepted_utc_s: float
    complete: bool
    missing_fraction: float
    height_px: int
    width_px: int
    codec: str
    lat_deg: float | None
    lon_deg: float | None
    atd_class: str | None
    atd_confidence: float | None
    size_bytes: int
    exported_utc_s: float | None = None
    removed_utc_s: float | None = None
    conflict: bool = False
    files_sha256: str = ""
    verified_utc_s: float | None = None
    fault: str = ""
    despeckle_strength: float | None = None
    p_mine_like: float | None = None
    p_other_object: float | None = None


@dataclass(frozen=True, slots=True)
class DecisionRow:
    """One decision; `files_sha256`, `verified_utc_s` and `fault` as in `ImageRow`."""

    vessel_id: str
    decision_id: str
    vehicle_id: str
    image_id: str
    image_version: int
    verdict: str
    confidence: float | None
    mlo_class: str | None
    remark: str
    operator: str
    decided_utc_s: float
    accepted_utc_s: float
    files_sha256: str = ""
    verified_utc_s: float | None = None
    fault: str = ""

    @classmethod
    def of(cls, decision: Decision, accepted_utc_s: float, files_sha256: str) -> DecisionRow:
        """Return the row of a record."""
        values = decision.model_dump(exclude={"accepted_utc_s"})
        named = {f.name: values[f.name] for f in fields(cls) if f.name in values}
        return cls(**named, accepted_utc_s=accepted_utc_s, files_sha256=files_sha256)


@dataclass(frozen=True, slots=True)
class TaskingRow:
    """A comment or a command with its delivery state."""

    vessel_id: str
    kind: TaskingKind
    record_id: str
    vehicle_id: str
    image_id: str | None
    summary: str
    author: str
    issued_utc_s: float
    state: DeliveryState
    reason: str
    changed_utc_s: float


Row = TypeVar("Row", ImageRow, DecisionRow, TaskingRow)
_TABLES: dict[type, str] = {ImageRow: "image", DecisionRow: "decision", TaskingRow: "tasking"}
_NAMES: dict[type, str] = {ImageRow: "name", DecisionRow: "decision_id"}
MarkColumn = Literal["exported_utc_s", "removed_utc_s"]
DEFECTS = ("missing", "changed", "unreadable", "conflicting")
Fault = Literal["", "missing", "changed", "unreadable"]


@dataclass(frozen=True, slots=True)
class Verified:
    """Result of the comparison of a row with its files.

    Attributes:
        row: The row as it was compared.
        fault: What differs, empty if nothing does.
    """

    row: ImageRow | DecisionRow
    fault: Fault


class ShoreIndex:
    """Index of one `out_dir`, safe for several threads and processes.

    Unless it is `writable`, an existing index is opened read-only.

    Raises:
        StoredFileError: There is no index, or the file is not one of this version.
        OSError: It cannot be written.
    """

    def __init__(self, out_dir: Path, *, writable: bool = True) -> None:
        self.path = out_dir / FILE_NAME
        self._lock = threading.RLock()
        if writable:
            out_dir.mkdir(parents=True, exist_ok=True)
            make_private(self.path)
        elif not self.path.is_file():
            raise StoredFileError(str(self.path), "", "no such file", "the index in the out_dir of c2")
        mode = "rwc" if writable else "ro"
        try:
            self._db = sqlite3.connect(
                f"{self.path.absolute().as_uri()}?mode={mode}",
                uri=True,
                check_same_thread=False,
                isolation_level=None,
                timeout=BUSY_S,
            )
            self._open(writable=writable)
        except sqlite3.DatabaseError as error:
            if isinstance(error, sqlite3.OperationalError) and writable:
                raise OSError(f"{self.path}: {error}") from error
            raise StoredFileError(str(self.path), "", str(error), "the index in the out_dir of c2") from error

    def _open(self, *, writable: bool) -> None:
        version = int(self._db.execute("PRAGMA user_version").fetchone()[0])
        if version != INDEX_VERSION and not (writable and version == 0):
            self._db.close()
            raise StoredFileError(str(self.path), "user_version", version, str(INDEX_VERSION))
        if writable:
            self._db.execute("PRAGMA journal_mode=WAL")
            # Rows that a power cut deletes are restored from the files at the next start.
            self._db.execute("PRAGMA synchronous=NORMAL")
            end = f"PRAGMA user_version = {INDEX_VERSION}; COMMIT;"
            self._db.executescript(f"BEGIN IMMEDIATE; {_SCHEMA} {_INDEXES} {end}")

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._db.close()

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            try:
                # The connection commits at the end of its block, and rolls back after an exception.
                with self._db:
                    self._db.execute("BEGIN IMMEDIATE")
                    yield self._db
            except sqlite3.Error as error:
                raise OSError(f"{self.path}: {error}") from error

    def put(self, rows: Iterable[ImageRow | DecisionRow | TaskingRow]) -> None:
        """Add rows, or replace those with the same keys.

        Raises:
            OSError: The file cannot be written.
        """
        with self._writing() as db:
            for row in rows:
                values = tuple(getattr(row, each.name) for each in fields(row))
                marks = ", ".join("?" * len(values))
                db.execute(f"INSERT OR REPLACE INTO {_TABLES[type(row)]} VALUES ({marks})", values)  # noqa: S608

    def mark(self, column: MarkColumn, images: Iterable[ImageRow], at_utc_s: float) -> None:
        """Mark images as exported or removed.

        Raises:
            OSError: The file cannot be written.
        """
        with self._writing() as db:
            for row in images:
                sql = f"UPDATE image SET {column} = ? WHERE vessel_id = ? AND name = ?"  # noqa: S608 literals
                db.execute(sql, (at_utc_s, row.vessel_id, row.name))

    def images(self, *, removed: bool = False) -> list[ImageRow]:
        """Return all versions of all images, oldest first; removed ones only if `removed`.

        Raises:
            OSError: The file cannot be read.
        """
        where = "" if removed else "WHERE removed_utc_s IS NULL"
        rows = self._rows(ImageRow, f"{where} ORDER BY first_frame_utc_s, vessel_id, name")
        return [_with_booleans(row) for row in rows]

    def decisions(self) -> list[DecisionRow]:
        """Return all decisions, oldest first."""
        return self._rows(DecisionRow, "ORDER BY decided_utc_s, vessel_id, decision_id")

    def tasking(self) -> list[TaskingRow]:
        """Return all comments and commands, oldest first."""
        return self._rows(TaskingRow, "ORDER BY issued_utc_s, vessel_id, kind, record_id")

    def has_image(self, vessel_id: str, name: str) -> bool:
        """Return whether an image is indexed and not removed."""
        sql = "WHERE vessel_id = ? AND name = ? AND removed_utc_s IS NULL"
        return bool(self._rows(ImageRow, sql, (vessel_id, name)))

    def has_decision(self, vessel_id: str, decision_id: str) -> bool:
        """Return whether a decision is indexed."""
        return bool(self._rows(DecisionRow, "WHERE vessel_id = ? AND decision_id = ?", (vessel_id, decision_id)))

    def to_verify(self, before_utc_s: float, interval_s: float, cycle_s: float) -> list[ImageRow | DecisionRow]:
        """Return rows whose files are to be compared with the index, those that wait longest first.

        Args:
            before_utc_s: Rows that were compared later are omitted.
            interval_s: Interval of the calls.
            cycle_s: Time in which every row is returned once; it limits the number of rows.

        Raises:
            OSError: The file cannot be read.
        """
        found: list[ImageRow | DecisionRow] = []
        due = "(verified_utc_s IS NULL OR verified_utc_s < ?) ORDER BY verified_utc_s LIMIT ?"
        with self._lock:
            count = self._count("image", "removed_utc_s IS NULL")
            limit = math.ceil(count * interval_s / cycle_s)
            images = self._rows(ImageRow, f"WHERE removed_utc_s IS NULL AND {due}", (before_utc_s, limit))
            found += [_with_booleans(row) for row in images]
            limit = math.ceil(self._count("decision") * interval_s / cycle_s)
            found += self._rows(DecisionRow, f"WHERE {due}", (before_utc_s, limit))
        return found

    def mark_verified(self, results: Iterable[Verified], at_utc_s: float) -> None:
        """Store the results of comparisons.

        Raises:
            OSError: The file cannot be written.
        """
        with self._writing() as db:
            for result in results:
                table, name = _TABLES[type(result.row)], _NAMES[type(result.row)]
                key = (result.row.vessel_id, getattr(result.row, name))
                sql = f"UPDATE {table} SET verified_utc_s = ?, fault = ?"  # noqa: S608 literals
                sql += f" WHERE vessel_id = ? AND {name} = ?"
                db.execute(sql, (at_utc_s, result.fault, *key))

    def defect_counts(self) -> dict[str, int]:
        """Return the numbers of missing, changed, unreadable and conflicting images and decisions.

        Raises:
            OSError: The file cannot be read.
        """
        counts = dict.fromkeys(DEFECTS, 0)
        with self._lock:
            for table, where in (("image", " AND removed_utc_s IS NULL"), ("decision", "")):
                sql = f"SELECT fault, COUNT(*) FROM {table} WHERE fault <> ''{where} GROUP BY fault"  # noqa: S608
                for fault, count in self._execute(sql):
                    counts[fault] += count
            counts["conflicting"] = self._count("image", "conflict <> 0 AND removed_utc_s IS NULL")
        return counts

    def _count(self, table: str, where: str = "1") -> int:
        return int(self._execute(f"SELECT COUNT(*) FROM {table} WHERE {where}").fetchone()[0])  # noqa: S608

    def size_bytes(self) -> int:
        """Return the size of all images that are not removed, in bytes."""
        with self._lock:
            row = self._execute("SELECT COALESCE(SUM(size_bytes), 0) FROM image WHERE removed_utc_s IS NULL").fetchone()
        return int(row[0])

    def oldest_utc_s(self) -> float | None:
        """Return when the oldest image that is not removed was accepted; None if there is none."""
        with self._lock:
            row = self._execute("SELECT MIN(accepted_utc_s) FROM image WHERE removed_utc_s IS NULL").fetchone()
        return None if row[0] is None else float(row[0])

    def _rows(self, row_type: type[Row], rest: str, values: tuple[object, ...] = ()) -> list[Row]:
        table = _TABLES[row_type]
        with self._lock:
            columns = {row[1] for row in self._execute(f"PRAGMA table_info({table})")}
            names = [f.name for f in fields(row_type) if f.name in columns]
            found = self._execute(f"SELECT {', '.join(names)} FROM {table} {rest}", values).fetchall()  # noqa: S608
        return [row_type(**dict(zip(names, row, strict=True))) for row in found]

    def _execute(self, sql: str, values: tuple[object, ...] = ()) -> sqlite3.Cursor:
        try:
            return self._db.execute(sql, values)
        except sqlite3.Error as error:
            raise OSError(f"{self.path}: {error}") from error


def _with_booleans(row: ImageRow) -> ImageRow:
    """Return the row with booleans, which SQLite does not have."""
    return replace(row, complete=bool(row.complete), conflict=bool(row.conflict))
