"""Decisions in the database: made on what was on the screen, never overwritten, undone by a record more."""

from __future__ import annotations

import sqlite3
import uuid
from dataclasses import dataclass

from sonarpost import wire
from sonarpost.errors import BadInputError, SonarpostError
from sonarpost.messages import Decision, DownlinkState, Verdict
from sonarpost.services.console.store import database
from sonarpost.services.console.store.contacts import contact_of_picture, find_row
from sonarpost.services.console.store.database import OnScreen
from sonarpost.services.console.store.requests import is_news
from sonarpost.services.console.store.serialisers import Json, contact_row, decision_of, image_of
from sonarpost.services.console.store.users import Actor


class ConflictError(SonarpostError):
    """Somebody was faster: the contact is not as it was on the screen.

    Attributes:
        contact: As it is now.
        decision: The last one about it, None where there is none.
    """

    def __init__(self, contact: Json, decision: Json | None) -> None:
        super().__init__("the contact has been decided on meanwhile")
        self.contact = contact
        self.decision = decision


@dataclass(frozen=True, slots=True)
class DecisionInput:
    """What somebody decides, and on what.

    Attributes:
        revision: The contact's, as it was on the screen.
        screen: The picture that was.
    """

    revision: int
    screen: OnScreen
    verdict: Verdict
    confidence: float | None
    mlo_class: str | None
    remark: str


def decide(
    db: sqlite3.Connection,
    contact_id: str,
    judgement: DecisionInput,
    actor: Actor,
    now_utc_s: float,
    ends: tuple[str, str],
) -> str:
    """Write a decision down, to be sent; return its identifier.

    Args:
        db: In a transaction.
        contact_id: Of a contact that exists.
        judgement: The decision.
        actor: Who makes it.
        now_utc_s: When.
        ends: State of delivery to begin with, ashore and on the vehicle: `waiting`, or `none` where nobody takes it.

    Raises:
        ConflictError: Somebody else has decided since.
        BadInputError: The picture named is not a version of this contact.
    """
    row = _unchanged(db, contact_id, judgement.revision)
    _check_screen(db, contact_id, judgement.screen)
    record = Decision(
        decision_id=f"d-{uuid.uuid4().hex}",
        vessel_id=row["vessel_id"],
        vehicle_id=row["vehicle_id"],
        image_id=row["image_id"],
        image_version=judgement.screen.version or row["version"],
        verdict=judgement.verdict,
        confidence=judgement.confidence,
        mlo_class=judgement.mlo_class,
        remark=judgement.remark,
        operator=actor.user,
        decided_utc_s=now_utc_s,
    )
    _insert(db, contact_id, record, judgement.screen, None, now_utc_s, ends)
    _settle_contact(db, contact_id, now_utc_s)
    detail = record.model_dump(include={"decision_id", "verdict", "confidence", "mlo_class", "remark"})
    database.write(
        db, contact_id, actor, "decide", now_utc_s, judgement.screen, {**detail, "revision": row["revision"]}
    )
    return record.decision_id


def undo(
    db: sqlite3.Connection,
    contact_id: str,
    decision_id: str,
    revision: int,
    actor: Actor,
    now_utc_s: float,
    ends: tuple[str, str],
) -> str:
    """Undo the decision that counts, by a record that puts back the one before; return the new one's identifier.

    Raises:
        ConflictError: Somebody else has decided since.
        BadInputError: It is not the decision that counts.
    """
    row = _unchanged(db, contact_id, revision)
    if row["effective"] != decision_id:
        raise BadInputError("undo", "decision_id", decision_id, f"the decision that counts, {row['effective']}")
    undone = db.execute("SELECT * FROM decision WHERE decision_id = ?", (decision_id,)).fetchone()
    db.execute("UPDATE decision SET undone = 1 WHERE decision_id = ?", (decision_id,))
    before = _effective(db, contact_id)
    record = Decision(
        decision_id=f"d-{uuid.uuid4().hex}",
        vessel_id=row["vessel_id"],
        vehicle_id=row["vehicle_id"],
        image_id=row["image_id"],
        image_version=undone["version"],
        verdict="unsure" if before is None else before["verdict"],
        confidence=None if before is None else before["confidence"],
        mlo_class=None if before is None else before["mlo_class"],
        remark=f"withdraws decision {decision_id}",
        operator=actor.user,
        decided_utc_s=now_utc_s,
    )
    screen = OnScreen(undone["version"], undone["sha256"], undone["layer"])
    _insert(db, contact_id, record, screen, decision_id, now_utc_s, ends)
    _settle_contact(db, contact_id, now_utc_s)
    detail = {"decision_id": record.decision_id, "undoes": decision_id, "verdict": record.verdict, "revision": revision}
    database.write(db, contact_id, actor, "undo", now_utc_s, screen, detail)
    return record.decision_id


def take(db: sqlite3.Connection, record: Decision, now_utc_s: float, *, ashore: bool) -> str | None:
    """Keep a decision that was made elsewhere; return its contact, None where it is known or its picture is not here.

    It may come before its picture: then it waits for that.
    """
    if db.execute("SELECT 1 FROM decision WHERE decision_id = ?", (record.decision_id,)).fetchone():
        return None
    at = record.decided_utc_s
    contact_id = contact_of_picture(db, record.vessel_id, record.vehicle_id, record.image_id, at)
    shore, vehicle = ("delivered", "none") if ashore else ("relay", "waiting")
    _insert(db, contact_id or "", record, OnScreen(record.image_version), None, now_utc_s, (shore, vehicle), sent=True)
    if contact_id is not None:
        _settle_contact(db, contact_id, now_utc_s)
    return contact_id


def adopt(db: sqlite3.Connection, contact_id: str, now_utc_s: float) -> None:
    """Give a new contact the decisions and the advice that came before it."""
    row = db.execute("SELECT vessel_id, vehicle_id, image_id FROM contact WHERE id = ?", (contact_id,)).fetchone()
    found = 0
    for table in ("decision", "advice"):
        found += db.execute(
            f"UPDATE {table} SET contact_id = ? WHERE contact_id = ''"  # noqa: S608  constants only
            " AND vessel_id = ? AND vehicle_id = ? AND image_id = ?",
            (contact_id, *row),
        ).rowcount
    if found:
        db.execute(
            "UPDATE contact SET advised = EXISTS (SELECT 1 FROM advice WHERE contact_id = ?1) WHERE id = ?1",
            (contact_id,),
        )
        _settle_contact(db, contact_id, now_utc_s)


def find(db: sqlite3.Connection, decision_id: str) -> sqlite3.Row | None:
    """Return a decision's row, None where it is not known."""
    row: sqlite3.Row | None = db.execute("SELECT * FROM decision WHERE decision_id = ?", (decision_id,)).fetchone()
    return row


def of_contact(db: sqlite3.Connection, contact_id: str) -> list[Json]:
    """Return the decisions about a contact, the last first."""
    rows = db.execute("SELECT * FROM decision WHERE contact_id = ? ORDER BY seq DESC", (contact_id,))
    return [decision_of(row) for row in rows]


def downlink(db: sqlite3.Connection, state: DownlinkState) -> bool:
    """Note how far a decision has come on its way to the vehicle; tell whether that was news."""
    row = find(db, state.record_id)
    if row is None or not is_news(row["vehicle"], row["times_sent"], state.state, state.times_sent):
        return False
    db.execute(
        "UPDATE decision SET vehicle = ?, reason = ?, times_sent = ?, changed_utc_s = MAX(changed_utc_s, ?)"
        " WHERE decision_id = ?",
        (state.state, state.reason, state.times_sent, state.changed_utc_s, state.record_id),
    )
    return True


def handed(db: sqlite3.Connection, decision_id: str, consumer: str, reason: str | None, now_utc_s: float) -> bool:
    """Note that a consumer on the vessel has a decision on its disk, or refused it; tell whether that was news."""
    row = find(db, decision_id)
    column = "shore" if consumer == "relay" else "vehicle"
    if row is None or row[column] != "waiting":
        return False
    taken = "relay" if column == "shore" else "asked"
    db.execute(
        f"UPDATE decision SET {column} = ?, reason = ?, changed_utc_s = ? WHERE decision_id = ?",  # noqa: S608
        (taken if reason is None else "refused", reason or row["reason"], now_utc_s, decision_id),
    )
    if column == "shore" and reason is None:
        db.execute("UPDATE decision SET relayed_utc_s = ? WHERE decision_id = ?", (now_utc_s, decision_id))
    return True


def ashore_before(db: sqlite3.Connection, utc_s: float) -> list[str]:
    """Note that whatever the relay had before a time is ashore; return those decisions."""
    found = [
        str(row["decision_id"])
        for row in db.execute(
            "SELECT decision_id FROM decision WHERE shore = 'relay' AND COALESCE(relayed_utc_s, changed_utc_s) < ?",
            (utc_s,),
        )
    ]
    for decision_id in found:
        db.execute(
            "UPDATE decision SET shore = 'delivered', changed_utc_s = MAX(changed_utc_s, ?) WHERE decision_id = ?",
            (utc_s, decision_id),
        )
    return found


def _unchanged(db: sqlite3.Connection, contact_id: str, revision: int) -> sqlite3.Row:
    row = find_row(db, contact_id)
    assert row is not None  # whoever calls has looked
    if row["revision"] != revision:
        last = None if row["last_decision"] is None else find(db, row["last_decision"])
        raise ConflictError(contact_row(row), None if last is None else decision_of(last))
    return row


def _check_screen(db: sqlite3.Connection, contact_id: str, screen: OnScreen) -> None:
    """Refuse a decision on a picture that is not this contact's: the audit must be able to show it again."""
    row = db.execute(
        "SELECT payload, contact_id FROM version WHERE contact_id = ? AND version = ?", (contact_id, screen.version)
    ).fetchone()
    if row is None:
        raise BadInputError("decision", "version", screen.version, "a version of this contact's picture")
    sha256 = image_of(row).picture_sha256
    if sha256 != screen.sha256:
        raise BadInputError("decision", "sha256", screen.sha256, f"that of version {screen.version}")


def _insert(
    db: sqlite3.Connection,
    contact_id: str,
    record: Decision,
    screen: OnScreen,
    undoes: str | None,
    now_utc_s: float,
    ends: tuple[str, str],
    *,
    sent: bool = False,
) -> None:
    values: Json = {
        **record.model_dump(exclude={"image_version"}),
        "contact_id": contact_id,
        "version": record.image_version,
        "sha256": screen.sha256,
        "layer": screen.layer,
        "undoes": undoes,
        "elsewhere": int(sent),
        "shore": ends[0],
        "vehicle": ends[1],
        "changed_utc_s": now_utc_s,
        "payload": wire.encode(record),
        "sent": int(sent or ends == ("none", "none")),
    }
    names, places = ", ".join(values), ", ".join("?" * len(values))
    db.execute(f"INSERT INTO decision ({names}) VALUES ({places})", tuple(values.values()))  # noqa: S608


def _effective(db: sqlite3.Connection, contact_id: str) -> sqlite3.Row | None:
    row: sqlite3.Row | None = db.execute(
        "SELECT * FROM decision WHERE contact_id = ? AND undone = 0 AND undoes IS NULL"
        " ORDER BY decided_utc_s DESC, seq DESC LIMIT 1",
        (contact_id,),
    ).fetchone()
    return row


def _settle_contact(db: sqlite3.Connection, contact_id: str, now_utc_s: float) -> None:
    """Bring a contact in line with its decisions."""
    now = _effective(db, contact_id)
    last = db.execute(
        "SELECT decision_id, COUNT(*) OVER () AS number FROM decision WHERE contact_id = ? ORDER BY seq DESC LIMIT 1",
        (contact_id,),
    ).fetchone()
    db.execute(
        "UPDATE contact SET review = ?, mlo_class = ?, confidence = ?, decided_by = ?, decided_utc_s = ?,"
        " effective = ?, remark = ?, last_decision = ?, revision = ?, updated_utc_s = ? WHERE id = ?",
        (
            "unreviewed" if now is None else now["verdict"],
            now and now["mlo_class"],
            now and now["confidence"],
            now and now["operator"],
            now and now["decided_utc_s"],
            now and now["decision_id"],
            "" if now is None else now["remark"],
            last and last["decision_id"],
            last["number"] if last else 0,
            now_utc_s,
            contact_id,
        ),
    )
