"""Records of a shore site in PostgreSQL with PostGIS: images with their files, decisions, tasking, accepted records.

The numbers of records for queries are in tables of `shared_journal`, in the same schema.

Several c2 of one site share a database. Unique keys and digests make every write idempotent: the same record again is
a repetition; another content under the same key is not written. Migrations, retention and verification hold advisory
locks.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from itertools import accumulate

from pydantic import TypeAdapter

from sonarpost.archive import shared_journal, shore_schema
from sonarpost.archive.journal import Accepted, Journal, JournalRecord
from sonarpost.archive.postgresql import ConnectionPool, Sql
from sonarpost.archive.shore_index import DEFECTS, DecisionRow, Fault, ImageRow, MarkColumn, Row, TaskingRow, Verified
from sonarpost.errors import ConfigError, DatabaseUnavailableError, StoredFileError

_RETENTION_LOCK = 0x736F6E61725F02
_VERIFICATION_LOCK = 0x736F6E61725F03
_TABLES: dict[type, str] = {ImageRow: "image", DecisionRow: "decision", TaskingRow: "tasking"}


@dataclass(frozen=True, slots=True)
class StoredImage:
    """An image as it is written: row, and content of its files by suffix, the JSON side-car first."""

    row: ImageRow
    files: tuple[tuple[str, bytes], ...]


@dataclass(frozen=True, slots=True)
class BacklogRecord:
    """A record that a c2 has acknowledged and not handled yet."""

    key: str
    payload: bytes

    @property
    def sha256(self) -> bytes:
        """Digest of the payload."""
        return hashlib.sha256(self.payload).digest()


class ShoreDatabase:
    """Archive of one site in PostgreSQL, for several threads.

    The schema is created by the first transaction. Every method raises DatabaseUnavailableError if the
    server is not reached, and can be called again.

    Args:
        database: Connections to the database.
        owner: Identity of this c2; empty for a command.
        site: Name of the site, stored at the first use and compared afterwards; empty for any.
        writable: Whether to create the schema.
    """

    def __init__(self, database: ConnectionPool, *, owner: str = "", site: str = "", writable: bool = True) -> None:
        self.database = database
        self._owner = owner
        self._site = site
        self._writable = writable
        self._is_prepared = False

    def prepare(self) -> None:
        """Create the schema, or check its version.

        Raises:
            DatabaseUnavailableError: The server is not reached, or PostGIS is missing.
            StoredFileError: The schema has another version.
            ConfigError: The database belongs to another site, or there is no driver.
        """
        if self._is_prepared:
            return
        where = str(self.database.address)
        with self.database.transaction() as sql:
            if self._writable:
                shore_schema.create(sql, where)
            else:
                shore_schema.check_version(sql, where)
            if self._site:
                shore_schema.check_site(sql, where, self._site)
        self._is_prepared = True

    @contextmanager
    def _transaction(self) -> Iterator[Sql]:
        try:
            self.prepare()
        except (StoredFileError, ConfigError) as error:
            # Reported at the start; a database that was replaced since then is an outage.
            self.database.fault = str(error)
            raise DatabaseUnavailableError(str(error)) from error
        with self.database.transaction() as sql:
            yield sql

    def close(self) -> None:
        """Close the connections."""
        self.database.close()

    # Images and decisions

    def find_side_car(self, vessel_id: str, name: str) -> tuple[str, bool] | None:
        """Return the SHA-256 digest of an image's JSON file, and whether its files are stored; None for no image."""
        with self._transaction() as sql:
            found = sql.rows(
                "SELECT split_part(files_sha256, ' ', 1), removed_utc_s IS NULL AND fault = '' FROM image"
                " WHERE vessel_id = :vessel AND name = :name",
                vessel=vessel_id,
                name=name,
            )
        return (str(found[0][0]), bool(found[0][1])) if found else None

    def find_decision(self, vessel_id: str, decision_id: str) -> str | None:
        """Return the SHA-256 digest of a decision's content; None if there is none."""
        with self._transaction() as sql:
            found = sql.rows(
                "SELECT files_sha256 FROM decision WHERE vessel_id = :vessel AND decision_id = :decision",
                vessel=vessel_id,
                decision=decision_id,
            )
        return str(found[0][0]) if found else None

    def write(
        self,
        images: Sequence[StoredImage],
        decisions: Sequence[tuple[DecisionRow, bytes]] = (),
        handled: Sequence[BacklogRecord] = (),
        numbered: Sequence[JournalRecord] = (),
    ) -> list[Accepted]:
        """Write images and decisions, delete handled records from the accepted ones, number records: all or nothing.

        Args:
            images: Images with their files; each name once. Stored ones with the same JSON file are repaired.
            decisions: Decisions with their content; each identifier once.
            handled: Accepted records whose effects these are.
            numbered: Records for the journal, in the order of their numbers.

        Returns:
            Numbers of the records for the journal.

        Raises:
            DatabaseUnavailableError: Nothing is written. Also if another c2 has written another content under one of
                the names at the same time: the next search finds it.
        """
        with self._transaction() as sql:
            if images:
                self._write_images(sql, images)
            if decisions:
                self._write_decisions(sql, decisions)
            if handled:
                self._delete_accepted(sql, handled)
            # At last, because other c2 wait for it until the commit.
            return shared_journal.number(sql, numbered)

    def _write_images(self, sql: Sql, images: Sequence[StoredImage]) -> None:
        names = ", ".join(_names(ImageRow))
        written = sql.number(
            f"WITH written AS (INSERT INTO image ({names})"  # noqa: S608 names of fields
            f" SELECT {names} FROM jsonb_populate_recordset(NULL::image, :rows::jsonb) ORDER BY vessel_id, name"
            " ON CONFLICT (vessel_id, name) DO UPDATE SET removed_utc_s = EXCLUDED.removed_utc_s, fault = '',"
            " files_sha256 = EXCLUDED.files_sha256, size_bytes = EXCLUDED.size_bytes"
            " WHERE split_part(image.files_sha256, ' ', 1) = split_part(EXCLUDED.files_sha256, ' ', 1)"
            " RETURNING 1) SELECT count(*) FROM written",
            rows=_json([image.row for image in images]),
        )
        if written != len(images):
            raise DatabaseUnavailableError("another c2 has stored another image under the same name; trying again")
        files = sorted((i.row.vessel_id, i.row.name, suffix, data) for i in images for suffix, data in i.files)
        if not files:
            return  # removed images of a migrated archive
        sql.rows(
            "INSERT INTO file SELECT * FROM unnest(:vessels::text[], :names::text[], :suffixes::text[],"
            " :contents::bytea[]) ON CONFLICT (vessel_id, name, suffix) DO UPDATE SET content = EXCLUDED.content",
            vessels=[file[0] for file in files],
            names=[file[1] for file in files],
            suffixes=[file[2] for file in files],
            contents=[file[3] for file in files],
        )

    def _write_decisions(self, sql: Sql, decisions: Sequence[tuple[DecisionRow, bytes]]) -> None:
        names = ", ".join(_names(DecisionRow))
        ordered = sorted(decisions, key=lambda each: (each[0].vessel_id, each[0].decision_id))
        written = sql.number(
            f"WITH written AS (INSERT INTO decision ({names}, content)"  # noqa: S608 names of fields
            f" SELECT {names}, content FROM jsonb_populate_recordset(NULL::decision, :rows::jsonb)"
            " ON CONFLICT (vessel_id, decision_id) DO UPDATE SET fault = '', content = EXCLUDED.content"
            " WHERE decision.files_sha256 = EXCLUDED.files_sha256"
            " RETURNING 1) SELECT count(*) FROM written",
            rows=_json([row for row, _ in ordered], [f"\\x{content.hex()}" for _, content in ordered]),
        )
        if written != len(decisions):
            raise DatabaseUnavailableError("another c2 has stored another decision under the same identifier")

    def file_digests(self, rows: Sequence[ImageRow]) -> dict[tuple[str, str], dict[str, str]]:
        """Return the SHA-256 digests of the stored files, computed now, by vessel and name, then by suffix."""
        digests: dict[tuple[str, str], dict[str, str]] = {}
        with self._transaction() as sql:
            for vessel, name, suffix, digest in sql.rows(
                "SELECT vessel_id, name, suffix, encode(sha256(content), 'hex') FROM file"
                " JOIN unnest(:vessels::text[], :names::text[]) AS k (vessel_id, name) USING (vessel_id, name)",
                vessels=[row.vessel_id for row in rows],
                names=[row.name for row in rows],
            ):
                digests.setdefault((str(vessel), str(name)), {})[str(suffix)] = str(digest)
        return digests

    def images(self, *, removed: bool = False) -> list[ImageRow]:
        """Return all versions of all images, oldest first; removed ones only if `removed`."""
        where = "" if removed else "WHERE removed_utc_s IS NULL"
        return self._rows(ImageRow, f"{where} ORDER BY first_frame_utc_s, vessel_id, name")

    def decisions(self) -> list[DecisionRow]:
        """Return all decisions, oldest first."""
        return self._rows(DecisionRow, "ORDER BY decided_utc_s, vessel_id, decision_id")

    def decision_content(self, row: DecisionRow) -> bytes:
        """Return the JSON content of a decision."""
        with self._transaction() as sql:
            found = sql.rows(
                "SELECT content FROM decision WHERE vessel_id = :vessel AND decision_id = :decision",
                vessel=row.vessel_id,
                decision=row.decision_id,
            )
        return _bytes(found[0][0])

    def image_files(self, vessel_id: str, name: str) -> dict[str, bytes]:
        """Return the files of an image by suffix; empty if they are removed."""
        with self._transaction() as sql:
            found = sql.rows(
                "SELECT suffix, content FROM file WHERE vessel_id = :vessel AND name = :name",
                vessel=vessel_id,
                name=name,
            )
        return {str(suffix): _bytes(content) for suffix, content in found}

    def mark(self, column: MarkColumn, images: Iterable[ImageRow], at_utc_s: float) -> None:
        """Mark images as exported or removed; the files of removed ones are deleted."""
        rows = sorted((row.vessel_id, row.name) for row in images)
        with self._transaction() as sql:
            self._mark(sql, column, rows, at_utc_s)

    def _mark(self, sql: Sql, column: MarkColumn, rows: Sequence[tuple[str, str]], at_utc_s: float) -> None:
        values = {"vessels": [row[0] for row in rows], "names": [row[1] for row in rows]}
        keys = "unnest(:vessels::text[], :names::text[]) AS k (vessel_id, name)"
        if column == "removed_utc_s":
            matching = "file.vessel_id = k.vessel_id AND file.name = k.name"
            sql.rows(f"DELETE FROM file USING {keys} WHERE {matching}", **values)  # noqa: S608 literals
            shared_journal.remove(sql, rows)
        sql.rows(
            f"UPDATE image SET {column} = :at FROM {keys}"  # noqa: S608 literals
            " WHERE image.vessel_id = k.vessel_id AND image.name = k.name",
            at=at_utc_s,
            **values,
        )

    # Journal

    def journal(self) -> shared_journal.SharedJournal:
        """Return the journal for queries."""
        return shared_journal.SharedJournal(self._transaction)

    def adopt_journal(self, own: Journal) -> int:
        """Copy the records of a c2's own journal into the shared one, and return their number; see `adopt`.

        Raises:
            OSError: The own journal cannot be read.
        """
        archive, last = own.position()
        with self._transaction() as sql:
            return shared_journal.adopt(sql, archive, last, own.records())

    def images_without_number(self) -> list[ImageRow]:
        """Return the stored images that are not in the journal, oldest first."""
        return self._rows(
            ImageRow,
            "WHERE removed_utc_s IS NULL AND NOT EXISTS (SELECT 1 FROM record AS r WHERE r.name <> ''"
            " AND r.vessel_id = image.vessel_id AND r.name = image.name) ORDER BY accepted_utc_s, vessel_id, name",
        )

    def decisions_without_number(self, key: str) -> list[DecisionRow]:
        """Return the decisions that are not in the journal, oldest first; `key` is their key, `*` for the vessel."""
        with self._transaction() as sql:
            return _select(
                sql,
                DecisionRow,
                "WHERE NOT EXISTS (SELECT 1 FROM record AS r WHERE r.key = replace(:key, '*', decision.vessel_id)"
                " AND r.subject = decision.decision_id) ORDER BY accepted_utc_s, vessel_id, decision_id",
                key=key,
            )

    # Retention and verification

    def remove_selected(
        self, select: Callable[[list[ImageRow], list[DecisionRow]], list[ImageRow]], at_utc_s: float
    ) -> list[ImageRow]:
        """Remove the images that `select` chooses of all, and return them; none while another c2 does this."""
        with self._transaction() as sql:
            if not _try_lock(sql, _RETENTION_LOCK):
                return []
            # The selection of a large archive takes long.
            sql.rows("SET LOCAL idle_in_transaction_session_timeout = '120s'")
            rows = select(_select(sql, ImageRow, "WHERE removed_utc_s IS NULL"), _select(sql, DecisionRow, ""))
            if rows:
                self._mark(sql, "removed_utc_s", [(row.vessel_id, row.name) for row in rows], at_utc_s)
        return rows

    def oldest_utc_s(self) -> float | None:
        """Return when the oldest image that is not removed was accepted; None if there is none."""
        with self._transaction() as sql:
            value = sql.rows("SELECT min(accepted_utc_s) FROM image WHERE removed_utc_s IS NULL")[0][0]
        return None if value is None else float(str(value))

    def size_bytes(self) -> int:
        """Return the size of all images that are not removed, in bytes."""
        with self._transaction() as sql:
            return sql.number("SELECT coalesce(sum(size_bytes), 0) FROM image WHERE removed_utc_s IS NULL")

    def defect_counts(self) -> dict[str, int]:
        """Return the numbers of missing, changed, unreadable and conflicting images and decisions."""
        counts = dict.fromkeys(DEFECTS, 0)
        with self._transaction() as sql:
            for fault, count in sql.rows(
                "SELECT fault, count(*) FROM (SELECT fault FROM image WHERE fault <> '' AND removed_utc_s IS NULL"
                " UNION ALL SELECT fault FROM decision WHERE fault <> '') AS faults GROUP BY fault"
            ):
                counts[str(fault)] += int(str(count))
            counts["conflicting"] = sql.number("SELECT count(*) FROM image WHERE conflict AND removed_utc_s IS NULL")
        return counts

    def verify(self, now_utc_s: float, interval_s: float, cycle_s: float) -> list[Verified]:
        """Compare some of the contents with their digests on the server; return the results, none while another does.

        Args:
            now_utc_s: Time of this call.
            interval_s: Interval of the calls.
            cycle_s: Time in which every record is compared once.
        """
        results: list[Verified] = []
        with self._transaction() as sql:
            if not _try_lock(sql, _VERIFICATION_LOCK):
                return []
            images = sql.number("SELECT count(*) FROM image WHERE removed_utc_s IS NULL")
            decisions = sql.number("SELECT count(*) FROM decision")
            due = (
                "(verified_utc_s IS NULL OR verified_utc_s < :before) ORDER BY verified_utc_s NULLS FIRST LIMIT :limit"
            )
            values = {"before": now_utc_s - cycle_s, "limit": math.ceil(images * interval_s / cycle_s)}
            for row in _select(sql, ImageRow, f"WHERE removed_utc_s IS NULL AND {due}", **values):
                found = sql.rows(
                    "SELECT suffix, encode(sha256(content), 'hex') FROM file"
                    " WHERE vessel_id = :vessel AND name = :name",
                    vessel=row.vessel_id,
                    name=row.name,
                )
                results.append(_compare(row, {str(digest) for _, digest in found}))
            values["limit"] = math.ceil(decisions * interval_s / cycle_s)
            for decision in _select(sql, DecisionRow, f"WHERE {due}", **values):
                digest = sql.rows(
                    "SELECT encode(sha256(content), 'hex') FROM decision"
                    " WHERE vessel_id = :vessel AND decision_id = :decision",
                    vessel=decision.vessel_id,
                    decision=decision.decision_id,
                )[0][0]
                results.append(_compare(decision, {str(digest)}))
            for result in results:
                table, name = ("image", "name") if isinstance(result.row, ImageRow) else ("decision", "decision_id")
                sql.rows(
                    f"UPDATE {table} SET verified_utc_s = :at, fault = :fault"  # noqa: S608 literals
                    f" WHERE vessel_id = :vessel AND {name} = :name",
                    at=now_utc_s,
                    fault=result.fault,
                    vessel=result.row.vessel_id,
                    name=getattr(result.row, name),
                )
        return results

    # Tasking

    def claim_tasking(self, row: TaskingRow, payload: bytes) -> bytes | None:
        """Claim a comment or a command for this c2, which alone sends it; return the record of another c2 that has it.

        Returns:
            None if this c2 has claimed the record, now or before. Otherwise the record that another c2 has under this
            identifier; empty if it is unknown.
        """
        names = ", ".join(_names(TaskingRow))
        with self._transaction() as sql:
            sql.rows(
                f"INSERT INTO tasking ({names}, owner, payload) SELECT {names}, :owner, :payload::bytea"  # noqa: S608
                " FROM jsonb_populate_recordset(NULL::tasking, :rows::jsonb) ON CONFLICT DO NOTHING",
                owner=self._owner,
                payload=payload,
                rows=_json([row]),
            )
        return self.foreign_tasking(row.vessel_id, row.kind, row.record_id)

    def foreign_tasking(self, vessel_id: str, kind: str, record_id: str) -> bytes | None:
        """Return a comment or a command that another c2 has claimed; empty if only its row is known, None for none."""
        with self._transaction() as sql:
            found = sql.rows(
                "SELECT payload FROM tasking WHERE vessel_id = :vessel AND kind = :kind AND record_id = :record"
                " AND owner <> :owner",
                vessel=vessel_id,
                kind=kind,
                record=record_id,
                owner=self._owner,
            )
        return _bytes(found[0][0]) if found else None

    def put_tasking(self, rows: Sequence[TaskingRow]) -> None:
        """Write the states of comments and commands; an older state does not replace a newer one."""
        names = ", ".join(_names(TaskingRow))
        with self._transaction() as sql:
            sql.rows(
                f"INSERT INTO tasking ({names}, owner, payload) SELECT {names}, :owner, ''::bytea"  # noqa: S608
                " FROM jsonb_populate_recordset(NULL::tasking, :rows::jsonb) ORDER BY vessel_id, kind, record_id"
                " ON CONFLICT (vessel_id, kind, record_id) DO UPDATE SET state = EXCLUDED.state,"
                " reason = EXCLUDED.reason, changed_utc_s = EXCLUDED.changed_utc_s,"
                " owner = CASE WHEN tasking.owner = '' THEN EXCLUDED.owner ELSE tasking.owner END"
                " WHERE tasking.changed_utc_s <= EXCLUDED.changed_utc_s",
                owner=self._owner,
                rows=_json(rows),
            )

    def tasking(self) -> list[TaskingRow]:
        """Return all comments and commands, oldest first."""
        return self._rows(TaskingRow, "ORDER BY issued_utc_s, vessel_id, kind, record_id")

    # Accepted records

    def accept(self, records: Sequence[BacklogRecord]) -> None:
        """Commit records that are acknowledged afterwards."""
        with self._transaction() as sql:
            sql.rows(
                "INSERT INTO accepted (key, sha256, payload, owner) SELECT key, sha256, payload, :owner"
                " FROM unnest(:keys::text[], :digests::bytea[], :payloads::bytea[]) AS r (key, sha256, payload)"
                " ORDER BY key, sha256 ON CONFLICT DO NOTHING",
                owner=self._owner,
                keys=[record.key for record in records],
                digests=[record.sha256 for record in records],
                payloads=[record.payload for record in records],
            )

    def discard(self, record: BacklogRecord) -> None:
        """Delete an accepted record that cannot be handled."""
        with self._transaction() as sql:
            self._delete_accepted(sql, [record])

    def _delete_accepted(self, sql: Sql, records: Sequence[BacklogRecord]) -> None:
        sql.rows(
            "DELETE FROM accepted USING unnest(:keys::text[], :digests::bytea[]) AS k (key, sha256)"
            " WHERE accepted.key = k.key AND accepted.sha256 = k.sha256",
            keys=[record.key for record in records],
            digests=[record.sha256 for record in records],
        )

    def take_over(
        self, age_s: float, limit: int, limit_bytes: int, store: Callable[[list[BacklogRecord]], None]
    ) -> int:
        """Take over records of other c2 that do not call this method any more; return their number.

        Args:
            age_s: Least age of the records, and time since the last call of their c2, by the clock of the server.
            limit: Maximum number of records.
            limit_bytes: Maximum size of their payloads, at least one record.
            store: Stores the records durably at this c2; called before they are assigned to it.
        """
        with self._transaction() as sql:
            sql.rows(
                "INSERT INTO member VALUES (:owner, clock_timestamp())"
                " ON CONFLICT (owner) DO UPDATE SET seen_at = clock_timestamp()",
                owner=self._owner,
            )
        with self._transaction() as sql:
            found = sql.rows(
                "SELECT key, sha256, octet_length(payload) FROM accepted WHERE owner <> :owner"
                " AND NOT EXISTS (SELECT 1 FROM member WHERE member.owner = accepted.owner"
                " AND seen_at >= clock_timestamp() - :age * interval '1 second')"
                " AND accepted_at < clock_timestamp() - :age * interval '1 second'"
                " ORDER BY accepted_at LIMIT :limit FOR UPDATE SKIP LOCKED",
                owner=self._owner,
                age=age_s,
                limit=limit,
            )
            totals = accumulate(int(str(size)) for _, _, size in found)
            chosen = found[: max(1, sum(total <= limit_bytes for total in totals))]
            found = sql.rows(
                "SELECT key, payload FROM unnest(:keys::text[], :digests::bytea[]) AS k (key, sha256)"
                " JOIN accepted USING (key, sha256) ORDER BY accepted_at",
                keys=[key for key, _, _ in chosen],
                digests=[digest for _, digest, _ in chosen],
            )
            records = [BacklogRecord(str(key), _bytes(payload)) for key, payload in found]
            if records:
                store(records)
                sql.rows(
                    "UPDATE accepted SET owner = :owner, accepted_at = clock_timestamp()"
                    " FROM unnest(:keys::text[], :digests::bytea[]) AS k (key, sha256)"
                    " WHERE accepted.key = k.key AND accepted.sha256 = k.sha256",
                    owner=self._owner,
                    keys=[record.key for record in records],
                    digests=[record.sha256 for record in records],
                )
        return len(records)

    def accepted_count(self) -> int:
        """Return the number of accepted records of all c2 that are not handled."""
        with self._transaction() as sql:
            return sql.number("SELECT count(*) FROM accepted")

    def _rows(self, row_type: type[Row], rest: str) -> list[Row]:
        with self._transaction() as sql:
            return _select(sql, row_type, rest)


def _select(sql: Sql, row_type: type[Row], rest: str, **values: object) -> list[Row]:
    names = _names(row_type)
    found = sql.rows(f"SELECT {', '.join(names)} FROM {_TABLES[row_type]} {rest}", **values)  # noqa: S608 literals
    adapter = TypeAdapter(row_type)
    return [adapter.validate_python(dict(zip(names, row, strict=True))) for row in found]


def _names(row_type: type[Row]) -> tuple[str, ...]:
    return tuple(each.name for each in fields(row_type))


def _json(rows: Sequence[Row], contents: Sequence[str] | None = None) -> str:
    """Return rows as JSON for `jsonb_populate_recordset`. PostgreSQL stores no NUL in text."""
    cleaned = [
        {
            name: value.replace("\0", "\ufffd") if isinstance(value, str) else value
            for name, value in asdict(row).items()
        }
        for row in rows
    ]
    if contents is not None:
        for each, content in zip(cleaned, contents, strict=True):
            each["content"] = content
    return json.dumps(cleaned)


def _try_lock(sql: Sql, lock: int) -> bool:
    return bool(sql.rows("SELECT pg_try_advisory_xact_lock(:lock)", lock=lock)[0][0])


def _compare(row: ImageRow | DecisionRow, found: set[str]) -> Verified:
    expected = set(row.files_sha256.split())
    fault: Fault = "" if found == expected else ("missing" if len(found) < len(expected) else "changed")
    return Verified(row, fault)


def _bytes(value: object) -> bytes:
    if not isinstance(value, bytes):
        raise TypeError(f"got {type(value).__name__}, expected bytes")
    return value
