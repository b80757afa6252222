"""Contacts of the database as exports and reports need them."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from dataclasses import dataclass

from sonarpost import wire
from sonarpost.export.contacts import ExportContact, ImageSideCar, side_car
from sonarpost.messages import Decision, ReconstructedImage
from sonarpost.review.measured_size import measured_size
from sonarpost.review.true_scale import ImageLine
from sonarpost.services.console.store.contacts import find_version
from sonarpost.services.console.store.measurements import list_measurements
from sonarpost.services.console.store.serialisers import Json, decode_image

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


def find_stored_contact(db: sqlite3.Connection, contact_id: str, version: int) -> StoredContact | None:
    """Return a contact with an image version, its decisions and measurements; None if the version was deleted."""
    row = find_version(db, contact_id, version)
    if row is None:
        return None
    rows = db.execute(
        "SELECT payload FROM decision WHERE contact_id = ? ORDER BY decided_utc_s, seq", (contact_id,)
    ).fetchall()
    decisions = tuple(wire.decode(Decision, bytes(row["payload"]), "decision") for row in rows)
    measurements, image = list_measurements(db, contact_id), decode_image(row)
    contact = ExportContact(ImageSideCar.model_validate(side_car(image)), decisions, None, measured_size(measurements))
    return StoredContact(contact, image, _image_lines(measurements))


def _image_lines(measurements: Iterable[Json]) -> tuple[ImageLine, ...]:
    """Return the measured lines to draw; withdrawn ones are excluded."""
    found = []
    for body in measurements:
        start, end = body["from"], body["to"]
        kind = str(body["kind"])
        if body["withdrawn_utc_s"] is not None:
            continue
        assert isinstance(start, list)
        assert isinstance(end, list)
        text = f"{_LETTERS.get(kind, kind)} {body['value_m']:.2f} ± {body['sigma_m']:.2f} m"
        found.append(ImageLine(kind, (start[0], start[1]), (end[0], end[1]), text))
    return tuple(found)
