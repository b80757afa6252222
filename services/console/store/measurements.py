"""Measurements of contacts in the database. A withdrawn measurement stays stored."""

from __future__ import annotations

import json
import sqlite3
from typing import Final

from sonarpost.services.console.store.contacts import NotFoundError
from sonarpost.services.console.store.database import Actor, DisplayedImage, add_audit_entry, insert_row
from sonarpost.services.console.store.serialisers import Json

NOT_WITHDRAWN: Final[Json] = {"withdrawn_by": None, "withdrawn_utc_s": None}


def measurement_json(row: sqlite3.Row) -> Json:
    """Return a measurement."""
    withdrawn = {"withdrawn_by": row["withdrawn_by"], "withdrawn_utc_s": row["withdrawn_utc_s"]}
    return {**json.loads(row["body"]), "id": row["id"], **withdrawn}


def list_measurements(db: sqlite3.Connection, contact_id: str) -> list[Json]:
    """Return the measurements of a contact, oldest first, withdrawn ones included."""
    rows = db.execute("SELECT * FROM measurement WHERE contact_id = ? ORDER BY id", (contact_id,))
    return [measurement_json(row) for row in rows]


def add_measurement(
    db: sqlite3.Connection, contact_id: str, body: Json, displayed: DisplayedImage, actor: Actor, now_utc_s: float
) -> int:
    """Store a measurement, with its entry in the audit; return its identifier."""
    row = {"contact_id": contact_id, "utc_s": now_utc_s, "body": json.dumps(body)}
    measurement_id = insert_row(db, "measurement", row)
    add_audit_entry(db, contact_id, actor, "measure", now_utc_s, displayed, body)
    return measurement_id


def withdraw_measurement(
    db: sqlite3.Connection, contact_id: str, measurement_id: int, actor: Actor, now_utc_s: float
) -> Json:
    """Mark a measurement as withdrawn, with an entry in the audit; return it.

    Raises:
        NotFoundError: The contact has no such measurement, or it is withdrawn.
    """
    changed = db.execute(
        "UPDATE measurement SET withdrawn_by = ?, withdrawn_utc_s = ?"
        " WHERE id = ? AND contact_id = ? AND withdrawn_utc_s IS NULL",
        (actor.user, now_utc_s, measurement_id, contact_id),
    )
    if changed.rowcount == 0:
        expected = f"a measurement of {contact_id} that is not withdrawn"
        raise NotFoundError("measurement", "id", measurement_id, expected)
    found = measurement_json(db.execute("SELECT * FROM measurement WHERE id = ?", (measurement_id,)).fetchone())
    displayed = DisplayedImage(version=int(str(found["version"])), layer=str(found["layer"]))
    detail = {name: found[name] for name in ("id", "kind", "value_m", "user", "utc_s")}
    add_audit_entry(db, contact_id, actor, "withdraw", now_utc_s, displayed, detail)
    return found
