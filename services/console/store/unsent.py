"""Records of operators' actions that wait for the service's outbox."""

from __future__ import annotations

import logging
import sqlite3
from dataclasses import dataclass

from sonarpost import wire
from sonarpost.errors import BadInputError
from sonarpost.logs import IntervalLog
from sonarpost.messages import Command, Comment, Decision
from sonarpost.services.console.store.database import ID_COLUMN, RECORD_TYPES, Table

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
