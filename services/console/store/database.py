"""Database of the console: contacts, image versions, decisions, requests, comments, measurements and the audit.

It is one SQLite file beside the service's store. Operators' actions are never overwritten: undoing a decision adds a
record, and triggers reject changes to the audit.
"""

from __future__ import annotations

import json
import logging
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Literal

from typing_extensions import override

from sonarpost import wire
from sonarpost.errors import BadInputError
from sonarpost.logs import IntervalLog
from sonarpost.messages import Command, Comment, Decision
from sonarpost.sqlite_file import SqliteFile

UserRole = Literal["observer", "operator", "expert"]
ConsoleSide = Literal["vessel", "shore"]
Permission = Literal["decide", "measure", "request", "comment"]
Table = Literal["decision", "request", "comment"]
"""Tables of the records that this console sends."""

ROLES: Final[tuple[UserRole, ...]] = ("observer", "operator", "expert")
PERMISSIONS: Final[tuple[Permission, ...]] = ("decide", "measure", "request", "comment")
ID_COLUMN: Final[dict[Table, str]] = {"decision": "decision_id", "request": "command_id", "comment": "comment_id"}
RECORD_TYPES: Final[dict[Table, type[Decision] | type[Command] | type[Comment]]] = {
    "decision": Decision,
    "request": Command,
    "comment": Comment,
}

DATABASE_NAME: Final = "console-review.db"
SCHEMA_VERSION: Final = 2

CONTRADICTORY: Final = (
    "COALESCE(MAX(g.review = 'disputed') OR (MAX(g.review = 'mine_like') AND MAX(g.review = 'not_mine_like')), 0)"
)
"""SQL aggregate over the looks `g` of an object: verdicts on one look, or on several, contradict each other."""

UNDELIVERED: Final = (
    "(shore IN ('waiting', 'relay', 'refused') OR vehicle IN ('waiting', 'asked', 'sent', 'refused', 'expired'))"
)
"""SQL condition of decisions that have not reached the shore site or the vehicle."""

LATITUDE_BANDS_PER_DEGREE: Final = 1000
LATITUDE_BAND: Final = f"CAST(ROUND(lat_deg * {LATITUDE_BANDS_PER_DEGREE}) AS INTEGER)"
"""SQL number of a band of latitude of about 111 m, in which the index `contact_square` orders contacts by longitude."""

_SCHEMA: Final = f"""
CREATE TABLE IF NOT EXISTS contact (
    id TEXT PRIMARY KEY, vessel_id TEXT NOT NULL, vehicle_id TEXT NOT NULL, image_id TEXT NOT NULL,
    first_s INTEGER NOT NULL, name TEXT NOT NULL, revision INTEGER NOT NULL DEFAULT 0, image TEXT NOT NULL,
    version INTEGER NOT NULL, first_frame_utc_s REAL NOT NULL, bytes_received INTEGER NOT NULL, percent REAL NOT NULL,
    complete INTEGER NOT NULL, has_image INTEGER NOT NULL, authenticated INTEGER,
    height_px INTEGER NOT NULL, width_px INTEGER NOT NULL, arrived_utc_s REAL NOT NULL,
    updated_utc_s REAL NOT NULL,
    atd_class TEXT, atd_confidence REAL, lat_deg REAL, lon_deg REAL, position_sigma_m REAL, heading_deg REAL,
    length_m REAL, width_m REAL, height_m REAL, range_m REAL, seen_utc_s REAL, vehicle_lat_deg REAL,
    vehicle_lon_deg REAL, group_id TEXT, parent TEXT, relation TEXT, sealed INTEGER NOT NULL DEFAULT 0,
    review TEXT NOT NULL DEFAULT 'unreviewed', mlo_class TEXT, confidence REAL, decided_by TEXT, decided_utc_s REAL,
    effective TEXT, last_decision TEXT, remark TEXT NOT NULL DEFAULT '', commented INTEGER NOT NULL DEFAULT 0,
    contradictory INTEGER NOT NULL DEFAULT 0, decided_version INTEGER, decided_bytes INTEGER
) WITHOUT ROWID;
CREATE UNIQUE INDEX IF NOT EXISTS contact_image ON contact (vessel_id, vehicle_id, image_id, first_s);
CREATE INDEX IF NOT EXISTS contact_updated ON contact (updated_utc_s, id);
CREATE INDEX IF NOT EXISTS contact_arrived ON contact (arrived_utc_s, id);
CREATE INDEX IF NOT EXISTS contact_confidence ON contact (atd_confidence, id);
CREATE INDEX IF NOT EXISTS contact_percent ON contact (percent, id);
CREATE INDEX IF NOT EXISTS contact_name ON contact (name, id);
CREATE INDEX IF NOT EXISTS contact_range ON contact (range_m, id);
CREATE INDEX IF NOT EXISTS contact_group ON contact (group_id);
CREATE INDEX IF NOT EXISTS contact_square ON contact ({LATITUDE_BAND}, lon_deg);
CREATE INDEX IF NOT EXISTS contact_detection ON contact (vehicle_id, seen_utc_s, lat_deg, lon_deg);
CREATE INDEX IF NOT EXISTS contact_answers ON contact (parent) WHERE parent IS NOT NULL;
CREATE INDEX IF NOT EXISTS contact_listed ON contact (review, contradictory, parent, sealed)
    WHERE parent IS NULL AND sealed < 2;
CREATE INDEX IF NOT EXISTS contact_contradictory ON contact (contradictory, arrived_utc_s, id);
CREATE INDEX IF NOT EXISTS contact_first ON contact (contradictory DESC, arrived_utc_s, id);
CREATE INDEX IF NOT EXISTS contact_authenticated ON contact (id) WHERE authenticated = 1;
CREATE TABLE IF NOT EXISTS version (
    contact_id TEXT NOT NULL, version INTEGER NOT NULL, received_utc_s REAL NOT NULL, rate INTEGER,
    payload BLOB NOT NULL, removed INTEGER NOT NULL DEFAULT 0, PRIMARY KEY (contact_id, version)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS decision (
    seq INTEGER PRIMARY KEY AUTOINCREMENT, decision_id TEXT NOT NULL UNIQUE, contact_id TEXT NOT NULL DEFAULT '',
    vessel_id TEXT NOT NULL, vehicle_id TEXT NOT NULL, image_id TEXT NOT NULL, version INTEGER NOT NULL,
    verdict TEXT NOT NULL, operator TEXT NOT NULL, decided_utc_s REAL NOT NULL, sha256 TEXT, layer TEXT, undoes TEXT,
    undone INTEGER NOT NULL DEFAULT 0, elsewhere INTEGER NOT NULL DEFAULT 0, shore TEXT NOT NULL, vehicle TEXT NOT NULL,
    reason TEXT NOT NULL DEFAULT '', times_sent INTEGER NOT NULL DEFAULT 0, relayed_utc_s REAL,
    changed_utc_s REAL NOT NULL, payload BLOB NOT NULL, sent INTEGER NOT NULL, send_after_utc_s REAL, shown_s REAL,
    bytes_received INTEGER, batch TEXT);
CREATE INDEX IF NOT EXISTS decision_contact ON decision (contact_id, seq);
CREATE INDEX IF NOT EXISTS decision_waiting ON decision (vessel_id, vehicle_id, image_id) WHERE contact_id = '';
CREATE INDEX IF NOT EXISTS decision_unsent ON decision (seq) WHERE sent = 0;
CREATE INDEX IF NOT EXISTS decision_relayed ON decision (seq) WHERE shore = 'relay';
CREATE INDEX IF NOT EXISTS decision_operator ON decision (operator, seq);
CREATE INDEX IF NOT EXISTS decision_batch ON decision (batch) WHERE batch IS NOT NULL;
CREATE INDEX IF NOT EXISTS decision_undelivered ON decision (contact_id, seq) WHERE {UNDELIVERED};
CREATE TABLE IF NOT EXISTS request (
    seq INTEGER PRIMARY KEY AUTOINCREMENT, command_id TEXT NOT NULL UNIQUE, contact_id TEXT NOT NULL,
    vessel_id TEXT NOT NULL, kind TEXT NOT NULL, user TEXT NOT NULL, asked_utc_s REAL NOT NULL, airtime_s REAL,
    state TEXT NOT NULL, times_sent INTEGER NOT NULL DEFAULT 0, reason TEXT NOT NULL DEFAULT '',
    changed_utc_s REAL NOT NULL, payload BLOB NOT NULL, sent INTEGER NOT NULL, base_version INTEGER,
    base_bytes INTEGER, base_total INTEGER, bytes_wanted INTEGER, probable_utc_s REAL, expected_utc_s REAL,
    late_utc_s REAL, arrived_utc_s REAL, result_contact TEXT, result_version INTEGER, result_bytes INTEGER);
CREATE INDEX IF NOT EXISTS request_contact ON request (contact_id, seq);
CREATE INDEX IF NOT EXISTS request_unsent ON request (seq) WHERE sent = 0;
CREATE TABLE IF NOT EXISTS comment (
    seq INTEGER PRIMARY KEY AUTOINCREMENT, comment_id TEXT NOT NULL UNIQUE, contact_id TEXT NOT NULL DEFAULT '',
    vessel_id TEXT NOT NULL, vehicle_id TEXT NOT NULL, image_id TEXT NOT NULL, state TEXT,
    reason TEXT NOT NULL DEFAULT '', payload BLOB NOT NULL, sent INTEGER NOT NULL);
CREATE INDEX IF NOT EXISTS comment_contact ON comment (contact_id, seq);
CREATE INDEX IF NOT EXISTS comment_waiting ON comment (vessel_id, vehicle_id, image_id) WHERE contact_id = '';
CREATE INDEX IF NOT EXISTS comment_unsent ON comment (seq) WHERE sent = 0;
CREATE TABLE IF NOT EXISTS measurement (
    id INTEGER PRIMARY KEY AUTOINCREMENT, contact_id TEXT NOT NULL, utc_s REAL NOT NULL, body TEXT NOT NULL,
    withdrawn_by TEXT, withdrawn_utc_s REAL);
CREATE INDEX IF NOT EXISTS measurement_contact ON measurement (contact_id, id);
CREATE TABLE IF NOT EXISTS audit (
    seq INTEGER PRIMARY KEY AUTOINCREMENT, contact_id TEXT NOT NULL, utc_s REAL NOT NULL, user TEXT NOT NULL,
    role TEXT NOT NULL, address TEXT NOT NULL, action TEXT NOT NULL, version INTEGER, sha256 TEXT, layer TEXT,
    detail TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS audit_contact ON audit (contact_id, seq);
CREATE TRIGGER IF NOT EXISTS audit_is_not_changed BEFORE UPDATE ON audit
    BEGIN SELECT RAISE(ABORT, 'the audit is only added to'); END;
CREATE TRIGGER IF NOT EXISTS audit_is_not_deleted BEFORE DELETE ON audit
    BEGIN SELECT RAISE(ABORT, 'the audit is only added to'); END;
CREATE TABLE IF NOT EXISTS truth (
    contact_id TEXT PRIMARY KEY, is_mine_like INTEGER NOT NULL, label TEXT NOT NULL, sealed INTEGER NOT NULL,
    revealed_utc_s REAL, added_utc_s REAL NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS notice (
    id INTEGER PRIMARY KEY AUTOINCREMENT, user TEXT NOT NULL, kind TEXT NOT NULL, contact_id TEXT NOT NULL,
    decision_id TEXT NOT NULL, by_decision_id TEXT NOT NULL, acknowledged_utc_s REAL);
CREATE INDEX IF NOT EXISTS notice_open ON notice (user, id) WHERE acknowledged_utc_s IS NULL;
CREATE TABLE IF NOT EXISTS track (
    seq INTEGER PRIMARY KEY AUTOINCREMENT, vessel_id TEXT NOT NULL, vehicle_id TEXT NOT NULL,
    received_utc_s REAL NOT NULL, time_utc_s REAL NOT NULL, lat_deg REAL, lon_deg REAL, heading_deg REAL,
    speed_mps REAL, depth_m REAL, altitude_m REAL, swath_m REAL, battery REAL, images_waiting INTEGER,
    disk_free_bytes INTEGER, authenticated INTEGER NOT NULL);
CREATE INDEX IF NOT EXISTS track_vessel ON track (vessel_id, vehicle_id);
CREATE INDEX IF NOT EXISTS track_vehicle ON track (vehicle_id, seq);
CREATE TABLE IF NOT EXISTS object (id INTEGER PRIMARY KEY AUTOINCREMENT);
CREATE TABLE IF NOT EXISTS look_pair (
    a TEXT NOT NULL, b TEXT NOT NULL, joined INTEGER NOT NULL, PRIMARY KEY (a, b)) WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS look_pair_b ON look_pair (b);
"""
"""`contact.image`: newest version of the image with its contact, as in a side-car; `payload` of a decision, request or
comment: the record. Columns repeat what queries use.
`object` only issues identifiers. `look_pair`: looks that a person joined or separated. `decision.batch` is common to
the decisions that one verdict on an object made."""

_TRACKING: Final = """
PRAGMA temp_store = MEMORY;
CREATE TEMP TABLE changed (id TEXT NOT NULL, is_new INTEGER NOT NULL);
CREATE TEMP TRIGGER contact_1 AFTER INSERT ON contact BEGIN INSERT INTO changed VALUES (new.id, 1); END;
CREATE TEMP TRIGGER contact_2 AFTER UPDATE ON contact BEGIN INSERT INTO changed VALUES (new.id, 0); END;
CREATE TEMP TRIGGER contact_3 AFTER UPDATE OF group_id ON contact WHEN old.group_id IS NOT new.group_id
    BEGIN INSERT INTO changed SELECT id, 0 FROM contact WHERE group_id IN (old.group_id, new.group_id); END;
CREATE TEMP TRIGGER version_1 AFTER INSERT ON version BEGIN INSERT INTO changed VALUES (new.contact_id, 0); END;
CREATE TEMP TRIGGER decision_1 AFTER INSERT ON decision BEGIN INSERT INTO changed VALUES (new.contact_id, 0); END;
CREATE TEMP TRIGGER decision_2 AFTER UPDATE ON decision WHEN old.sent IS new.sent
    BEGIN INSERT INTO changed VALUES (new.contact_id, 0); END;
CREATE TEMP TRIGGER request_1 AFTER INSERT ON request BEGIN INSERT INTO changed VALUES (new.contact_id, 0); END;
CREATE TEMP TRIGGER request_2 AFTER UPDATE ON request WHEN old.sent IS new.sent
    BEGIN INSERT INTO changed VALUES (new.contact_id, 0); END;
CREATE TEMP TRIGGER comment_1 AFTER INSERT ON comment BEGIN INSERT INTO changed VALUES (new.contact_id, 0); END;
CREATE TEMP TRIGGER comment_2 AFTER UPDATE ON comment WHEN old.sent IS new.sent
    BEGIN INSERT INTO changed VALUES (new.contact_id, 0); END;
CREATE TEMP TRIGGER measurement_1 AFTER INSERT ON measurement
    BEGIN INSERT INTO changed VALUES (new.contact_id, 0); END;
CREATE TEMP TRIGGER measurement_2 AFTER UPDATE ON measurement
    BEGIN INSERT INTO changed VALUES (new.contact_id, 0); END;
CREATE TEMP TRIGGER audit_1 AFTER INSERT ON audit BEGIN INSERT INTO changed VALUES (new.contact_id, 0); END;
CREATE TEMP TRIGGER truth_2 AFTER UPDATE ON truth BEGIN INSERT INTO changed VALUES (new.contact_id, 0); END;
"""
"""Triggers of this connection that collect the contacts which a transaction changes: their own columns, the looks of
their object, their records. `sent` is not displayed."""

_CHANGED: Final = (
    "SELECT COALESCE(c.parent, c.id) AS id, MAX(n.is_new AND c.parent IS NULL) AS is_new"
    " FROM changed n JOIN contact c ON c.id = n.id GROUP BY 1 ORDER BY 1"
)
"""The changed contacts; an image that answers a request is a layer of its contact."""


class NotFoundError(BadInputError):
    """There is no such contact, version or file."""


class Database(SqliteFile):
    """The database of the console.

    Attributes:
        on_change: Called after each transaction that has changed contacts, in the order of the transactions, with
            contact identifier -> whether the contact is new.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, _SCHEMA, SCHEMA_VERSION)
        self.on_change: Callable[[Mapping[str, bool]], None] = lambda changed: None
        self._db.executescript(_TRACKING)

    @contextmanager
    @override
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Run the block in a transaction, then call `on_change` if it has changed contacts.

        Raises:
            DeliveryError: The transaction failed, for example because of a full disk, and was rolled back.
        """
        with self._lock:
            with super().transaction() as db:
                yield db
                changed = {str(row["id"]): bool(row["is_new"]) for row in db.execute(_CHANGED)}
                db.execute("DELETE FROM changed")
            if changed:
                self.on_change(changed)


def insert_row(db: sqlite3.Connection, table: str, values: Mapping[str, object]) -> int:
    """Insert a row; return its rowid."""
    columns, marks = ", ".join(values), ", ".join("?" * len(values))
    inserted = db.execute(f"INSERT INTO {table} ({columns}) VALUES ({marks})", tuple(values.values()))  # noqa: S608
    return inserted.lastrowid or 0


def find_record(db: sqlite3.Connection, table: Table, record_id: str) -> sqlite3.Row | None:
    """Return the row of a record; None if there is none."""
    sql = f"SELECT * FROM {table} WHERE {ID_COLUMN[table]} = ?"  # noqa: S608  constants only
    row: sqlite3.Row | None = db.execute(sql, (record_id,)).fetchone()
    return row


@dataclass(frozen=True, slots=True)
class Actor:
    """A user who is logged in, with the network address of the browser."""

    user: str
    role: UserRole
    address: str

    def may(self, permission: Permission, side: ConsoleSide) -> bool:
        """Return whether the user has a permission on a vessel or at a shore site.

        Decisions are made on the vessel, which can send them to the vehicle at once. Experts at the shore site comment
        and send requests.
        """
        if permission == "comment":
            return side == "shore" and self.role == "expert"
        if permission == "decide":
            return side == "vessel" and self.role != "observer"
        if permission == "request" and side == "shore":
            return self.role == "expert"
        return self.role != "observer"


@dataclass(frozen=True, slots=True)
class DisplayedImage:
    """Image version on the screen during an action, with the SHA-256 of its pixels and the displayed layer."""

    version: int | None = None
    sha256: str | None = None
    layer: str | None = None


def add_audit_entry(
    db: sqlite3.Connection,
    contact_id: str,
    actor: Actor,
    action: str,
    utc_s: float,
    displayed: DisplayedImage,
    detail: Mapping[str, object],
) -> None:
    """Add an entry to the audit, in the transaction of the action."""
    values = {"contact_id": contact_id, "utc_s": utc_s, "action": action, "detail": json.dumps(dict(detail))}
    insert_row(db, "audit", {**values, **asdict(actor), **asdict(displayed)})


_unreadable_log = IntervalLog(logging.getLogger(__name__), logging.ERROR, "Stored record not readable, not sent")


@dataclass(frozen=True, slots=True)
class UnsentRecord:
    """A stored record that is not yet in the service's outbox.

    Attributes:
        to_vehicle: Whether a decision is sent to the vehicle; false for one that a disputed contact does not follow.
    """

    table: Table
    record_id: str
    vessel_id: str
    record: Decision | Command | Comment
    to_vehicle: bool = True


def unsent_records(db: sqlite3.Connection) -> list[UnsentRecord]:
    """Return the records that are not yet in the outbox, without decisions in their take-back time, oldest first.

    One that cannot be decoded is logged and left where it is.
    """
    found: list[UnsentRecord] = []
    for table, record_type in RECORD_TYPES.items():
        condition = "sent = 0 AND send_after_utc_s IS NULL" if table == "decision" else "sent = 0"
        for row in db.execute(f"SELECT * FROM {table} WHERE {condition} ORDER BY seq"):  # noqa: S608  constants only
            record_id = row[ID_COLUMN[table]]
            try:
                record = wire.decode(record_type, bytes(row["payload"]), f"{table} {record_id}")
            except BadInputError as error:
                _unreadable_log.log(table=table, record=record_id, reason=str(error)[:300])
                continue
            to_vehicle = table != "decision" or row["vehicle"] != "disputed"
            found.append(UnsentRecord(table, record_id, row["vessel_id"], record, to_vehicle))
    return found


def mark_sent(db: sqlite3.Connection, item: UnsentRecord) -> None:
    """Mark a record as queued in the outbox."""
    sql = f"UPDATE {item.table} SET sent = 1 WHERE {ID_COLUMN[item.table]} = ?"  # noqa: S608  constants only
    db.execute(sql, (item.record_id,))
