"""All data of a contact: versions, related images, records of operators and vehicles, looks at its object, audit."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping

from sonarpost.export.tables import further_values
from sonarpost.modem.interface import RateInfo
from sonarpost.review.measurement import summary
from sonarpost.review.objects import AssociationRule
from sonarpost.services.console.store.association import earlier_contacts
from sonarpost.services.console.store.contacts import ContactFilter, find_contact, find_version, list_contacts
from sonarpost.services.console.store.decisions import standing_decisions
from sonarpost.services.console.store.measurements import list_measurements
from sonarpost.services.console.store.related_images import related_images_json
from sonarpost.services.console.store.serialisers import (
    Json,
    audit_json,
    contact_json,
    decode_image,
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
    newest = find_version(db, contact_id, row["version"])
    assert newest is not None
    has_others = row["looks"] > 1
    looks = list_contacts(db, ContactFilter(group=row["group_id"]))["items"] if has_others else []
    record = decode_image(newest).contact
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
