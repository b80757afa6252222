"""Archive of a shore site: images, decisions, tasking, their numbers, and records that are accepted and not stored yet.

The database is authoritative. One transaction has the row of an image, its number and the end of its acceptance. Before
it, the files are written into the folder: after a crash in between, the record is handled again and replaces them. An
archive without a folder keeps them in the database.

Several c2 can share an archive in PostgreSQL. Unique keys and digests make every write idempotent: the same record
again is a repetition; another content under the same key is not written.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import sqlalchemy as sa

from sonarpost.archive.backlog import CHUNK, Backlog, BacklogRecord, chunks
from sonarpost.archive.database import ShoreDatabase
from sonarpost.archive.image_files import SUFFIXES
from sonarpost.archive.journal import Accepted, Journal
from sonarpost.archive.rows import DEFECTS, DecisionRow, Fault, ImageRow, MarkColumn, Row, TaskingRow, Verified
from sonarpost.archive.schema import (
    DECISION,
    FILE,
    IMAGE,
    RECORD,
    TABLES,
    TASKING,
    row_of,
    select_of,
    values_of,
)
from sonarpost.archive.shore_files import decision_name, delete_image_files, verify_files, write_files
from sonarpost.errors import DatabaseUnavailableError, StoredFileError
from sonarpost.files import read_regular
from sonarpost.sonar.image_decoding import MAX_FILE_BYTES

Name = tuple[str, str]
"""Vessel and name of files, without suffix."""


@dataclass(frozen=True, slots=True)
class StoredImage:
    """An image as it is written: row, and content of its files by suffix, the JSON side-car first."""

    row: ImageRow
    files: tuple[tuple[str, bytes], ...]


@dataclass
class Batch:
    """What one transaction writes.

    Attributes:
        images: Images; each name once. Stored ones with the same JSON file are repaired.
        decisions: Decisions with their content; each identifier once.
        replaced: Names of images that are removed before, together with their numbers.
        waiting: Coded images that wait for the decoder.
        finished: Accepted records whose effects are stored.
        tasking: Comments and commands with new states; an older state does not replace a newer one.
        numbered: Columns of records for the journal, in the order of their numbers.
    """

    images: list[StoredImage] = field(default_factory=list)
    decisions: list[tuple[DecisionRow, bytes]] = field(default_factory=list)
    replaced: list[Name] = field(default_factory=list)
    waiting: list[BacklogRecord] = field(default_factory=list)
    finished: list[BacklogRecord] = field(default_factory=list)
    tasking: list[TaskingRow] = field(default_factory=list)
    numbered: list[dict[str, Any]] = field(default_factory=list)


class ShoreArchive:
    """Archive in one database, for several threads.

    Every method raises OSError or DatabaseUnavailableError if the database or the folder cannot be used at present, and
    can be called again.

    Args:
        database: The database.
        folder: Folder of the files; None if the database keeps them.
        owner: Identity of this c2 among those that share the database.

    Attributes:
        journal: Numbers of the records.
        backlog: Records that are accepted and not stored yet.
    """

    def __init__(self, database: ShoreDatabase, folder: Path | None = None, owner: str = "") -> None:
        self.database = database
        self.folder = folder
        self.journal = Journal(database)
        self.backlog = Backlog(database, owner)
        self._owner = owner
        self._lock = threading.RLock()
        """Held while files are written, compared or deleted."""
        insert = database.insert
        image, decision, tasking, file = insert(IMAGE), insert(DECISION), insert(TASKING), insert(FILE)
        self._put_images = image.on_conflict_do_update(
            index_elements=(IMAGE.c.vessel_id, IMAGE.c.name),
            set_={n: image.excluded[n] for n in ("removed_utc_s", "fault", "files_sha256", "size_bytes")},
            where=_side_car(IMAGE.c) == _side_car(image.excluded),
        )
        self._put_decisions = decision.on_conflict_do_update(
            index_elements=(DECISION.c.vessel_id, DECISION.c.decision_id),
            set_={"fault": ""},
            where=DECISION.c.files_sha256 == decision.excluded.files_sha256,
        )
        self._put_files = file.on_conflict_do_update(
            index_elements=(FILE.c.vessel_id, FILE.c.name, FILE.c.suffix), set_={"content": file.excluded.content}
        )
        self._put_tasking = tasking.on_conflict_do_update(
            index_elements=(TASKING.c.vessel_id, TASKING.c.kind, TASKING.c.record_id),
            set_={
                **{n: tasking.excluded[n] for n in ("state", "reason", "changed_utc_s")},
                "owner": sa.case((TASKING.c.owner == "", tasking.excluded.owner), else_=TASKING.c.owner),
            },
            where=TASKING.c.changed_utc_s <= tasking.excluded.changed_utc_s,
        )
        self._claim = insert(TASKING).on_conflict_do_nothing()

    def close(self) -> None:
        """Close the database."""
        self.database.close()

    # Writes

    def write(self, batch: Batch) -> list[Accepted]:
        """Write the files into the folder, then everything else in one transaction.

        Returns:
            Numbers of the records for the journal.

        Raises:
            OSError, DatabaseUnavailableError: The files cannot be written; or the transaction has failed; or another c2
                has written another content under one of the names at the same time, which the next search finds.
        """
        files = [
            (i.row.vessel_id, i.row.name, suffix, content)
            for i in sorted(batch.images, key=lambda i: (i.row.vessel_id, i.row.name))
            for suffix, content in i.files
        ]
        files += [(d.vessel_id, decision_name(d.decision_id), SUFFIXES[0], content) for d, content in batch.decisions]
        with self._lock:
            if self.folder is not None:
                write_files(self.folder, files)
                files = []
            with self.database.transaction() as sql:
                for table in (FILE, IMAGE, RECORD):
                    _delete(sql, table, batch.replaced)
                if batch.images:
                    self._write_rows(sql, self._put_images, [i.row for i in batch.images], "image under the same name")
                if batch.decisions:
                    rows = [row for row, _ in batch.decisions]
                    self._write_rows(sql, self._put_decisions, rows, "decision under the same identifier")
                if files:
                    columns = ("vessel_id", "name", "suffix", "content")
                    self.database.put(sql, self._put_files, [dict(zip(columns, file, strict=True)) for file in files])
                if batch.tasking:
                    values = [values_of(row) | {"owner": self._owner, "payload": b""} for row in batch.tasking]
                    self.database.put(sql, self._put_tasking, values)
                if batch.waiting:
                    self.backlog.add_waiting(sql, batch.waiting)
                self.backlog.delete(sql, batch.finished)
                if batch.waiting or batch.finished:
                    self.backlog.count_waiting(sql)
                # At last, because other c2 wait for it until the commit.
                numbers = self.journal.number(sql, batch.numbered)
        return numbers

    def _write_rows(self, sql: sa.Connection, statement: sa.Insert, rows: Sequence[Row], what: str) -> None:
        values = sorted((values_of(row) for row in rows), key=lambda v: (v["vessel_id"], v.get("name", "")))
        if self.database.put(sql, statement, values) != len(rows):
            raise DatabaseUnavailableError(f"another c2 has stored another {what}; trying again")

    def adopt_numbers(self, source: ShoreArchive) -> int:
        """Add the records of the journal of another archive, and return the number of added ones.

        An empty journal becomes that journal: identity and numbers stay. Otherwise the records get new numbers. Records
        that the journal has, and images that are not stored here, are omitted.
        """
        identity, last = source.journal.position()
        added = 0
        with self.database.transaction() as sql:
            own = self.journal.become(sql, identity)
            for found in source.journal.all_columns(CHUNK):
                records = found if own else [{n: v for n, v in r.items() if n != "seq"} for r in found]
                names = [(r["vessel_id"], r["name"]) for r in records if r["name"]]
                stored = sa.select(IMAGE.c.vessel_id, IMAGE.c.name).where(
                    _named(IMAGE), IMAGE.c.removed_utc_s.is_(None)
                )
                present = {tuple(row) for row in sql.execute(stored, {"names": names})} if names else set()
                kept = [r for r in records if not r["name"] or (r["vessel_id"], r["name"]) in present]
                before = self.journal.last(sql)
                added += len({number.seq for number in self.journal.number(sql, kept) if number.seq > before})
            if own:
                self.journal.skip_to(sql, last)
        return added

    # Images and decisions

    def find_image(self, vessel_id: str, name: str) -> tuple[str, bool] | None:
        """Return the SHA-256 digest of an image's JSON file, and whether its files are stored; None for no image."""
        with self.database.transaction(writing=False) as sql:
            found = sql.execute(_FIND_IMAGE, {"vessel": vessel_id, "name": name}).first()
        return None if found is None else (found[0].partition(" ")[0], bool(found[1]))

    def find_decision(self, vessel_id: str, decision_id: str) -> str | None:
        """Return the SHA-256 digest of a decision's content; None if there is none."""
        with self.database.transaction(writing=False) as sql:
            found = sql.execute(_FIND_DECISION, {"vessel": vessel_id, "decision": decision_id})
            return found.scalar_one_or_none()

    def images(self, *, removed: bool = False) -> list[ImageRow]:
        """Return all versions of all images, oldest first; removed ones only if `removed`."""
        where = () if removed else (IMAGE.c.removed_utc_s.is_(None),)
        return self._rows(ImageRow, where, ("first_frame_utc_s", "vessel_id", "name"))

    def decisions(self) -> list[DecisionRow]:
        """Return all decisions, oldest first."""
        return self._rows(DecisionRow, (), ("decided_utc_s", "vessel_id", "decision_id"))

    def tasking(self) -> list[TaskingRow]:
        """Return all comments and commands, oldest first."""
        return self._rows(TaskingRow, (), ("issued_utc_s", "vessel_id", "kind", "record_id"))

    def _rows(self, row_type: type[Row], where: Iterable[Any], order: Sequence[str]) -> list[Row]:
        chosen = select_of(row_type).where(*where).order_by(*(TABLES[row_type].c[name] for name in order))
        with self.database.transaction(writing=False) as sql:
            found = sql.execute(chosen).all()
        return [row_of(row_type, each) for each in found]

    def read_files(self, vessel_id: str, name: str, suffixes: Sequence[str] = SUFFIXES) -> dict[str, bytes]:
        """Return the files of an image or a decision by suffix.

        Raises:
            StoredFileError: A file is missing or cannot be read.
        """
        if self.folder is not None:
            return {suffix: _read(self.folder / vessel_id / f"{name}{suffix}") for suffix in suffixes}
        chosen = sa.select(FILE.c.suffix, FILE.c.content).where(_is_image(FILE))
        with self.database.transaction(writing=False) as sql:
            rows = sql.execute(chosen, {"vessel": vessel_id, "name": name})
            found = {suffix: content for suffix, content in rows if suffix in suffixes}
        for suffix in suffixes:
            if suffix not in found:
                raise StoredFileError(self.database.where, "file", f"{vessel_id}/{name}{suffix}", "a stored file")
        return found

    def mark(self, column: MarkColumn, images: Iterable[ImageRow], at_utc_s: float) -> list[ImageRow]:
        """Mark images as exported or removed; return those that were not removed before.

        The files and numbers of removed ones are deleted.
        """
        rows = list(images)
        names = sorted((row.vessel_id, row.name) for row in rows)
        update = sa.update(IMAGE).values({column: at_utc_s}).where(_named(IMAGE), IMAGE.c.removed_utc_s.is_(None))
        marked: set[Name] = set()
        with self._lock:
            with self.database.transaction() as sql:
                for part in chunks(names):
                    returned = sql.execute(update.returning(IMAGE.c.vessel_id, IMAGE.c.name), {"names": part})
                    marked.update((vessel, name) for vessel, name in returned)
                if column == "removed_utc_s":
                    _delete(sql, FILE, names)
                    _delete(sql, RECORD, names)
            chosen = [row for row in rows if (row.vessel_id, row.name) in marked]
            if column == "removed_utc_s" and self.folder is not None:
                for row in chosen:
                    delete_image_files(self.folder, row)
        return chosen

    # Sizes and verification

    def oldest_utc_s(self) -> float | None:
        """Return when the oldest image that is not removed was accepted; None if there is none."""
        with self.database.transaction(writing=False) as sql:
            oldest: float | None = sql.execute(_OLDEST).scalar_one()
        return oldest

    def size_bytes(self) -> int:
        """Return the size of all images that are not removed, in bytes."""
        with self.database.transaction(writing=False) as sql:
            return int(sql.execute(_SIZE).scalar_one() or 0)

    def defect_counts(self) -> dict[str, int]:
        """Return the numbers of missing, changed, unreadable and conflicting images and decisions."""
        counts = dict.fromkeys(DEFECTS, 0)
        with self.database.transaction(writing=False) as sql:
            for faults in _FAULTS:
                for fault, count in sql.execute(faults):
                    counts[fault] += count
            counts["conflicting"] = sql.execute(_CONFLICTS).scalar_one()
        return counts

    def verify(self, now_utc_s: float, interval_s: float, cycle_s: float) -> list[Verified]:
        """Compare the files of some rows with their digests; return the results.

        Args:
            now_utc_s: Time of this call.
            interval_s: Interval of the calls.
            cycle_s: Time in which every row is compared once; those that wait longest are the first.
        """
        results: list[Verified] = []
        before_utc_s, share = now_utc_s - cycle_s, interval_s / cycle_s
        due: list[ImageRow | DecisionRow] = [*self._due(ImageRow, before_utc_s, share)]
        due += self._due(DecisionRow, before_utc_s, share)
        for row in due:
            # Without retention and new files in between, for one row at a time.
            with self._lock:
                fault = self._fault(row)
                if fault and isinstance(row, ImageRow) and self._is_removed(row):
                    continue
            results.append(Verified(row, fault))
        with self.database.transaction() as sql:
            for result in results:
                table = TABLES[type(result.row)]
                own = [table.c[c.name] == getattr(result.row, c.name) for c in table.primary_key]
                sql.execute(sa.update(table).where(*own).values(verified_utc_s=now_utc_s, fault=result.fault))
        return results

    def _due(self, row_type: type[Row], before_utc_s: float, share: float) -> list[Row]:
        table = TABLES[row_type]
        kept = [column.is_(None) for column in table.c if column.name == "removed_utc_s"]
        verified = table.c.verified_utc_s
        due = sa.or_(verified.is_(None), verified < before_utc_s)
        with self.database.transaction(writing=False) as sql:
            count = sql.execute(sa.select(sa.func.count()).select_from(table).where(*kept)).scalar_one()
            chosen = select_of(row_type).where(*kept, due).order_by(verified.nulls_first())
            found = sql.execute(chosen.limit(math.ceil(count * share))).all()
        return [row_of(row_type, each) for each in found]

    def _fault(self, row: ImageRow | DecisionRow) -> Fault:
        if self.folder is not None:
            return verify_files(self.folder, row)
        name = row.name if isinstance(row, ImageRow) else decision_name(row.decision_id)
        expected, found = set(row.files_sha256.split()), self.file_digests(row.vessel_id, name)
        return "" if found == expected else ("missing" if len(found) < len(expected) else "changed")

    def file_digests(self, vessel_id: str, name: str) -> set[str]:
        """Return the SHA-256 digests of the files of a name in a server, computed there now."""
        digest = sa.func.encode(sa.func.sha256(FILE.c.content), "hex")
        with self.database.transaction(writing=False) as sql:
            return set(
                sql.execute(sa.select(digest).where(_is_image(FILE)), {"vessel": vessel_id, "name": name}).scalars()
            )

    def _is_removed(self, row: ImageRow) -> bool:
        chosen = sa.select(IMAGE.c.removed_utc_s).where(_is_image(IMAGE))
        with self.database.transaction(writing=False) as sql:
            return sql.execute(chosen, {"vessel": row.vessel_id, "name": row.name}).scalar_one_or_none() is not None

    # Tasking

    def claim_tasking(self, row: TaskingRow, payload: bytes) -> bytes | None:
        """Claim a comment or a command for this c2, which alone sends it; return the record of another c2 that has it.

        Returns:
            None if this c2 has claimed the record, now or before. Otherwise the record that another c2 has under this
            identifier; empty if it is unknown.
        """
        with self.database.transaction() as sql:
            sql.execute(self._claim, values_of(row) | {"owner": self._owner, "payload": payload})
        return self.foreign_tasking(row.vessel_id, row.kind, row.record_id)

    def foreign_tasking(self, vessel_id: str, kind: str, record_id: str) -> bytes | None:
        """Return a comment or a command that another c2 has claimed; empty if only its row is known, None for none."""
        t = TASKING.c
        chosen = sa.select(t.payload).where(
            t.vessel_id == vessel_id, t.kind == kind, t.record_id == record_id, t.owner != self._owner
        )
        with self.database.transaction(writing=False) as sql:
            return sql.execute(chosen).scalar_one_or_none()


def _read(path: Path) -> bytes:
    try:
        return read_regular(path, MAX_FILE_BYTES)
    except OSError as error:
        raise StoredFileError(str(path), "", error.strerror or str(error), "a readable file of c2") from error


def _side_car(columns: sa.ColumnCollection[str, Any]) -> sa.ColumnElement[str]:
    """Return the digest of the JSON file, the first of `files_sha256`."""
    return sa.func.substr(columns.files_sha256, 1, 64)


def _is_image(table: sa.Table) -> sa.ColumnElement[bool]:
    return sa.and_(table.c.vessel_id == sa.bindparam("vessel"), table.c.name == sa.bindparam("name"))


def _named(table: sa.Table) -> sa.ColumnElement[bool]:
    """Return the condition that a row has one of the `names`."""
    return sa.tuple_(table.c.vessel_id, table.c.name).in_(sa.bindparam("names", expanding=True))


_IS_KEPT: Final = IMAGE.c.removed_utc_s.is_(None)
_OLDEST: Final = sa.select(sa.func.min(IMAGE.c.accepted_utc_s)).where(_IS_KEPT)
_SIZE: Final = sa.select(sa.func.sum(IMAGE.c.size_bytes)).where(_IS_KEPT)
_CONFLICTS: Final = sa.select(sa.func.count()).where(IMAGE.c.conflict, _IS_KEPT)
_FAULTS: Final = tuple(
    sa.select(table.c.fault, sa.func.count()).where(table.c.fault != "", kept).group_by(table.c.fault)
    for table, kept in ((IMAGE, _IS_KEPT), (DECISION, sa.true()))
)
_FIND_IMAGE: Final = sa.select(IMAGE.c.files_sha256, _IS_KEPT & (IMAGE.c.fault == "")).where(_is_image(IMAGE))
_FIND_DECISION: Final = sa.select(DECISION.c.files_sha256).where(
    DECISION.c.vessel_id == sa.bindparam("vessel"), DECISION.c.decision_id == sa.bindparam("decision")
)


def _delete(sql: sa.Connection, table: sa.Table, names: Sequence[Name]) -> None:
    """Delete the rows of files; a record without files has an empty name."""
    for part in chunks(names):
        sql.execute(sa.delete(table).where(_named(table), table.c.name != ""), {"names": part})
