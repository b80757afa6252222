"""Journal of a shore site: every accepted record under one sequence number, for queries of subscribers.

A row of the table `record` holds the payload as it was published, an image without its pixels: those are in its files.
Numbers count up and are never used again, so that the highest number that a client has received is a cursor. A number
is committed before it is published, and does not become visible while a lower one is not committed yet: every
transaction that numbers records locks the row of the table `archive` with the last number.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import msgpack
import sqlalchemy as sa
from sqlalchemy.sql import ColumnElement

from sonarpost import wire
from sonarpost.archive.database import ShoreDatabase
from sonarpost.archive.schema import ARCHIVE, RECORD, REVIEW
from sonarpost.limits import limit
from sonarpost.messages import Contact, Decision, Record
from sonarpost.review.decisions import ReviewState, review_result

MAX_REVIEWED: Final = limit(
    1000, "decisions", "shares", "journal of c2", "vessel", "decisions on an image for its state", "the newest count"
)
DIGEST_BYTES: Final = 16
COMPRESSION_WINDOW_BITS: Final = 12
"""4 KiB: to clear the largest window takes longer than to compress a record."""
_DECISION: Final = wire.encoding_of(Decision)


@dataclass(slots=True)
class JournalEntry:
    """A record to number.

    Attributes:
        key: Key on which it is published.
        record: The record.
        vessel_id: Its vessel.
        vehicle_id: Its vehicle; empty if it has none.
        image_id: The image that it is about; empty if it is about none.
        subject: What its versions have in common, within `key`.
        version: Its version; of equal versions the one with the highest number is the latest.
        contact: The contact with its position, if it has one.
        name: Name of its files without suffix, if its pixels are in files; else empty.
        payload: Its payload as it is published, without its number; made from the record if it is not known.
        fields: Its payload as a map.
    """

    key: str
    record: Record
    vessel_id: str
    vehicle_id: str = ""
    image_id: str = ""
    subject: str = ""
    version: int = 0
    contact: Contact | None = None
    name: str = ""
    payload: bytes = field(default=b"", repr=False)
    fields: dict[str, Any] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.fields = wire.map_of(self.record)
        self.payload = self.payload or msgpack.packb(self.fields, use_bin_type=True)

    def columns(self, accepted_utc_s: float) -> dict[str, Any]:
        """Return the columns of the record, without its number, if it is accepted at this time.

        `digest` is of the payload as it is published; with the key, it identifies the record. `payload` is without the
        pixels that its files hold, compressed with zlib.
        """
        stored = self.payload
        if self.name:
            stored = msgpack.packb({**self.fields, "pixels": {**self.fields["pixels"], "data": b""}}, use_bin_type=True)
        return {
            "key": self.key,
            "digest": hashlib.sha256(self.payload).digest()[:DIGEST_BYTES],
            "encoding": wire.encoding_of(type(self.record)),
            "payload": zlib.compress(stored, wbits=COMPRESSION_WINDOW_BITS),
            "accepted_utc_s": accepted_utc_s,
            "vessel_id": self.vessel_id,
            "vehicle_id": self.vehicle_id,
            "image_id": self.image_id,
            "subject": self.subject,
            "version": self.version,
            "lat_deg": self.contact.lat_deg if self.contact else None,
            "lon_deg": self.contact.lon_deg if self.contact else None,
            "name": self.name,
        }


@dataclass(frozen=True, slots=True)
class Accepted:
    """Number and time of an accepted record.

    Attributes:
        archive: Identity of the journal; numbers of another journal have no relation to these.
        seq: Number.
        utc_s: Time of acceptance by the shore's clock.
    """

    archive: str
    seq: int
    utc_s: float


@dataclass(frozen=True, slots=True)
class JournalRow:
    """A numbered record.

    Attributes:
        accepted: Number and time.
        key: Key on which it was published.
        encoding: Its Zenoh encoding.
        fields: Its payload as a map; `data` of the pixels is empty if `name` is not.
        vessel_id: Its vessel.
        name: Name of the files with its pixels; empty if `fields` is complete.
    """

    accepted: Accepted
    key: str
    encoding: str
    fields: dict[str, object]
    vessel_id: str
    name: str


@dataclass(frozen=True, slots=True)
class Area:
    """A box of positions, in degrees; `west_deg` above `east_deg` crosses the meridian of 180°."""

    south_deg: float
    west_deg: float
    north_deg: float
    east_deg: float


@dataclass(frozen=True, slots=True)
class Criteria:
    """Which records a page holds; None stands for all.

    Attributes:
        since_utc_s: Earliest time of acceptance.
        until_utc_s: First time of acceptance that is excluded.
        vessel_id: Vessel.
        vehicle_id: Vehicle.
        area: Area of the contact that the record is about.
        review: Result of the decisions on the contact that the record is about.
        latest: Only the latest version of each subject.
    """

    since_utc_s: float | None = None
    until_utc_s: float | None = None
    vessel_id: str | None = None
    vehicle_id: str | None = None
    area: Area | None = None
    review: ReviewState | None = None
    latest: bool = False


class Journal:
    """The journal in a database; for several threads.

    Every method raises OSError or DatabaseUnavailableError if the database cannot be used.
    """

    def __init__(self, database: ShoreDatabase) -> None:
        self._database = database
        key = (REVIEW.c.vessel_id, REVIEW.c.vehicle_id, REVIEW.c.image_id)
        insert = database.insert(REVIEW)
        self._put_records = database.insert(RECORD)
        self._put_state = insert.on_conflict_do_update(index_elements=key, set_={"state": insert.excluded.state})

    # For queries

    def position(self) -> tuple[str, int]:
        """Return the identity of the journal and the highest number, 0 for none."""
        with self._database.transaction(writing=False) as sql:
            identity, last = sql.execute(_POSITION).one()
        return identity, last

    def known_keys(self) -> list[str]:
        """Return the keys of all records."""
        with self._database.transaction(writing=False) as sql:
            return list(sql.execute(_KNOWN_KEYS).scalars())

    def page(self, keys: Sequence[str], criteria: Criteria, after: int, limit: int) -> list[JournalRow]:
        """Return records in the order of their numbers.

        Args:
            keys: Their keys.
            criteria: Further conditions.
            after: Highest number that is excluded.
            limit: Maximum number of records.
        """
        chosen = _PAGE.where(_R.c.seq > after, *conditions(keys, criteria)).order_by(_R.c.seq).limit(limit)
        with self._database.search() as sql:
            identity = sql.execute(_POSITION).one().identity
            found = sql.execute(chosen).all()
        return [
            JournalRow(
                Accepted(identity, row.seq, row.accepted_utc_s),
                row.key,
                row.encoding,
                wire.unpack_map(zlib.decompress(row.payload), row.key),
                row.vessel_id,
                row.name,
            )
            for row in found
        ]

    def all_columns(self, count: int) -> Iterator[list[dict[str, Any]]]:
        """Yield the columns of all records in the order of their numbers, so many at a time."""
        after = 0
        while True:
            with self._database.transaction(writing=False) as sql:
                chosen = sa.select(RECORD).where(RECORD.c.seq > after).order_by(RECORD.c.seq).limit(count)
                records = [row._asdict() for row in sql.execute(chosen)]
            if not records:
                return
            yield records
            after = records[-1]["seq"]

    # In an open transaction, which then has to end soon: others that number records wait for it

    def number(self, sql: sa.Connection, records: Sequence[dict[str, Any]]) -> list[Accepted]:
        """Number records, and store the results of the decisions among them.

        A record with the same key and payload or files keeps the number that it has.

        Args:
            sql: The transaction.
            records: Columns of the records, in the order of their numbers; one with `seq` keeps that number if it is
                above all others.
        """
        if not records:
            return []
        identity, last = sql.execute(_LOCKED_POSITION).one()
        by_digest, by_name = _known(sql, records)
        accepted: list[Accepted] = []
        new: list[dict[str, Any]] = []
        for record in records:
            digest = (record["key"], record["digest"])
            # Its files identify an image, also if it was added from them with less than the record has.
            name = (record["key"], record["vessel_id"], record["name"])
            found = by_digest.get(digest) or (by_name.get(name) if record["name"] else None)
            if found is None:
                last = max(last + 1, record.get("seq", 0))
                found = (last, record["accepted_utc_s"])
                new.append({**record, "seq": last})
            by_digest[digest] = by_name[name] = found
            accepted.append(Accepted(identity, *found))
        if new:
            self._database.put(sql, self._put_records, new)
            sql.execute(_SET_LAST, {"last": last})
            decided = {(r["vessel_id"], r["vehicle_id"], r["image_id"]) for r in new if r["encoding"] == _DECISION}
            if decided:
                self._database.put(sql, self._put_state, [self._review(sql, *image) for image in sorted(decided)])
        return accepted

    def become(self, sql: sa.Connection, identity: str) -> bool:
        """Take the identity of another journal if no record is numbered yet; return whether this has it."""
        own, last = sql.execute(_LOCKED_POSITION).one()
        if last == 0:
            sql.execute(sa.update(ARCHIVE).values(identity=identity))
        return bool(last == 0 or own == identity)

    def last(self, sql: sa.Connection) -> int:
        """Return the highest number, 0 for none."""
        return int(sql.execute(_LOCKED_POSITION).one().last_seq)

    def skip_to(self, sql: sa.Connection, last: int) -> None:
        """Use no number up to this one."""
        sql.execute(sa.update(ARCHIVE).where(ARCHIVE.c.last_seq < last).values(last_seq=last))

    def _review(self, sql: sa.Connection, vessel_id: str, vehicle_id: str, image_id: str) -> dict[str, Any]:
        """Return the row with the result of the decisions on an image."""
        image = {"vessel_id": vessel_id, "vehicle_id": vehicle_id, "image_id": image_id}
        payloads = sql.execute(_DECISIONS_ON, {**image, "newest": MAX_REVIEWED}).scalars()
        return {**image, "state": review_state(payloads, self._database.where)}


_R: Final = RECORD.alias("r")
_PAGE: Final = sa.select(
    _R.c.seq, _R.c.accepted_utc_s, _R.c.key, _R.c.encoding, _R.c.payload, _R.c.vessel_id, _R.c.name
)
_POSITION: Final = sa.select(ARCHIVE.c.identity, ARCHIVE.c.last_seq)
_LOCKED_POSITION: Final = _POSITION.with_for_update()
_SET_LAST: Final = sa.update(ARCHIVE).values(last_seq=sa.bindparam("last"))
_BY_DIGEST: Final = sa.select(RECORD.c.key, RECORD.c.digest, RECORD.c.seq, RECORD.c.accepted_utc_s).where(
    RECORD.c.digest.in_(sa.bindparam("digests", expanding=True))
)
_BY_NAME: Final = sa.select(
    RECORD.c.key, RECORD.c.vessel_id, RECORD.c.name, RECORD.c.seq, RECORD.c.accepted_utc_s
).where(RECORD.c.name.in_(sa.bindparam("names", expanding=True)), RECORD.c.name != sa.text("''"))
_DECISIONS_ON: Final = (
    sa.select(RECORD.c.payload)
    .where(
        RECORD.c.encoding == _DECISION,
        RECORD.c.vessel_id == sa.bindparam("vessel_id"),
        RECORD.c.vehicle_id == sa.bindparam("vehicle_id"),
        RECORD.c.image_id == sa.bindparam("image_id"),
    )
    .order_by(RECORD.c.seq.desc())
    .limit(sa.bindparam("newest"))
)


def _all_keys() -> sa.Select[Any]:
    """Return a selection of all keys: one search in the index for each key, in place of a read of the whole table."""
    known = sa.select(sa.func.min(RECORD.c.key).label("key")).cte("known", recursive=True)
    following = sa.select(sa.func.min(RECORD.c.key)).where(RECORD.c.key > known.c.key).scalar_subquery()
    known = known.union_all(sa.select(following).where(known.c.key.is_not(None)))
    return sa.select(known.c.key).where(known.c.key.is_not(None))


_KNOWN_KEYS: Final = _all_keys()


def _known(
    sql: sa.Connection, records: Sequence[dict[str, Any]]
) -> tuple[dict[tuple[str, bytes], tuple[int, float]], dict[tuple[str, str, str], tuple[int, float]]]:
    """Return number and time of the records that the journal has, by key and digest, and by key, vessel and name."""
    digests = sql.execute(_BY_DIGEST, {"digests": [record["digest"] for record in records]})
    by_digest = {(key, digest): (seq, utc_s) for key, digest, seq, utc_s in digests}
    names = [record["name"] for record in records if record["name"]]
    by_name = {
        (key, vessel, name): (seq, utc_s)
        for key, vessel, name, seq, utc_s in (sql.execute(_BY_NAME, {"names": names}) if names else ())
    }
    return by_digest, by_name


def review_state(payloads: Iterable[bytes], where: str) -> ReviewState:
    """Return the result of all decisions on an image, from their compressed payloads; `where` names the journal."""
    decisions = [wire.decode(Decision, zlib.decompress(payload), where) for payload in payloads]
    return review_result(sorted(decisions, key=lambda d: (d.decided_utc_s, d.decision_id))).state


def conditions(keys: Sequence[str], criteria: Criteria) -> list[ColumnElement[bool]]:
    """Return conditions on the records `r`."""
    r = _R.c
    where: list[ColumnElement[bool]] = [r.key.in_(keys)]
    if criteria.since_utc_s is not None:
        where.append(r.accepted_utc_s >= criteria.since_utc_s)
    if criteria.until_utc_s is not None:
        where.append(r.accepted_utc_s < criteria.until_utc_s)
    if criteria.vessel_id is not None:
        where.append(r.vessel_id == criteria.vessel_id)
    if criteria.vehicle_id is not None:
        where.append(r.vehicle_id == criteria.vehicle_id)
    if criteria.area is not None:
        area, p = criteria.area, RECORD.alias("p")
        east, west = p.c.lon_deg >= area.west_deg, p.c.lon_deg <= area.east_deg
        within = sa.or_(east, west) if area.west_deg > area.east_deg else sa.and_(east, west)
        latitude = p.c.lat_deg.between(area.south_deg, area.north_deg)
        where.append(sa.exists().where(*_same_image(p), latitude, within))
    if criteria.review is not None:
        state = sa.select(REVIEW.c.state).where(*_same_image(REVIEW)).scalar_subquery()
        where += [r.image_id != "", sa.func.coalesce(state, "unreviewed") == criteria.review]
    if criteria.latest:
        n = RECORD.alias("n")
        later = sa.tuple_(n.c.version, n.c.seq) > sa.tuple_(r.version, r.seq)
        where.append(~sa.exists().where(n.c.key == r.key, n.c.subject == r.subject, later))
    return where


def _same_image(other: sa.FromClause) -> list[ColumnElement[bool]]:
    return [other.c[name] == _R.c[name] for name in ("vessel_id", "vehicle_id", "image_id")]
