"""Requests to vehicles and comments from the shore site in the database, and their delivery."""

from __future__ import annotations

import sqlite3
import uuid
from typing import Final

from sonarpost import wire
from sonarpost.codec.registry import default_registry
from sonarpost.errors import BadInputError
from sonarpost.messages import Advice, Command, CommandKind, DownlinkState, TaskingState
from sonarpost.services.console.store.contacts import find_contact, find_contact_of_image
from sonarpost.services.console.store.database import (
    Actor,
    DisplayedImage,
    Table,
    add_audit_entry,
    find_record,
    insert_row,
)
from sonarpost.services.console.store.serialisers import Json

REQUEST_KINDS: Final[tuple[CommandKind, ...]] = ("refine", "resend", "revisit", "wider", "original")
"""Kinds in the order of the page. `wider` is displayed as "expand", `original` as "unfiltered image"."""

_STATE_ORDER: Final = {
    "none": 0,
    "waiting": 0,
    "asked": 1,
    "sent": 2,
    "delivered": 3,
    "confirmed": 3,
    "refused": 3,
    "expired": 3,
}


def unavailable_reason(row: sqlite3.Row, kind: str) -> str:
    """Return why a kind of request is not possible for a contact; empty if it is."""
    if kind == "revisit" and (row["lat_deg"] is None or row["lon_deg"] is None):
        return "the position of the contact is unknown"
    if kind == "resend" and row["complete"]:
        return "the image is complete"
    if kind == "refine" and not default_registry().is_embedded(row["codec"]):
        return f"the codec {row['codec']} cannot add detail" if row["codec"] else "no part of the image was received"
    if kind == "original" and not row["codec"]:
        return "no part of the image was received"
    if kind == "original" and not row["despeckle_strength"]:
        known = row["despeckle_strength"] is not None
        return "the image is not despeckled" if known else "the stream of the image states no despeckling"
    return ""


def add_request(
    db: sqlite3.Connection,
    contact_id: str,
    kind: CommandKind,
    airtime_s: float | None,
    actor: Actor,
    now_utc_s: float,
) -> str:
    """Store a request; return its identifier.

    `airtime_s` is the displayed estimate, for the audit.

    Raises:
        BadInputError: The request is not possible, or one of this kind is in progress.
    """
    row = find_contact(db, contact_id)
    if reason := unavailable_reason(row, kind):
        raise BadInputError("request", "kind", kind, f"another kind: {reason}")
    in_progress = db.execute(
        "SELECT 1 FROM request WHERE contact_id = ? AND kind = ? AND state IN ('waiting', 'asked', 'sent')",
        (contact_id, kind),
    ).fetchone()
    if in_progress is not None:
        raise BadInputError("request", "kind", kind, "a kind without a request in progress")
    has_position = kind == "revisit"
    record = Command(
        command_id=f"c-{uuid.uuid4().hex}",
        kind=kind,
        vehicle_id=row["vehicle_id"],
        image_id=row["image_id"],
        lat_deg=row["lat_deg"] if has_position else None,
        lon_deg=row["lon_deg"] if has_position else None,
        issued_by=actor.user,
        issued_utc_s=now_utc_s,
    )
    values: Json = {
        "command_id": record.command_id,
        "contact_id": contact_id,
        "vessel_id": row["vessel_id"],
        "kind": kind,
        "user": actor.user,
        "asked_utc_s": now_utc_s,
        "airtime_s": airtime_s,
        "state": "waiting",
        "changed_utc_s": now_utc_s,
        "payload": wire.encode(record),
        "sent": 0,
    }
    insert_row(db, "request", values)
    detail = {"command_id": record.command_id, "kind": kind, "airtime_s": airtime_s}
    add_audit_entry(db, contact_id, actor, "request", now_utc_s, DisplayedImage(row["version"]), detail)
    return record.command_id


def is_later_state(known: str, known_times_sent: int, state: str, times_sent: int | None) -> bool:
    """Return whether a delivery state is later than the known one.

    Times are not compared: clocks of hosts differ, and an acknowledgement may arrive after the first state record.
    """
    if known == state:
        return state == "sent" and times_sent is not None and times_sent > known_times_sent
    return _STATE_ORDER[state] > _STATE_ORDER[known]


def update_request_state(
    db: sqlite3.Connection, command_id: str, state: str, reason: str, times_sent: int | None, utc_s: float
) -> str | None:
    """Update the delivery state of a request; return the contact identifier, None if nothing has changed."""
    row = find_record(db, "request", command_id)
    if row is None or not is_later_state(row["state"], row["times_sent"], state, times_sent):
        return None
    db.execute(
        "UPDATE request SET state = ?, reason = ?, times_sent = ?, changed_utc_s = ? WHERE command_id = ?",
        (state, reason, row["times_sent"] if times_sent is None else times_sent, utc_s, command_id),
    )
    return str(row["contact_id"])


def apply_downlink_state(db: sqlite3.Connection, state: DownlinkState) -> str | None:
    """Update the delivery of a request to the vehicle; return the contact identifier, None if nothing has changed."""
    return update_request_state(db, state.record_id, state.state, state.reason, state.times_sent, state.changed_utc_s)


def apply_tasking_state(db: sqlite3.Connection, state: TaskingState) -> tuple[Table, str] | None:
    """Update the delivery of a request or comment to the vessel; return its table and contact if it has changed."""
    if state.kind == "command":
        contact_id = update_request_state(db, state.record_id, state.state, state.reason, None, state.changed_utc_s)
        return None if contact_id is None else ("request", contact_id)
    row = find_record(db, "advice", state.record_id)
    if row is None or row["state"] in (None, "delivered", "refused") or row["state"] == state.state:
        return None
    db.execute(
        "UPDATE advice SET state = ?, reason = ? WHERE advice_id = ?", (state.state, state.reason, state.record_id)
    )
    return "advice", str(row["contact_id"])


def refuse_advice(db: sqlite3.Connection, advice_id: str, reason: str) -> str | None:
    """Mark a comment as refused by c2; return the contact identifier, None if it is unknown."""
    db.execute(
        "UPDATE advice SET state = 'refused', reason = ? WHERE advice_id = ? AND state = 'waiting'",
        (reason, advice_id),
    )
    row = find_record(db, "advice", advice_id)
    return None if row is None else str(row["contact_id"])


def add_advice(db: sqlite3.Connection, contact_id: str, record: Advice, actor: Actor) -> None:
    """Store a comment of this console."""
    _insert_advice(db, contact_id, record, "waiting")
    detail = record.model_dump(include={"advice_id", "verdict", "confidence", "mlo_class", "remark"})
    displayed = DisplayedImage(record.image_version)
    add_audit_entry(db, contact_id, actor, "advise", record.advised_utc_s, displayed, detail)


def store_received_advice(db: sqlite3.Connection, record: Advice) -> str | None:
    """Store a comment from the shore site. A comment without its image is kept until the image arrives.

    Returns:
        The contact identifier; None if the comment is already stored or its image is not.
    """
    if find_record(db, "advice", record.advice_id) is not None:
        return None
    contact_id = find_contact_of_image(db, record.vessel_id, record.vehicle_id, record.image_id, record.advised_utc_s)
    _insert_advice(db, contact_id or "", record, None)
    return contact_id


def _insert_advice(db: sqlite3.Connection, contact_id: str, record: Advice, state: str | None) -> None:
    values: Json = {
        **record.model_dump(exclude={"image_version"}),
        "contact_id": contact_id,
        "version": record.image_version,
        "state": state,
        "payload": wire.encode(record),
        "sent": int(state is None),
    }
    insert_row(db, "advice", values)
    db.execute("UPDATE contact SET advised = 1 WHERE id = ?", (contact_id,))
