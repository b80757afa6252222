"""Decisions in the database: insertion, undo, and their delivery to shore site and vehicle."""

from __future__ import annotations

import sqlite3
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from sonarpost import wire
from sonarpost.errors import BadInputError, SonarpostError
from sonarpost.messages import Decision, DownlinkState, Verdict
from sonarpost.services.console.store.contacts import find_contact, find_contact_of_image, find_version
from sonarpost.services.console.store.database import (
    Actor,
    DisplayedImage,
    add_audit_entry,
    find_record,
    insert_row,
)
from sonarpost.services.console.store.requests import is_later_state
from sonarpost.services.console.store.serialisers import Json, contact_json, decision_json, decode_image


class ConflictError(SonarpostError):
    """The contact has changed since it was displayed.

    Attributes:
        contact: The contact at present.
        decision: Its last decision; None if there is none.
    """

    def __init__(self, contact: Json, decision: Json | None) -> None:
        super().__init__("another operator has decided on this contact")
        self.contact = contact
        self.decision = decision


@dataclass(frozen=True, slots=True)
class DecisionInput:
    """A decision as an operator enters it, with the revision of the contact and the image on the screen.

    Attributes:
        confidence: 0 to 1; None if not stated.
        mlo_class: Class of mine-like object; None if not stated.
    """

    revision: int
    displayed: DisplayedImage
    verdict: Verdict
    confidence: float | None
    mlo_class: str | None
    remark: str


class DeliveryStates(NamedTuple):
    """Initial delivery state of a decision to shore site and vehicle; `none` without a configured consumer."""

    shore: str
    vehicle: str


def add_decision(
    db: sqlite3.Connection,
    contact_id: str,
    entered: DecisionInput,
    actor: Actor,
    now_utc_s: float,
    delivery: DeliveryStates,
) -> str:
    """Store a decision of this console; return its identifier.

    Raises:
        ConflictError: Another decision was stored after the contact was displayed.
        BadInputError: The displayed image is not a version of this contact.
    """
    row = _check_revision(db, contact_id, entered.revision)
    _check_displayed_image(db, contact_id, entered.displayed)
    content: Json = {
        "verdict": entered.verdict,
        "confidence": entered.confidence,
        "mlo_class": entered.mlo_class,
        "remark": entered.remark,
    }
    record = _add_own_decision(db, row, content, entered.displayed, actor, now_utc_s, delivery)
    detail = record.model_dump(include={"decision_id", "verdict", "confidence", "mlo_class", "remark"})
    detail["revision"] = row["revision"]
    add_audit_entry(db, contact_id, actor, "decide", now_utc_s, entered.displayed, detail)
    return record.decision_id


def undo_decision(
    db: sqlite3.Connection,
    contact_id: str,
    decision_id: str,
    revision: int,
    actor: Actor,
    now_utc_s: float,
    delivery: DeliveryStates,
) -> str:
    """Undo the valid decision with a new one, which restores the verdict before it; return the new identifier.

    If there was no decision before, the new record has the verdict `unsure`: records have no verdict `unreviewed`.

    Raises:
        ConflictError: Another decision was stored after the contact was displayed.
        BadInputError: `decision_id` is not the valid decision.
    """
    row = _check_revision(db, contact_id, revision)
    if row["effective"] != decision_id:
        raise BadInputError("undo", "decision_id", decision_id, f"the valid decision, {row['effective']}")
    undone = find_record(db, "decision", decision_id)
    assert undone is not None
    db.execute("UPDATE decision SET undone = 1 WHERE decision_id = ?", (decision_id,))
    previous = _valid_decision(db, contact_id)
    content: Json = {"verdict": "unsure"}
    if previous is not None:
        content = {name: previous[name] for name in ("verdict", "confidence", "mlo_class")}
    content["remark"] = f"withdraws decision {decision_id}"
    displayed = DisplayedImage(undone["version"], undone["sha256"], undone["layer"])
    record = _add_own_decision(db, row, content, displayed, actor, now_utc_s, delivery, undoes=decision_id)
    detail = {"decision_id": record.decision_id, "undoes": decision_id, "verdict": record.verdict, "revision": revision}
    add_audit_entry(db, contact_id, actor, "undo", now_utc_s, displayed, detail)
    return record.decision_id


def store_received_decision(
    db: sqlite3.Connection, record: Decision, now_utc_s: float, *, at_shore: bool
) -> str | None:
    """Store a decision of another program or console. A decision without its image is kept until the image arrives.

    Returns:
        The contact identifier; None if the decision is already stored or its image is not.
    """
    if find_record(db, "decision", record.decision_id) is not None:
        return None
    contact_id = find_contact_of_image(db, record.vessel_id, record.vehicle_id, record.image_id, record.decided_utc_s)
    delivery = DeliveryStates("delivered", "none") if at_shore else DeliveryStates("relay", "waiting")
    displayed = DisplayedImage(record.image_version)
    _insert(db, contact_id or "", record, displayed, now_utc_s, delivery, received=True)
    if contact_id is not None:
        _update_contact(db, contact_id, now_utc_s)
    return contact_id


def attach_waiting_records(db: sqlite3.Connection, contact_id: str, now_utc_s: float) -> None:
    """Assign decisions and comments that arrived before their image to the new contact."""
    row = db.execute("SELECT vessel_id, vehicle_id, image_id FROM contact WHERE id = ?", (contact_id,)).fetchone()
    attached = 0
    for table in ("decision", "advice"):
        attached += db.execute(
            f"UPDATE {table} SET contact_id = ? WHERE contact_id = ''"  # noqa: S608  constants only
            " AND vessel_id = ? AND vehicle_id = ? AND image_id = ?",
            (contact_id, *row),
        ).rowcount
    if attached:
        db.execute(
            "UPDATE contact SET advised = EXISTS (SELECT 1 FROM advice WHERE contact_id = ?) WHERE id = ?",
            (contact_id, contact_id),
        )
        _update_contact(db, contact_id, now_utc_s)


def apply_downlink_state(db: sqlite3.Connection, state: DownlinkState) -> bool:
    """Update the delivery of a decision to the vehicle; return whether it has changed."""
    row = find_record(db, "decision", state.record_id)
    if row is None or not is_later_state(row["vehicle"], row["times_sent"], state.state, state.times_sent):
        return False
    db.execute(
        "UPDATE decision SET vehicle = ?, reason = ?, times_sent = ?, changed_utc_s = MAX(changed_utc_s, ?)"
        " WHERE decision_id = ?",
        (state.state, state.reason, state.times_sent, state.changed_utc_s, state.record_id),
    )
    return True


def apply_acknowledgement(
    db: sqlite3.Connection, decision_id: str, consumer: str, reason: str | None, now_utc_s: float
) -> str | None:
    """Update a decision after a consumer stored or refused it; return the contact identifier, None without a change.

    Args:
        db: Connection in a transaction.
        decision_id: Identifier of the decision.
        consumer: `relay` for the way to the shore site; any other for the way to the vehicle.
        reason: Reason of the refusal; None if the consumer has stored the decision.
        now_utc_s: Time of the acknowledgement.
    """
    row = find_record(db, "decision", decision_id)
    column, stored = ("shore", "relay") if consumer == "relay" else ("vehicle", "asked")
    if row is None or row[column] != "waiting":
        return None
    db.execute(
        f"UPDATE decision SET {column} = ?, reason = ?, changed_utc_s = ? WHERE decision_id = ?",  # noqa: S608
        (stored if reason is None else "refused", reason or row["reason"], now_utc_s, decision_id),
    )
    if column == "shore" and reason is None:
        db.execute("UPDATE decision SET relayed_utc_s = ? WHERE decision_id = ?", (now_utc_s, decision_id))
    return str(row["contact_id"])


def mark_delivered_to_shore(db: sqlite3.Connection, before_utc_s: float) -> list[str]:
    """Mark decisions that the relay stored before a time as delivered to shore; return their identifiers."""
    rows = db.execute(
        "UPDATE decision SET shore = 'delivered', changed_utc_s = MAX(changed_utc_s, ?)"
        " WHERE shore = 'relay' AND COALESCE(relayed_utc_s, changed_utc_s) < ? RETURNING decision_id",
        (before_utc_s, before_utc_s),
    )
    return [str(row["decision_id"]) for row in rows.fetchall()]


def _check_revision(db: sqlite3.Connection, contact_id: str, revision: int) -> sqlite3.Row:
    """Return the row of a contact if it still has the displayed revision."""
    row = find_contact(db, contact_id)
    if row["revision"] != revision:
        last = None if row["last_decision"] is None else find_record(db, "decision", row["last_decision"])
        raise ConflictError(contact_json(row), None if last is None else decision_json(last))
    return row


def _check_displayed_image(db: sqlite3.Connection, contact_id: str, displayed: DisplayedImage) -> None:
    """Check that the displayed image belongs to the contact, so that the audit can show it again."""
    row = None if displayed.version is None else find_version(db, contact_id, displayed.version)
    if row is None:
        raise BadInputError("decision", "version", displayed.version, "a version of this contact's image")
    if decode_image(row).picture_sha256 != displayed.sha256:
        raise BadInputError("decision", "sha256", displayed.sha256, f"that of version {displayed.version}")


def _add_own_decision(
    db: sqlite3.Connection,
    row: sqlite3.Row,
    content: Mapping[str, object],
    displayed: DisplayedImage,
    actor: Actor,
    now_utc_s: float,
    delivery: DeliveryStates,
    *,
    undoes: str | None = None,
) -> Decision:
    """Store a decision on the contact of a row, and update the contact."""
    names = {name: row[name] for name in ("vessel_id", "vehicle_id", "image_id")}
    fields = {"decision_id": f"d-{uuid.uuid4().hex}", "operator": actor.user, "decided_utc_s": now_utc_s}
    version = displayed.version or row["version"]
    record = Decision.model_validate({**names, **fields, **content, "image_version": version})
    _insert(db, row["id"], record, displayed, now_utc_s, delivery, undoes=undoes)
    _update_contact(db, row["id"], now_utc_s)
    return record


def _insert(
    db: sqlite3.Connection,
    contact_id: str,
    record: Decision,
    displayed: DisplayedImage,
    now_utc_s: float,
    delivery: DeliveryStates,
    *,
    undoes: str | None = None,
    received: bool = False,
) -> None:
    values: Json = {
        **record.model_dump(exclude={"image_version"}),
        "contact_id": contact_id,
        "version": record.image_version,
        "sha256": displayed.sha256,
        "layer": displayed.layer,
        "undoes": undoes,
        "elsewhere": int(received),
        "shore": delivery.shore,
        "vehicle": delivery.vehicle,
        "changed_utc_s": now_utc_s,
        "payload": wire.encode(record),
        "sent": int(received or delivery == DeliveryStates("none", "none")),
    }
    insert_row(db, "decision", values)


def _valid_decision(db: sqlite3.Connection, contact_id: str) -> sqlite3.Row | None:
    """Return the latest decision that is not undone and does not undo another."""
    row: sqlite3.Row | None = db.execute(
        "SELECT * FROM decision WHERE contact_id = ? AND undone = 0 AND undoes IS NULL"
        " ORDER BY decided_utc_s DESC, seq DESC LIMIT 1",
        (contact_id,),
    ).fetchone()
    return row


def _update_contact(db: sqlite3.Connection, contact_id: str, now_utc_s: float) -> None:
    """Update the columns of a contact that depend on its decisions."""
    valid = _valid_decision(db, contact_id)
    last = db.execute(
        "SELECT decision_id, COUNT(*) OVER () AS number FROM decision WHERE contact_id = ? ORDER BY seq DESC LIMIT 1",
        (contact_id,),
    ).fetchone()
    db.execute(
        "UPDATE contact SET review = ?, mlo_class = ?, confidence = ?, decided_by = ?, decided_utc_s = ?,"
        " effective = ?, remark = ?, last_decision = ?, revision = ?, updated_utc_s = ? WHERE id = ?",
        (
            "unreviewed" if valid is None else valid["verdict"],
            valid and valid["mlo_class"],
            valid and valid["confidence"],
            valid and valid["operator"],
            valid and valid["decided_utc_s"],
            valid and valid["decision_id"],
            "" if valid is None else valid["remark"],
            last and last["decision_id"],
            last["number"] if last else 0,
            now_utc_s,
            contact_id,
        ),
    )
