"""All data of a contact for the page, exports and reports, and its measurements.

A withdrawn measurement stays stored.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from sonarpost.export.contacts import ExportContact, ImageSideCar, side_car
from sonarpost.export.tables import further_values
from sonarpost.messages import ReconstructedImage
from sonarpost.modem.interface import RateInfo
from sonarpost.review.measurement import measured_size, summary
from sonarpost.review.objects import AssociationRule
from sonarpost.review.true_scale import ImageLine
from sonarpost.services.console.store.association import earlier_contacts
from sonarpost.services.console.store.contacts import (
    ContactFilter,
    find_contact,
    list_contacts,
)
from sonarpost.services.console.store.database import Actor, DisplayedImage, NotFoundError, add_audit_entry, insert_row
from sonarpost.services.console.store.decisions import decisions_on, standing_decisions
from sonarpost.services.console.store.related_images import related_images_json
from sonarpost.services.console.store.serialisers import (
    Json,
    audit_json,
    contact_json,
    find_image,
    list_records,
    versions_json,
)
from sonarpost.services.console.store.truth import truth_json


def contact_detail_json(
    db: sqlite3.Connection, contact_id: str, rule: AssociationRule, rates: Mapping[int, RateInfo]
) -> Json:
    """Return all stored data of a contact; `rates` are those of the modem.

    Raises:
        NotFoundError: There is no such contact.
    """
    row = find_contact(db, contact_id)
    has_others = row["looks"] > 1
    looks = list_contacts(db, ContactFilter(group=row["group_id"]))["items"] if has_others else []
    record = find_image(db, contact_id).contact
    measured = list_measurements(db, contact_id)
    audit = db.execute("SELECT * FROM audit WHERE contact_id = ? ORDER BY seq", (contact_id,))
    return {
        "contact": contact_json(row),
        "record": record and record.model_dump(),
        "further": further_values(record),
        "versions": versions_json(db, contact_id, rates, row["refine_base"]),
        "related": related_images_json(db, contact_id, rates),
        "decisions": list_records(db, "decision", contact_id),
        "standing": standing_decisions(db, contact_id),
        "comments": list_records(db, "comment", contact_id),
        "requests": list_records(db, "request", contact_id),
        "measurements": measured,
        "size": summary(measured),
        "group": looks,
        "truth": truth_json(db, contact_id),
        "earlier": [contact_json(find_contact(db, one)) for one in earlier_contacts(db, contact_id, rule)],
        "audit": [audit_json(entry) for entry in audit],
    }


_LETTERS = {"length": "L", "width": "W", "shadow": "shadow"}


@dataclass(frozen=True, slots=True)
class StoredContact:
    """A contact of the database.

    Attributes:
        contact: The contact with its decisions and measured size.
        image: The image version.
        lines: Measured lines to draw.
    """

    contact: ExportContact
    image: ReconstructedImage
    lines: tuple[ImageLine, ...]


def find_stored_contact(db: sqlite3.Connection, contact_id: str, version: int) -> StoredContact:
    """Return a contact with an image version, its decisions and measurements."""
    image, measurements = find_image(db, contact_id, version), list_measurements(db, contact_id)
    decisions = tuple(decisions_on(db, contact_id))
    contact = ExportContact(ImageSideCar.model_validate(side_car(image)), decisions, None, measured_size(measurements))
    return StoredContact(contact, image, _image_lines(measurements))


def _image_lines(measurements: Iterable[Json]) -> tuple[ImageLine, ...]:
    """Return the measured lines to draw; withdrawn ones are excluded."""
    found = []
    for body in measurements:
        if body["withdrawn_utc_s"] is None:
            text = f"{_LETTERS[body['kind']]} {body['value_m']:.2f} ± {body['sigma_m']:.2f} m"
            found.append(ImageLine(body["kind"], tuple(body["from"]), tuple(body["to"]), text))
    return tuple(found)


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
    displayed = DisplayedImage(version=found["version"], layer=found["layer"])
    detail = {name: found[name] for name in ("id", "kind", "value_m", "user", "utc_s")}
    add_audit_entry(db, contact_id, actor, "withdraw", now_utc_s, displayed, detail)
    return found
