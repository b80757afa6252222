"""Journal of a shore site in PostgreSQL: every accepted record of all its c2 under one sequence number.

It has the records and the order of `journal`. A c2 numbers records in the transaction that stores them. It locks the
row of `journal` with the last number until the commit, so numbers become visible in their order. The columns of
`record` and the searches are those of the journal in SQLite.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from itertools import count
from typing import Final

from sonarpost import wire
from sonarpost.archive.journal import (
    COLUMNS,
    MAX_REVIEWED,
    PAGE_COLUMNS,
    Accepted,
    Criteria,
    JournalRecord,
    JournalRow,
    conditions,
    journal_row,
    review_state,
)
from sonarpost.archive.postgresql import Sql
from sonarpost.messages import Decision

MAX_SEARCH_S: Final = 4.0
"""A search that takes longer is ended with an error; less than the time limit of the connection."""
BATCH: Final = 500
"""Records of an earlier journal that are copied with one statement."""

SCHEMA: Final = """
CREATE TABLE journal (archive text NOT NULL, last_seq bigint NOT NULL);
INSERT INTO journal VALUES (substr(replace(CAST(gen_random_uuid() AS text), '-', ''), 1, 8), 0);
CREATE TABLE record (
    seq bigint PRIMARY KEY, key text NOT NULL, digest bytea NOT NULL, encoding text NOT NULL, payload bytea NOT NULL,
    accepted_utc_s float8 NOT NULL, vessel_id text NOT NULL, vehicle_id text NOT NULL, image_id text NOT NULL,
    subject text NOT NULL, version bigint NOT NULL, lat_deg float8, lon_deg float8, name text NOT NULL,
    UNIQUE (key, digest));
CREATE INDEX record_subject ON record (key, subject, version);
CREATE INDEX record_image ON record (vessel_id, vehicle_id, image_id);
CREATE INDEX record_name ON record (vessel_id, name) WHERE name <> '';
CREATE INDEX record_accepted ON record (accepted_utc_s);
CREATE TABLE review (
    vessel_id text NOT NULL, vehicle_id text NOT NULL, image_id text NOT NULL, state text NOT NULL,
    PRIMARY KEY (vessel_id, vehicle_id, image_id));
"""

_WHERE: Final = "table record of the database"
_DECISION: Final = wire.encoding_of(Decision)


class SharedJournal:
    """The journal for queries.

    Every method raises DatabaseUnavailableError if the server is not reached, or the search takes too long.

    Args:
        transaction: Opens a transaction.
    """

    def __init__(self, transaction: Callable[[], AbstractContextManager[Sql]]) -> None:
        self._transaction = transaction

    def position(self) -> tuple[str, int]:
        """Return the identity of the journal and the highest number, 0 for none."""
        with self._transaction() as sql:
            archive, last = sql.rows("SELECT archive, last_seq FROM journal")[0]
        return str(archive), _int(last)

    def known_keys(self) -> list[str]:
        """Return the keys of all records."""
        with self._transaction() as sql:
            # One search in the index for each key, in place of a read of the whole table.
            found = sql.rows(
                "WITH RECURSIVE known AS (SELECT min(key) AS key FROM record UNION ALL"
                " SELECT (SELECT min(r.key) FROM record AS r WHERE r.key > known.key) FROM known WHERE key IS NOT NULL)"
                " SELECT key FROM known WHERE key IS NOT NULL"
            )
        return [str(key) for (key,) in found]

    def page(self, keys: Sequence[str], criteria: Criteria, after: int, limit: int) -> list[JournalRow]:
        """Return records in the order of their numbers; see `Journal.page`."""
        where, values = conditions(keys, criteria)
        numbers = count()
        condition = re.sub(r"\?", lambda _: f":v{next(numbers)}", " AND ".join(where))
        with self._transaction() as sql:
            sql.rows(f"SET LOCAL statement_timeout = '{MAX_SEARCH_S}s'")
            archive = str(sql.rows("SELECT archive FROM journal")[0][0])
            found = sql.rows(
                f"SELECT {PAGE_COLUMNS} FROM record AS r"  # noqa: S608 literals
                f" WHERE r.seq > :after AND {condition} ORDER BY r.seq LIMIT :limit",
                after=after,
                limit=limit,
                **{f"v{number}": value for number, value in enumerate(values)},
            )
        return [
            journal_row(
                Accepted(archive, _int(seq), _float(utc_s)), str(key), str(encoding), payload, str(vessel), str(name)
            )
            for seq, utc_s, key, encoding, payload, vessel, name in found
            if isinstance(payload, bytes)
        ]


def number(sql: Sql, records: Sequence[JournalRecord]) -> list[Accepted]:
    """Number records in the open transaction, which then has to end soon; see `Journal.append`.

    Args:
        sql: The transaction.
        records: The records, in the order of their numbers.
    """
    if not records:
        return []
    archive, last = _lock(sql)
    return _number(sql, archive, last, [(0, record) for record in records])


def adopt(sql: Sql, archive: str, last_seq: int, records: Sequence[tuple[int, JournalRecord]]) -> int:
    """Add the records of a c2's own journal, and return the number of added ones.

    An empty journal becomes that journal: identity and numbers stay. Otherwise the records get new numbers. Records
    that the journal has, and images that are not stored, are omitted.

    Args:
        sql: The transaction; it has all records or none.
        archive: Identity of the c2's own journal.
        last_seq: Its highest number.
        records: Its records with their numbers, in their order.
    """
    own, last = _lock(sql)
    if last == 0:
        sql.rows("UPDATE journal SET archive = :archive", archive=archive)
        own = archive
    added = 0
    for first in range(0, len(records), BATCH):
        batch = _stored(sql, records[first : first + BATCH])
        _, before = _lock(sql)
        numbered = _number(sql, own, before, [(seq if own == archive else 0, record) for seq, record in batch])
        added += len({accepted.seq for accepted in numbered if accepted.seq > before})
    if own == archive:
        sql.rows("UPDATE journal SET last_seq = :last WHERE last_seq < :last", last=last_seq)
    return added


def remove(sql: Sql, names: Iterable[tuple[str, str]]) -> None:
    """Remove the records of files that are deleted: pairs of vessel and file name."""
    pairs = list(names)
    sql.rows(
        "DELETE FROM record USING unnest(:vessels::text[], :names::text[]) AS k (vessel_id, name)"
        " WHERE record.vessel_id = k.vessel_id AND record.name = k.name AND record.name <> ''",
        vessels=[vessel for vessel, _ in pairs],
        names=[name for _, name in pairs],
    )


def _lock(sql: Sql) -> tuple[str, int]:
    """Return identity and last number; no other transaction numbers records before the end of this one."""
    archive, last = sql.rows("SELECT archive, last_seq FROM journal FOR UPDATE")[0]
    return str(archive), _int(last)


def _number(sql: Sql, archive: str, last: int, records: Sequence[tuple[int, JournalRecord]]) -> list[Accepted]:
    """Number records; each keeps its number if that is above all others, 0 for any."""
    known = _known(sql, [record for _, record in records])
    accepted: list[Accepted] = []
    new: list[tuple[int, JournalRecord]] = []
    # Within these records, the same rules as in `_known`.
    by_digest: dict[tuple[str, bytes], Accepted] = {}
    by_name: dict[tuple[str, str, str], Accepted] = {}
    for place, (kept, record) in enumerate(records):
        digest, name = (record.key, record.digest), (record.key, record.vessel_id, record.name)
        found = known.get(place) or by_digest.get(digest) or (by_name.get(name) if record.name else None)
        if found is None:
            last = max(last + 1, kept)
            found = Accepted(archive, last, record.accepted_utc_s)
            new.append((last, record))
        else:
            found = Accepted(archive, found.seq, found.utc_s)
        by_digest[digest] = by_name[name] = found
        accepted.append(found)
    if new:
        _insert(sql, new)
        sql.rows("UPDATE journal SET last_seq = :last", last=last)
        _review(sql, {_image(record) for _, record in new if record.encoding == _DECISION})
    return accepted


def _known(sql: Sql, records: Sequence[JournalRecord]) -> dict[int, Accepted]:
    """Return the numbers of records that the journal has, by their place."""
    found = sql.rows(
        "SELECT place, seq, accepted_utc_s FROM unnest(:places::int[], :keys::text[], :digests::bytea[])"
        " AS k (place, key, digest) JOIN record USING (key, digest)"
        " UNION SELECT place, seq, accepted_utc_s FROM unnest(:places::int[], :keys::text[], :vessels::text[],"
        # Its files identify an image, also if it was added from them with less than the record has.
        " :names::text[]) AS k (place, key, vessel_id, name) JOIN record USING (key, vessel_id, name)"
        " WHERE record.name <> ''",
        places=list(range(len(records))),
        keys=[record.key for record in records],
        digests=[record.digest for record in records],
        vessels=[record.vessel_id for record in records],
        names=[record.name for record in records],
    )
    return {_int(place): Accepted("", _int(seq), _float(utc_s)) for place, seq, utc_s in found}


def _stored(sql: Sql, records: Sequence[tuple[int, JournalRecord]]) -> list[tuple[int, JournalRecord]]:
    """Return the records without images that are not stored."""
    found = sql.rows(
        "SELECT vessel_id, name FROM image JOIN unnest(:vessels::text[], :names::text[]) AS k (vessel_id, name)"
        " USING (vessel_id, name) WHERE removed_utc_s IS NULL",
        vessels=[record.vessel_id for _, record in records],
        names=[record.name for _, record in records],
    )
    names = {(str(vessel), str(name)) for vessel, name in found}
    return [(seq, r) for seq, r in records if not r.name or (r.vessel_id, r.name) in names]


def _insert(sql: Sql, records: Sequence[tuple[int, JournalRecord]]) -> None:
    rows = []
    for seq, record in records:
        contents = {"digest": f"\\x{record.digest.hex()}", "payload": f"\\x{record.payload.hex()}"}
        rows.append({"seq": seq} | record._asdict() | contents)
    sql.rows(
        f"INSERT INTO record (seq, {COLUMNS}) SELECT seq, {COLUMNS}"  # noqa: S608 literals
        # Without the schema, `record` is a pseudo-type.
        " FROM jsonb_populate_recordset(NULL::sonarpost.record, :rows::jsonb)",
        rows=json.dumps(rows),
    )


def _image(record: JournalRecord) -> tuple[str, str, str]:
    return record.vessel_id, record.vehicle_id, record.image_id


def _review(sql: Sql, images: Iterable[tuple[str, str, str]]) -> None:
    """Store the results of the decisions on images."""
    for vessel, vehicle, image_id in sorted(images):
        values = {"vessel": vessel, "vehicle": vehicle, "image": image_id}
        rows = sql.rows(
            "SELECT payload FROM record WHERE encoding = :encoding AND vessel_id = :vessel AND vehicle_id = :vehicle"
            " AND image_id = :image ORDER BY seq DESC LIMIT :limit",
            encoding=_DECISION,
            limit=MAX_REVIEWED,
            **values,
        )
        sql.rows(
            "INSERT INTO review VALUES (:vessel, :vehicle, :image, :state)"
            " ON CONFLICT (vessel_id, vehicle_id, image_id) DO UPDATE SET state = EXCLUDED.state",
            state=review_state([payload for (payload,) in rows if isinstance(payload, bytes)], _WHERE),
            **values,
        )


def _int(value: object) -> int:
    return int(str(value))


def _float(value: object) -> float:
    return float(str(value))
