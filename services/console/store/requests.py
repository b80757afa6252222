"""Requests to vehicles and advice to vessels in the database, with what they cost and how far they have come."""

from __future__ import annotations

import sqlite3
import uuid
from typing import Final, Literal

from sonarpost import wire
from sonarpost.codec.registry import default_registry
from sonarpost.errors import BadInputError
from sonarpost.messages import Advice, Command, CommandKind, DownlinkState, TaskingState
from sonarpost.services.console.store import database
from sonarpost.services.console.store.contacts import contact_of_picture, find_row
from sonarpost.services.console.store.database import OnScreen
from sonarpost.services.console.store.serialisers import Json, advice_of, request_of
from sonarpost.services.console.store.users import Actor

KINDS: Final[tuple[CommandKind, ...]] = ("refine", "resend", "revisit", "wider")
_RANK: Final = {
    "none": 0,
    "waiting": 0,
    "asked": 1,
    "sent": 2,
    "delivered": 3,
    "confirmed": 3,
    "refused": 3,
    "expired": 3,
}

Table = Literal["decision", "request", "advice"]
ID_COLUMN: Final[dict[Table, str]] = {"decision": "decision_id", "request": "command_id", "advice": "advice_id"}


def why_not(row: sqlite3.Row, kind: str) -> str:
    """Return why a contact's picture cannot be asked for in this way; empty where it can."""
    if kind == "revisit" and (row["lat_deg"] is None or row["lon_deg"] is None):
        return "the contact's position is not known"
    if kind == "resend" and row["complete"]:
        return "all of the picture that the vehicle announced is here"
    if kind == "refine" and not default_registry().is_embedded(row["codec"]):
        return f"the codec {row['codec']} makes no longer stream" if row["codec"] else "nothing of its picture is here"
    return ""


def ask(
    db: sqlite3.Connection,
    contact_id: str,
    kind: CommandKind,
    airtime_s: float | None,
    actor: Actor,
    now_utc_s: float,
) -> str:
    """Write a request down, to be sent; return its identifier.

    Args:
        db: In a transaction.
        contact_id: Of a contact that exists.
        kind: What is asked.
        airtime_s: What it costs, as it was shown.
        actor: Who asks.
        now_utc_s: When.

    Raises:
        BadInputError: It cannot be asked of this contact.
    """
    row = find_row(db, contact_id)
    assert row is not None  # whoever calls has looked
    if reason := why_not(row, kind):
        raise BadInputError("request", "kind", kind, f"another kind: {reason}")
    # A refused or expired one may be asked again; one under way is not doubled.
    open_one = db.execute(
        "SELECT 1 FROM request WHERE contact_id = ? AND kind = ? AND state IN ('waiting', 'asked', 'sent')",
        (contact_id, kind),
    ).fetchone()
    if open_one is not None:
        raise BadInputError("request", "kind", kind, "one that is not under way already")
    place = kind == "revisit"
    record = Command(
        command_id=f"c-{uuid.uuid4().hex}",
        kind=kind,
        vehicle_id=row["vehicle_id"],
        image_id=row["image_id"],
        lat_deg=row["lat_deg"] if place else None,
        lon_deg=row["lon_deg"] if place else None,
        issued_by=actor.user,
        issued_utc_s=now_utc_s,
    )
    db.execute(
        "INSERT INTO request (command_id, contact_id, vessel_id, kind, user, asked_utc_s, airtime_s, state,"
        " changed_utc_s, payload, sent) VALUES (?, ?, ?, ?, ?, ?, ?, 'waiting', ?, ?, 0)",
        (
            record.command_id,
            contact_id,
            row["vessel_id"],
            kind,
            actor.user,
            now_utc_s,
            airtime_s,
            now_utc_s,
            wire.encode(record),
        ),
    )
    detail = {"command_id": record.command_id, "kind": kind, "airtime_s": airtime_s}
    database.write(db, contact_id, actor, "request", now_utc_s, OnScreen(row["version"]), detail)
    return record.command_id


def requests_of(db: sqlite3.Connection, contact_id: str) -> list[Json]:
    """Return the requests about a contact, the last first."""
    rows = db.execute("SELECT * FROM request WHERE contact_id = ? ORDER BY seq DESC", (contact_id,))
    return [request_of(row) for row in rows]


def is_news(was: str, was_sent: int, state: str, times_sent: int | None) -> bool:
    """Tell whether a state is farther on than what is known.

    Not by its time: clocks of hosts differ, and a receipt may come after the first report.
    """
    if was == state:
        return state == "sent" and times_sent is not None and times_sent > was_sent
    return _RANK[state] > _RANK[was]


def request_state(
    db: sqlite3.Connection, command_id: str, state: str, reason: str, times_sent: int | None, utc_s: float
) -> str | None:
    """Note how far a request has come; return its contact, None where that is no news."""
    row = db.execute("SELECT * FROM request WHERE command_id = ?", (command_id,)).fetchone()
    if row is None or not is_news(row["state"], row["times_sent"], state, times_sent):
        return None
    db.execute(
        "UPDATE request SET state = ?, reason = ?, times_sent = ?, changed_utc_s = ? WHERE command_id = ?",
        (state, reason, row["times_sent"] if times_sent is None else times_sent, utc_s, command_id),
    )
    return str(row["contact_id"])


def downlink(db: sqlite3.Connection, state: DownlinkState) -> str | None:
    """Note how far a request has come on its way to the vehicle; return its contact, None where that is no news."""
    return request_state(db, state.record_id, state.state, state.reason, state.times_sent, state.changed_utc_s)


def advise(db: sqlite3.Connection, contact_id: str, record: Advice, actor: Actor) -> None:
    """Write advice down, to be sent."""
    _insert_advice(db, contact_id, record, "waiting")
    detail = record.model_dump(include={"advice_id", "verdict", "confidence", "mlo_class", "remark"})
    screen = OnScreen(record.image_version)
    database.write(db, contact_id, actor, "advise", record.advised_utc_s, screen, detail)


def take_advice(db: sqlite3.Connection, record: Advice) -> str | None:
    """Keep advice from ashore; return its contact, None where it is known or its picture is not here yet."""
    if db.execute("SELECT 1 FROM advice WHERE advice_id = ?", (record.advice_id,)).fetchone():
        return None
    at = record.advised_utc_s
    contact_id = contact_of_picture(db, record.vessel_id, record.vehicle_id, record.image_id, at)
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
    names, places = ", ".join(values), ", ".join("?" * len(values))
    db.execute(f"INSERT INTO advice ({names}) VALUES ({places})", tuple(values.values()))  # noqa: S608
    db.execute("UPDATE contact SET advised = 1 WHERE id = ?", (contact_id,))


def advice_for(db: sqlite3.Connection, contact_id: str) -> list[Json]:
    """Return the advice about a contact, the last first."""
    rows = db.execute("SELECT * FROM advice WHERE contact_id = ? ORDER BY seq DESC", (contact_id,))
    return [advice_of(row) for row in rows]


def tasking(db: sqlite3.Connection, state: TaskingState) -> tuple[Table, str] | None:
    """Note how far advice or a command has come on its way to the vessel; return which table and contact changed."""
    if state.kind == "command":
        contact_id = request_state(db, state.record_id, state.state, state.reason, None, state.changed_utc_s)
        return None if contact_id is None else ("request", contact_id)
    row = db.execute("SELECT * FROM advice WHERE advice_id = ?", (state.record_id,)).fetchone()
    if row is None or row["state"] in (None, "delivered", "refused") or row["state"] == state.state:
        return None
    db.execute(
        "UPDATE advice SET state = ?, reason = ? WHERE advice_id = ?", (state.state, state.reason, state.record_id)
    )
    return "advice", str(row["contact_id"])
