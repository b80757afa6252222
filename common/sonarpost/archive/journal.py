"""Journal of a shore site: every accepted record under one sequence number, for queries of subscribers.

The file `journal.db` is beside the files of c2. A row holds the payload as it was published, an image without its
pixels: those are in its TIFF file. Numbers count up and are never used again, so that the highest number that a client
has received is a cursor. Numbers are committed to the disk before they are published.

Several c2 that share a database have the journal of `shared_journal` in place of this one. For both, a number must not
become visible while a lower one is not committed yet.
"""

from __future__ import annotations

import hashlib
import secrets
import sqlite3
import threading
import time
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import msgpack

from sonarpost import wire
from sonarpost.errors import StoredFileError
from sonarpost.files import make_private
from sonarpost.limits import limit
from sonarpost.messages import Contact, Decision, Record
from sonarpost.review.decisions import ReviewState, review_result

FILE_NAME: Final = "journal.db"
VERSION: Final = 2
BUSY_S: Final = 10.0
MAX_SEARCH_S: Final = 5.0
"""A search that takes more processor time is ended with an error."""
_STEPS: Final = 10_000
"""Instructions of SQLite between two checks of that time."""
MAX_REVIEWED: Final = limit(
    1000, "decisions", "shares", "journal of c2", "vessel", "decisions on an image for its state", "the newest count"
)
DIGEST_BYTES: Final = 16
COMPRESSION_WINDOW_BITS: Final = 12
"""4 KiB: to clear the largest window takes longer than to compress a record."""

_SCHEMA = """
CREATE TABLE IF NOT EXISTS journal (archive TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS record (
    seq INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT NOT NULL, digest BLOB NOT NULL, encoding TEXT NOT NULL,
    payload BLOB NOT NULL, accepted_utc_s REAL NOT NULL, vessel_id TEXT NOT NULL, vehicle_id TEXT NOT NULL,
    image_id TEXT NOT NULL, subject TEXT NOT NULL, version INTEGER NOT NULL, lat_deg REAL, lon_deg REAL,
    name TEXT NOT NULL, UNIQUE (key, digest));
CREATE INDEX IF NOT EXISTS record_subject ON record (key, subject, version);
CREATE INDEX IF NOT EXISTS record_image ON record (vessel_id, vehicle_id, image_id);
CREATE INDEX IF NOT EXISTS record_name ON record (vessel_id, name) WHERE name <> '';
CREATE INDEX IF NOT EXISTS record_accepted ON record (accepted_utc_s);
CREATE TABLE IF NOT EXISTS review (
    vessel_id TEXT NOT NULL, vehicle_id TEXT NOT NULL, image_id TEXT NOT NULL, state TEXT NOT NULL,
    PRIMARY KEY (vessel_id, vehicle_id, image_id)) WITHOUT ROWID;
"""


@dataclass(frozen=True, slots=True)
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


class JournalRecord(NamedTuple):
    """Columns of a record in a journal, in the order of the table, without its number.

    Attributes:
        digest: Of the payload as it is published; with the key, it identifies the record.
        payload: The payload without pixels that its files hold, compressed with zlib.

    The other attributes are those of `JournalEntry` and `Contact`.
    """

    key: str
    digest: bytes
    encoding: str
    payload: bytes
    accepted_utc_s: float
    vessel_id: str
    vehicle_id: str
    image_id: str
    subject: str
    version: int
    lat_deg: float | None
    lon_deg: float | None
    name: str

    @classmethod
    def of(cls, entry: JournalEntry, accepted_utc_s: float) -> JournalRecord:
        """Return the columns of a record that is accepted at this time."""
        contact = entry.contact
        payload = wire.encode(entry.record)
        return cls(
            entry.key,
            hashlib.sha256(payload).digest()[:DIGEST_BYTES],
            wire.encoding_of(type(entry.record)),
            zlib.compress(_without_pixels(entry, payload), wbits=COMPRESSION_WINDOW_BITS),
            accepted_utc_s,
            entry.vessel_id,
            entry.vehicle_id,
            entry.image_id,
            entry.subject,
            entry.version,
            contact.lat_deg if contact else None,
            contact.lon_deg if contact else None,
            entry.name,
        )


COLUMNS: Final = ", ".join(JournalRecord._fields)


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
    """Journal in one folder, safe for several threads.

    Raises:
        StoredFileError: The file is not a journal of this version.
        OSError: It cannot be read or written; also raised by every method.
    """

    def __init__(self, out_dir: Path) -> None:
        self.path = out_dir / FILE_NAME
        self._lock = threading.RLock()
        # Searches have their own connection: in WAL mode they do not delay new records.
        self._search_lock = threading.Lock()
        self._search_end_s = 0.0
        out_dir.mkdir(parents=True, exist_ok=True)
        make_private(self.path)
        try:
            self._db = self._connect()
            self._open()
            self._search_db = self._connect()
            self._search_db.set_progress_handler(lambda: time.thread_time() > self._search_end_s, _STEPS)
        except sqlite3.OperationalError as error:
            raise OSError(f"{self.path}: {error}") from error
        except sqlite3.DatabaseError as error:
            raise StoredFileError(str(self.path), "", str(error), "the journal in the out_dir of c2") from error
        self.archive = str(self._db.execute("SELECT archive FROM journal").fetchone()[0])
        self._keys = {str(row[0]) for row in self._db.execute("SELECT DISTINCT key FROM record")}

    def _connect(self) -> sqlite3.Connection:
        return sqlite3.connect(self.path, check_same_thread=False, isolation_level=None, timeout=BUSY_S)

    def _open(self) -> None:
        version = int(self._db.execute("PRAGMA user_version").fetchone()[0])
        if version not in (0, VERSION):
            self._db.close()
            raise StoredFileError(str(self.path), "user_version", version, str(VERSION))
        self._db.execute("PRAGMA journal_mode=WAL")
        # A number that was published must not be given to another record after a power cut.
        self._db.execute("PRAGMA synchronous=FULL")
        self._db.executescript(f"BEGIN IMMEDIATE; {_SCHEMA} PRAGMA user_version = {VERSION}; COMMIT;")
        with self._db:
            self._db.execute("BEGIN IMMEDIATE")
            if self._db.execute("SELECT 1 FROM journal").fetchone() is None:
                self._db.execute("INSERT INTO journal VALUES (?)", (secrets.token_hex(4),))

    def close(self) -> None:
        """Close the file."""
        with self._search_lock, self._lock:
            self._search_db.close()
            self._db.close()

    @contextmanager
    def _using(self, *, writing: bool) -> Iterator[sqlite3.Connection]:
        with self._lock:
            try:
                # The connection commits at the end of its block, and rolls back after an exception.
                with self._db:
                    if writing:
                        self._db.execute("BEGIN IMMEDIATE")
                    yield self._db
            except sqlite3.Error as error:
                raise OSError(f"{self.path}: {error}") from error

    def append(self, entries: Sequence[JournalEntry], now_utc_s: float) -> list[Accepted]:
        """Number records; a record with the same key and payload or files keeps the number that it has.

        Args:
            entries: The records, in the order of their numbers.
            now_utc_s: Time of acceptance of those that are new.
        """
        return self.append_dated([(entry, now_utc_s) for entry in entries])

    def append_dated(self, entries: Iterable[tuple[JournalEntry, float]]) -> list[Accepted]:
        """Number records with their times of acceptance; see `append`."""
        numbered: list[tuple[str, Accepted]] = []
        reviewed: dict[tuple[str, str, str], str] = {}
        with self._using(writing=True) as db:
            for entry, utc_s in entries:
                numbered.append(self._number(db, entry, utc_s))
                if isinstance(entry.record, Decision):
                    reviewed[entry.vessel_id, entry.vehicle_id, entry.image_id] = entry.key
            for image, key in reviewed.items():
                self._review(db, image, key)
        self._keys |= {key for key, _ in numbered}
        return [accepted for _, accepted in numbered]

    def _number(self, db: sqlite3.Connection, entry: JournalEntry, utc_s: float) -> tuple[str, Accepted]:
        values = JournalRecord.of(entry, utc_s)
        select = "SELECT seq, accepted_utc_s FROM record WHERE key = ?"
        known = db.execute(f"{select} AND digest = ?", (entry.key, values.digest)).fetchone()
        if known is None and entry.name:
            # Its files identify it, also if it was added from them with less than the record has.
            same_files = f"{select} AND vessel_id = ? AND name = ? AND name <> ''"
            known = db.execute(same_files, (entry.key, entry.vessel_id, entry.name)).fetchone()
        if known is not None:
            return entry.key, Accepted(self.archive, int(known[0]), float(known[1]))
        marks = ", ".join("?" * len(values))
        seq = db.execute(f"INSERT INTO record ({COLUMNS}) VALUES ({marks})", values).lastrowid  # noqa: S608 literals
        assert seq is not None
        return entry.key, Accepted(self.archive, seq, utc_s)

    def _review(self, db: sqlite3.Connection, image: tuple[str, str, str], key: str) -> None:
        """Store the result of the decisions on an image."""
        rows = db.execute(
            "SELECT payload FROM record WHERE vessel_id = ? AND vehicle_id = ? AND image_id = ? AND key = ?"
            " ORDER BY seq DESC LIMIT ?",
            (*image, key, MAX_REVIEWED),
        )
        state = review_state([row[0] for row in rows], str(self.path))
        db.execute("INSERT OR REPLACE INTO review VALUES (?, ?, ?, ?)", (*image, state))

    def known_keys(self) -> list[str]:
        """Return the keys of all records."""
        with self._lock:
            return sorted(self._keys)

    def last_seq(self) -> int:
        """Return the highest number, 0 for none."""
        return self.position()[1]

    def position(self) -> tuple[str, int]:
        """Return the identity of the journal and the highest number, 0 for none."""
        with self._using(writing=False) as db:
            row = db.execute("SELECT seq FROM sqlite_sequence WHERE name = 'record'").fetchone()
        return self.archive, 0 if row is None else int(row[0])

    def records(self) -> list[tuple[int, JournalRecord]]:
        """Return all records with their numbers, in their order."""
        with self._using(writing=False) as db:
            rows = db.execute(f"SELECT seq, {COLUMNS} FROM record ORDER BY seq").fetchall()  # noqa: S608 literals
        return [(int(row[0]), JournalRecord(*row[1:])) for row in rows]

    def names(self) -> set[tuple[str, str]]:
        """Return vessel and file name of all records whose pixels are in files."""
        with self._using(writing=False) as db:
            return {(str(v), str(n)) for v, n in db.execute("SELECT vessel_id, name FROM record WHERE name <> ''")}

    def remove(self, names: Iterable[tuple[str, str]]) -> None:
        """Remove the records of files that were deleted: pairs of vessel and file name."""
        with self._using(writing=True) as db:
            db.executemany("DELETE FROM record WHERE vessel_id = ? AND name = ?", list(names))

    def page(self, keys: Sequence[str], criteria: Criteria, after: int, limit: int) -> list[JournalRow]:
        """Return records in the order of their numbers.

        Args:
            keys: Their keys.
            criteria: Further conditions.
            after: Highest number that is excluded.
            limit: Maximum number of records.
        """
        where, values = conditions(keys, criteria)
        sql = (
            f"SELECT {PAGE_COLUMNS} FROM record AS r "  # noqa: S608
            f"WHERE r.seq > ? AND {' AND '.join(where)} ORDER BY r.seq LIMIT ?"
        )
        with self._search_lock:
            self._search_end_s = time.thread_time() + MAX_SEARCH_S
            try:
                rows = self._search_db.execute(sql, (after, *values, limit)).fetchall()
            except sqlite3.Error as error:
                raise OSError(f"{self.path}: {error}") from error
        return [journal_row(Accepted(self.archive, seq, utc_s), *rest) for seq, utc_s, *rest in rows]


PAGE_COLUMNS: Final = "r.seq, r.accepted_utc_s, r.key, r.encoding, r.payload, r.vessel_id, r.name"


def journal_row(accepted: Accepted, key: str, encoding: str, payload: bytes, vessel_id: str, name: str) -> JournalRow:
    """Return a record of a page from its columns.

    Raises:
        PayloadError: The compressed payload is not a map.
    """
    return JournalRow(accepted, key, encoding, wire.unpack_map(zlib.decompress(payload), key), vessel_id, name)


def review_state(payloads: Iterable[bytes], where: str) -> ReviewState:
    """Return the result of all decisions on an image, from their compressed payloads; `where` names the journal."""
    decisions = [wire.decode(Decision, zlib.decompress(payload), where) for payload in payloads]
    return review_result(sorted(decisions, key=lambda d: (d.decided_utc_s, d.decision_id))).state


def conditions(keys: Sequence[str], criteria: Criteria) -> tuple[list[str], list[object]]:
    """Return SQL conditions on the table `record AS r`, with `?` for each of their values."""
    where, values = [f"r.key IN ({', '.join('?' * len(keys))})"], list[object](keys)
    for condition, value in (
        ("r.accepted_utc_s >= ?", criteria.since_utc_s),
        ("r.accepted_utc_s < ?", criteria.until_utc_s),
        ("r.vessel_id = ?", criteria.vessel_id),
        ("r.vehicle_id = ?", criteria.vehicle_id),
    ):
        if value is not None:
            where.append(condition)
            values.append(value)
    same_image = "{0}.vessel_id = r.vessel_id AND {0}.vehicle_id = r.vehicle_id AND {0}.image_id = r.image_id"
    if criteria.area is not None:
        area = criteria.area
        between = "OR" if area.west_deg > area.east_deg else "AND"
        where.append(
            f"EXISTS (SELECT 1 FROM record AS p WHERE {same_image.format('p')} AND p.lat_deg BETWEEN ? AND ?"  # noqa: S608
            f" AND (p.lon_deg >= ? {between} p.lon_deg <= ?))"
        )
        values += [area.south_deg, area.north_deg, area.west_deg, area.east_deg]
    if criteria.review is not None:
        state = f"SELECT state FROM review AS d WHERE {same_image.format('d')}"  # noqa: S608 literals
        where.append(f"r.image_id <> '' AND COALESCE(({state}), 'unreviewed') = ?")
        values.append(criteria.review)
    if criteria.latest:
        where.append(
            "NOT EXISTS (SELECT 1 FROM record AS n WHERE n.key = r.key AND n.subject = r.subject"
            " AND (n.version, n.seq) > (r.version, r.seq))"
        )
    return where, values


def _without_pixels(entry: JournalEntry, payload: bytes) -> bytes:
    """Return the payload of a record, without the pixels that its files hold."""
    if not entry.name:
        return payload
    fields = wire.unpack_map(payload, entry.key)
    pixels = fields["pixels"]
    assert isinstance(pixels, dict)
    packed: bytes = msgpack.packb({**fields, "pixels": {**pixels, "data": b""}}, use_bin_type=True)
    return packed
