"""Retention of the images in the console's database."""

from __future__ import annotations

import sqlite3
from typing import Final

import numpy as np

from sonarpost import wire
from sonarpost.archive.retention import DAY_S, Stored, select_for_removal, vehicle_source
from sonarpost.errors import BadInputError
from sonarpost.messages import Pixels, ReconstructedImage
from sonarpost.services.console.store.serialisers import decode_image

MAX_IMAGES_AT_ONCE: Final = 200
"""Images removed in one transaction; requests wait for it."""
_SIDE_PX: Final = 16
_NOTE: Final = "image removed by retention"


def remove_images(db: sqlite3.Connection, now_utc_s: float, retain_days: float, max_bytes: int) -> int:
    """Remove the pixels of image versions by age and total size; contacts, decisions and the audit stay.

    Because of the total size, the vehicle with the most bytes loses versions first, with several vessels the vessel:
    superseded versions before the newest ones, in both groups those of contacts without a decision before the others.

    Args:
        db: Connection in a transaction.
        now_utc_s: Current time.
        retain_days: Time after the arrival of a version.
        max_bytes: Maximum size of the stored versions.

    Returns:
        Number of versions whose pixels were removed, at most `MAX_IMAGES_AT_ONCE`.
    """
    total_bytes, oldest_utc_s = db.execute(
        "SELECT COALESCE(SUM(LENGTH(payload)), 0), MIN(received_utc_s) FROM version WHERE removed = 0"
    ).fetchone()
    if oldest_utc_s is None or (now_utc_s - oldest_utc_s <= retain_days * DAY_S and total_bytes <= max_bytes):
        return 0
    rows = db.execute(
        "SELECT v.contact_id, v.version, v.received_utc_s, LENGTH(v.payload),"
        " 2 * (v.version = c.version) + (c.review <> 'unreviewed'),"
        " CASE WHEN (SELECT COUNT(DISTINCT vessel_id) FROM contact) > 1 THEN c.vessel_id ELSE c.vehicle_id END"
        " FROM version v JOIN contact c ON c.id = v.contact_id WHERE v.removed = 0"
    )
    stored = [Stored((str(row[0]), int(row[1])), row[2], row[3], row[4], vehicle_source(row[5])) for row in rows]
    selected = select_for_removal(stored, now_utc_s, retain_days, max_bytes)[:MAX_IMAGES_AT_ONCE]
    for key in selected:
        row = db.execute("SELECT * FROM version WHERE contact_id = ? AND version = ?", key).fetchone()
        try:
            payload = wire.encode(without_pixels(decode_image(row)))
        except BadInputError:
            payload = b""  # it cannot be shown either
        db.execute("UPDATE version SET payload = ?, removed = 1 WHERE contact_id = ? AND version = ?", (payload, *key))
        db.execute("UPDATE contact SET has_image = 0 WHERE id = ? AND version = ?", key)
    return len(selected)


def without_pixels(image: ReconstructedImage) -> ReconstructedImage:
    """Return the record as if only the contact record had arrived."""
    black = Pixels.from_array(np.zeros((_SIDE_PX, _SIDE_PX), dtype=np.uint8))
    changes = {
        "pixels": black,
        "pixels_sha256": black.sha256,
        "codec": "",
        "model": "",
        "missing_mask": np.packbits(np.ones((_SIDE_PX, _SIDE_PX), dtype=np.bool_)).tobytes(),
        "missing_fraction": 1.0,
        "missing_halves": ("top", "bottom"),
        "complete": False,
        "notes": (*image.notes, _NOTE),
    }
    return image.model_copy(update=changes)
