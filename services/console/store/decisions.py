"""Decisions and comments in the database: insertion, undo, and their delivery to shore site, vehicle and vessel."""

from __future__ import annotations

import sqlite3
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

from sonarpost import wire
from sonarpost.errors import BadInputError, SonarpostError
from sonarpost.limits import limit
from sonarpost.messages import Comment, Decision, DownlinkState, ReconstructedImage, Verdict
from sonarpost.review.decisions import review_result
from sonarpost.services.console.store.association import update_decided_on
from sonarpost.services.console.store.contacts import (
    find_contact,
    find_contact_of_image,
)
from sonarpost.services.console.store.database import (
    Actor,
    DisplayedImage,
    NotFoundError,
    add_audit_entry,
    find_record,
    insert_row,
)
from sonarpost.services.console.store.requests import is_later_state
from sonarpost.services.console.store.serialisers import Json, find_image

MAX_WAITING: Final = limit(
    1000, "records", "shares", "the console's records", "vessel", "decisions before images; comments", "it is refused"
)
_COLUMNS: Final = "decision_id vessel_id vehicle_id image_id verdict operator decided_utc_s"
"""Fields of a decision that have a column of their name."""


class ConflictError(SonarpostError):
    """The contact has changed since it was displayed."""


@dataclass(frozen=True, slots=True)
class DecisionInput:
    """A decision as an operator enters it, with the revision of the contact and the image on the screen.

    Attributes:
        confidence: 0 to 1; None if not stated.
        mlo_class: Class of mine-like object; None if not stated.
        remark: Free text; with `overrules` the reason.
        overrules: Whether the decision replaces those of other operators with another verdict.
        shown_s: Time from the first frame with the image to the verdict; None if unknown.
    """

    revision: int
    displayed: DisplayedImage
    verdict: Verdict
    confidence: float | None
    mlo_class: str | None
    remark: str
    overrules: bool = False
    shown_s: float | None = None


class DeliveryStates(NamedTuple):
    """Initial delivery of a decision.

    Attributes:
        shore: State of the delivery to the shore site; `none` without a configured consumer.
        vehicle: State of the delivery to the vehicle; `none` without a configured consumer.
        take_back_s: Time for which the decision is kept before it is sent.
    """

    shore: str
    vehicle: str
    take_back_s: float = 0.0


class StoredDecision(NamedTuple):
    """Identifier of a new decision, and the other operators who receive a notice about it."""

    decision_id: str
    notified: tuple[str, ...]


def add_decision(
    db: sqlite3.Connection,
    contact_id: str,
    entered: DecisionInput,
    actor: Actor,
    now_utc_s: float,
    delivery: DeliveryStates,
) -> StoredDecision:
    """Store a decision of this console.

    A decision that differs from the standing one of another operator is stored beside it; see `review_result`. With
    `entered.overrules` it replaces the differing ones.

    Raises:
        ConflictError: The decision overrules others, and one was stored after the contact was displayed.
        BadInputError: The displayed image is not a version of this contact, or there is no decision to overrule.
    """
    row = find_contact(db, contact_id)
    if entered.overrules and row["revision"] != entered.revision:
        raise ConflictError("another operator has decided on this contact")
    image = _check_displayed_image(db, contact_id, entered.displayed)
    others = [
        one
        for one in review_result(decisions_on(db, contact_id)).standing
        if one.operator != actor.user and one.verdict != entered.verdict
    ]
    if entered.overrules and not others:
        raise BadInputError("decision", "overrules", "true", "a contact with another verdict of another operator")
    content: Json = {
        "verdict": entered.verdict,
        "confidence": entered.confidence,
        "mlo_class": entered.mlo_class,
        "remark": entered.remark,
        "overrules": tuple(one.decision_id for one in others) if entered.overrules else (),
    }
    record = _add_own_decision(db, row, content, entered.displayed, actor, now_utc_s, delivery)
    db.execute(
        "UPDATE decision SET shown_s = ?, bytes_received = ? WHERE decision_id = ?",
        (entered.shown_s, image.bytes_received, record.decision_id),
    )
    detail = record.model_dump(include={"decision_id", "verdict", "confidence", "mlo_class", "remark"})
    detail |= {"revision": entered.revision, "shown_s": entered.shown_s}
    kind = "overrules" if entered.overrules else "disputes"
    if others and (entered.overrules or find_contact(db, contact_id)["review"] == "disputed"):
        detail[kind] = [one.model_dump(include={"decision_id", "operator", "verdict"}) for one in others]
        for one in others:
            notice: Json = {"user": one.operator, "kind": "overruled" if entered.overrules else "disputed"}
            notice |= {"contact_id": contact_id, "decision_id": one.decision_id, "by_decision_id": record.decision_id}
            insert_row(db, "notice", notice)
    action = "overrule" if entered.overrules else "decide"
    add_audit_entry(db, contact_id, actor, action, now_utc_s, entered.displayed, detail)
    return StoredDecision(record.decision_id, tuple(one.operator for one in others) if kind in detail else ())


def undo_decision(
    db: sqlite3.Connection,
    contact_id: str,
    decision_id: str,
    displayed: DisplayedImage,
    actor: Actor,
    now_utc_s: float,
    delivery: DeliveryStates,
) -> str:
    """Withdraw an own decision with a new record, which repeats the verdict that counts then; return its identifier.

    Without another decision the new record has the verdict `unsure`: records have no verdict `unreviewed`. If the
    withdrawn decision is still kept for its take-back time, neither of both records is sent.

    Raises:
        BadInputError: `decision_id` is not a standing decision of the user at this console, or `displayed` is not a
            version of this contact.
    """
    row = find_contact(db, contact_id)
    if displayed.version is not None:
        _check_displayed_image(db, contact_id, displayed)
    undone = find_record(db, "decision", decision_id)
    records = decisions_on(db, contact_id)
    standing = standing_decisions(db, contact_id)
    own = undone is not None and undone["operator"] == actor.user and not undone["elsewhere"]
    if undone is None or not own or decision_id not in standing:
        raise BadInputError("undo", "decision_id", decision_id, f"a standing decision of {actor.user} at this console")
    kept = undone["send_after_utc_s"] is not None and now_utc_s < undone["send_after_utc_s"]
    # A later record of another operator may depend on this one: then both records are sent.
    kept = kept and not undone["sent"] and row["last_decision"] == decision_id
    previous = review_result([one for one in records if one.decision_id != decision_id]).counting
    content: Json = {"verdict": "unsure"}
    if previous is not None:
        content = previous.model_dump(include={"verdict", "confidence", "mlo_class"})
    content |= {"remark": f"withdraws decision {decision_id}", "withdraws": decision_id}
    states = delivery._replace(take_back_s=0.0)
    record = _add_own_decision(db, row, content, displayed, actor, now_utc_s, states)
    if kept:
        db.execute(
            "UPDATE decision SET shore = iif(shore = 'none', shore, 'withdrawn'), sent = 1, send_after_utc_s = NULL,"
            " vehicle = iif(vehicle = 'none', vehicle, 'withdrawn'), changed_utc_s = ? WHERE decision_id IN (?, ?)",
            (now_utc_s, decision_id, record.decision_id),
        )
    detail = {"decision_id": record.decision_id, "undoes": decision_id, "verdict": record.verdict, "sent": not kept}
    add_audit_entry(db, contact_id, actor, "undo", now_utc_s, displayed, detail)
    return record.decision_id


def release_decisions(db: sqlite3.Connection, now_utc_s: float, take_back_s: float) -> None:
    """End the take-back time of decisions; a decision that is released can be sent.

    A time that is further ahead than `take_back_s` results from a clock that was set back, and has ended too.
    """
    db.execute(
        "UPDATE decision SET send_after_utc_s = NULL WHERE sent = 0 AND send_after_utc_s IS NOT NULL"
        " AND (send_after_utc_s <= ? OR send_after_utc_s > ?)",
        (now_utc_s, now_utc_s + take_back_s),
    )


def standing_decisions(db: sqlite3.Connection, contact_id: str) -> list[str]:
    """Return the identifiers of the decisions on a contact that stand, oldest first; see `review_result`."""
    return [one.decision_id for one in review_result(decisions_on(db, contact_id)).standing]


def last_own_decision(db: sqlite3.Connection, user: str, since_utc_s: float) -> sqlite3.Row | None:
    """Return the last standing decision that a user made at this console since a time; None if there is none."""
    rows = db.execute(
        "SELECT * FROM decision WHERE operator = ? AND elsewhere = 0 AND undone = 0 AND undoes IS NULL"
        " AND contact_id <> '' AND decided_utc_s >= ? ORDER BY seq DESC",
        (user, since_utc_s),
    )
    for row in rows.fetchall():
        if row["decision_id"] in standing_decisions(db, row["contact_id"]):
            found: sqlite3.Row = row
            return found
    return None


def list_notices(db: sqlite3.Connection, user: str) -> list[Json]:
    """Return the notices that a user has not acknowledged and that still apply, oldest first."""
    rows = db.execute(
        "SELECT n.id, n.kind, n.contact_id, c.name, d.verdict AS own_verdict, b.payload"
        " FROM notice n JOIN contact c ON c.id = n.contact_id"
        " JOIN decision d ON d.decision_id = n.decision_id JOIN decision b ON b.decision_id = n.by_decision_id"
        " WHERE n.user = ? AND n.acknowledged_utc_s IS NULL AND b.undone = 0 AND d.undone = 0"
        " AND (n.kind = 'overruled' OR c.review = 'disputed') ORDER BY n.id",
        (user,),
    )
    notices: list[Json] = []
    for row in rows:
        record = wire.decode(Decision, bytes(row["payload"]), f"notice {row['id']}")
        notice = {name: row[name] for name in ("id", "kind", "contact_id", "name", "own_verdict")}
        notices.append({**notice, **record.model_dump(include={"operator", "verdict", "remark", "decided_utc_s"})})
    return notices


def acknowledge_notice(db: sqlite3.Connection, notice_id: int, actor: Actor, now_utc_s: float) -> None:
    """Mark a notice as acknowledged.

    Raises:
        NotFoundError: The user has no such notice.
    """
    row = db.execute("SELECT * FROM notice WHERE id = ? AND user = ?", (notice_id, actor.user)).fetchone()
    if row is None:
        raise NotFoundError("notice", "id", notice_id, f"a notice of {actor.user}")
    db.execute("UPDATE notice SET acknowledged_utc_s = ? WHERE id = ?", (now_utc_s, notice_id))
    detail = {"kind": row["kind"], "decision_id": row["by_decision_id"]}
    add_audit_entry(db, row["contact_id"], actor, "acknowledge", now_utc_s, DisplayedImage(), detail)


def store_received_decision(db: sqlite3.Connection, record: Decision, now_utc_s: float, *, at_shore: bool) -> bool:
    """Store a decision of another program or console; return whether it is new.

    A decision without its image is kept until the image arrives.

    Raises:
        BadInputError: Too many decisions of the vessel wait for their images.
    """
    if find_record(db, "decision", record.decision_id) is not None:
        return False
    contact_id = find_contact_of_image(db, record.vessel_id, record.vehicle_id, record.image_id, record.decided_utc_s)
    if contact_id is None:
        check_waiting(db, record)
    delivery = DeliveryStates("delivered", "none") if at_shore else DeliveryStates("relay", "waiting")
    displayed = DisplayedImage(record.image_version)
    _insert(db, contact_id or "", record, displayed, now_utc_s, delivery, received=True)
    if contact_id is not None:
        _update_contact(db, contact_id, now_utc_s)
    return True


def add_comment(db: sqlite3.Connection, contact_id: str, record: Comment, actor: Actor) -> None:
    """Store a comment of this console."""
    _insert_comment(db, contact_id, record, "waiting")
    detail = record.model_dump(include={"comment_id", "verdict", "confidence", "mlo_class", "remark"})
    displayed = DisplayedImage(record.image_version)
    add_audit_entry(db, contact_id, actor, "comment", record.commented_utc_s, displayed, detail)


def store_received_comment(db: sqlite3.Connection, record: Comment) -> None:
    """Store a comment from the shore site. A comment without its image is kept until the image arrives.

    Raises:
        BadInputError: Too many comments wait for their images.
    """
    if find_record(db, "comment", record.comment_id) is not None:
        return
    contact_id = find_contact_of_image(db, record.vessel_id, record.vehicle_id, record.image_id, record.commented_utc_s)
    if contact_id is None:
        check_waiting(db, record)
    _insert_comment(db, contact_id or "", record, None)


def check_waiting(db: sqlite3.Connection, record: Decision | Comment) -> None:
    """Raise `BadInputError` if too many decisions or comments of a vessel wait for their images."""
    count = f"SELECT COUNT(*) FROM {record.TYPE} WHERE contact_id = '' AND vessel_id = ?"  # noqa: S608  constants only
    if db.execute(count, (record.vessel_id,)).fetchone()[0] >= MAX_WAITING:
        raise BadInputError(record.TYPE, "image_id", record.image_id, f"an image; {MAX_WAITING} others have none yet")


def _insert_comment(db: sqlite3.Connection, contact_id: str, record: Comment, state: str | None) -> None:
    values: Json = {
        **{name: getattr(record, name) for name in ("comment_id", "vessel_id", "vehicle_id", "image_id")},
        "contact_id": contact_id,
        "state": state,
        "payload": wire.encode(record),
        "sent": int(state is None),
    }
    insert_row(db, "comment", values)
    db.execute("UPDATE contact SET commented = 1 WHERE id = ?", (contact_id,))


def update_comment_state(db: sqlite3.Connection, comment_id: str, state: str, reason: str) -> None:
    """Update the delivery of a comment to the vessel; the first final state stays."""
    db.execute(
        "UPDATE comment SET state = ?, reason = ? WHERE comment_id = ? AND state NOT IN ('delivered', 'refused', ?)",
        (state, reason, comment_id, state),
    )


def attach_waiting_records(db: sqlite3.Connection, contact_id: str, now_utc_s: float) -> None:
    """Assign decisions and comments that arrived before their image to the new contact."""
    row = db.execute("SELECT vessel_id, vehicle_id, image_id FROM contact WHERE id = ?", (contact_id,)).fetchone()
    attached = 0
    for table in ("decision", "comment"):
        attached += db.execute(
            f"UPDATE {table} SET contact_id = ? WHERE contact_id = ''"  # noqa: S608  constants only
            " AND vessel_id = ? AND vehicle_id = ? AND image_id = ?",
            (contact_id, *row),
        ).rowcount
    if attached:
        db.execute(
            "UPDATE contact SET commented = EXISTS (SELECT 1 FROM comment WHERE contact_id = ?) WHERE id = ?",
            (contact_id, contact_id),
        )
        _update_contact(db, contact_id, now_utc_s)


def apply_downlink_state(db: sqlite3.Connection, state: DownlinkState) -> None:
    """Update the delivery of a decision to the vehicle."""
    row = find_record(db, "decision", state.record_id)
    if row is None or not is_later_state(row["vehicle"], row["times_sent"], state.state, state.times_sent):
        return
    db.execute(
        "UPDATE decision SET vehicle = ?, reason = ?, times_sent = ?, changed_utc_s = MAX(changed_utc_s, ?)"
        " WHERE decision_id = ?",
        (state.state, state.reason, state.times_sent, state.changed_utc_s, state.record_id),
    )


def apply_acknowledgement(
    db: sqlite3.Connection, decision_id: str, consumer: str, reason: str | None, now_utc_s: float
) -> None:
    """Update a decision after a consumer stored or refused it.

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
        return
    db.execute(
        f"UPDATE decision SET {column} = ?, reason = ?, changed_utc_s = ? WHERE decision_id = ?",  # noqa: S608
        (stored if reason is None else "refused", reason or row["reason"], now_utc_s, decision_id),
    )
    if column == "shore" and reason is None:
        db.execute("UPDATE decision SET relayed_utc_s = ? WHERE decision_id = ?", (now_utc_s, decision_id))


def mark_delivered_to_shore(db: sqlite3.Connection, before_utc_s: float) -> None:
    """Mark decisions that the relay stored before a time as delivered to shore."""
    db.execute(
        "UPDATE decision SET shore = 'delivered', changed_utc_s = MAX(changed_utc_s, ?)"
        " WHERE shore = 'relay' AND COALESCE(relayed_utc_s, changed_utc_s) < ?",
        (before_utc_s, before_utc_s),
    )


def _check_displayed_image(db: sqlite3.Connection, contact_id: str, displayed: DisplayedImage) -> ReconstructedImage:
    """Return the displayed image, if it belongs to the contact, so that the audit can show it again."""
    try:
        image = find_image(db, contact_id, displayed.version)
    except NotFoundError as error:
        raise BadInputError("decision", "version", displayed.version, "a version of this contact's image") from error
    if image.pixels_sha256 != displayed.sha256:
        raise BadInputError("decision", "sha256", displayed.sha256, f"that of version {displayed.version}")
    return image


def _add_own_decision(
    db: sqlite3.Connection,
    row: sqlite3.Row,
    content: Mapping[str, object],
    displayed: DisplayedImage,
    actor: Actor,
    now_utc_s: float,
    delivery: DeliveryStates,
) -> Decision:
    """Store a decision on the contact of a row, and update the contact."""
    names = {name: row[name] for name in ("vessel_id", "vehicle_id", "image_id")}
    fields = {"decision_id": f"d-{uuid.uuid4().hex}", "operator": actor.user, "decided_utc_s": now_utc_s}
    version = displayed.version or row["version"]
    record = Decision.model_validate({**names, **fields, **content, "image_version": version})
    counting = review_result([*decisions_on(db, row["id"]), record]).counting
    # The vehicle acts on the latest verdict that it receives: a differing verdict of a disputed contact is not sent.
    if counting is not None and counting.verdict != record.verdict and delivery.vehicle != "none":
        delivery = delivery._replace(vehicle="disputed")
    _insert(db, row["id"], record, displayed, now_utc_s, delivery)
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
    received: bool = False,
) -> None:
    sent = received or {delivery.shore, delivery.vehicle} <= {"none", "disputed"}
    values: Json = {
        **{name: getattr(record, name) for name in _COLUMNS.split()},
        "contact_id": contact_id,
        "version": record.image_version,
        "sha256": displayed.sha256,
        "layer": displayed.layer,
        "undoes": record.withdraws,
        "elsewhere": int(received),
        "shore": delivery.shore,
        "vehicle": delivery.vehicle,
        "changed_utc_s": now_utc_s,
        "payload": wire.encode(record),
        "sent": int(sent),
        "send_after_utc_s": now_utc_s + delivery.take_back_s if delivery.take_back_s and not sent else None,
    }
    insert_row(db, "decision", values)


def decisions_on(db: sqlite3.Connection, contact_id: str) -> list[Decision]:
    """Return the decisions on a contact, oldest first."""
    rows = db.execute("SELECT payload FROM decision WHERE contact_id = ? ORDER BY decided_utc_s, seq", (contact_id,))
    return [wire.decode(Decision, bytes(row["payload"]), f"decision on {contact_id}") for row in rows]


def _update_contact(db: sqlite3.Connection, contact_id: str, now_utc_s: float) -> None:
    """Update the columns that depend on the decisions on a contact."""
    result = review_result(decisions_on(db, contact_id))
    counting = result.counting
    for decision_id in result.withdrawn:
        db.execute("UPDATE decision SET undone = 1 WHERE decision_id = ?", (decision_id,))
    last = db.execute(
        "SELECT decision_id, COUNT(*) OVER () AS number FROM decision WHERE contact_id = ? ORDER BY seq DESC LIMIT 1",
        (contact_id,),
    ).fetchone()
    db.execute(
        "UPDATE contact SET review = ?, mlo_class = ?, confidence = ?, decided_by = ?, decided_utc_s = ?,"
        " effective = ?, remark = ?, last_decision = ?, revision = ?, updated_utc_s = ? WHERE id = ?",
        (
            result.state,
            counting and counting.mlo_class,
            counting and counting.confidence,
            counting and counting.operator,
            counting and counting.decided_utc_s,
            counting and counting.decision_id,
            "" if counting is None else counting.remark,
            last and last["decision_id"],
            last["number"] if last else 0,
            now_utc_s,
            contact_id,
        ),
    )
    update_decided_on(db, contact_id)
