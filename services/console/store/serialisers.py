"""From rows of the database to what the interface says."""

from __future__ import annotations

import json
import sqlite3
from typing import Final

from sonarpost import wire
from sonarpost.messages import ReconstructedImage
from sonarpost.review.costs import airtime_of_frames
from sonarpost.review.rendering import LAYERS

Json = dict[str, object]

CONTACT: Final = """
SELECT c.*, d.shore AS d_shore, d.vehicle AS d_vehicle, d.reason AS d_reason, d.times_sent AS d_times_sent,
    d.changed_utc_s AS d_changed_utc_s,
    (SELECT COUNT(*) FROM contact g WHERE g.group_id = c.group_id) AS looks,
    (SELECT COUNT(*) FROM request r WHERE r.contact_id = c.id AND r.state IN ('waiting', 'asked', 'sent')) AS asking
FROM contact c LEFT JOIN decision d ON d.decision_id = c.last_decision
"""
"""The start of every query whose rows `contact_row` takes."""

_PLAIN: Final = (
    "id",
    "name",
    "vessel_id",
    "vehicle_id",
    "image_id",
    "revision",
    "version",
    "review",
    "mlo_class",
    "confidence",
    "decided_by",
    "decided_utc_s",
    "atd_class",
    "atd_confidence",
    "lat_deg",
    "lon_deg",
    "position_sigma_m",
    "range_m",
    "seen_utc_s",
    "first_frame_utc_s",
    "last_frame_utc_s",
    "updated_utc_s",
    "bytes_received",
    "bytes_total",
    "height_px",
    "width_px",
)


def contact_row(row: sqlite3.Row) -> Json:
    """Return a contact as lists show it."""
    several = (row["looks"] or 0) > 1
    return {
        **{name: row[name] for name in _PLAIN},
        "complete": bool(row["complete"]),
        "percent_received": row["percent"],
        "has_picture": bool(row["has_picture"]),
        "thumbnail": f"/api/contacts/{row['id']}/versions/{row['version']}/thumbnail.png",
        "group": row["group_id"] if several else None,
        "looks": row["looks"] if several else 1,
        "advised": bool(row["advised"]),
        "delivery": None if row["d_shore"] is None else _delivery(row, "d_"),
        "open_requests": row["asking"],
    }


def _delivery(row: sqlite3.Row, prefix: str = "") -> Json:
    names = ("shore", "vehicle", "reason", "times_sent", "changed_utc_s")
    return {name: row[prefix + name] for name in names}


def decision_of(row: sqlite3.Row) -> Json:
    """Return a decision."""
    names = ("decision_id", "verdict", "confidence", "mlo_class", "remark", "operator", "decided_utc_s", "version")
    return {
        **{name: row[name] for name in (*names, "sha256", "layer", "undoes")},
        "undone": bool(row["undone"]),
        "elsewhere": bool(row["elsewhere"]),
        "delivery": _delivery(row),
    }


def request_of(row: sqlite3.Row) -> Json:
    """Return a request."""
    names = ("command_id", "kind", "user", "asked_utc_s", "airtime_s", "state", "times_sent", "reason", "changed_utc_s")
    return {name: row[name] for name in names}


def advice_of(row: sqlite3.Row) -> Json:
    """Return advice."""
    names = ("advice_id", "version", "verdict", "confidence", "mlo_class", "remark", "author", "advised_utc_s")
    state = None if row["state"] is None else {"state": row["state"], "reason": row["reason"]}
    return {**{name: row[name] for name in names}, "delivery": state}


def audit_of(row: sqlite3.Row) -> Json:
    """Return an entry of the audit."""
    names = ("seq", "utc_s", "user", "role", "address", "action", "version", "sha256", "layer")
    detail: Json = json.loads(row["detail"])
    return {**{name: row[name] for name in names}, "detail": detail}


def percent_of(image: ReconstructedImage) -> float:
    """Return how much of what was announced has arrived, in percent."""
    if image.complete:
        return 100.0
    if image.bytes_total:
        return round(min(100.0, 100.0 * image.bytes_received / image.bytes_total), 1)
    return 0.0


def image_of(row: sqlite3.Row) -> ReconstructedImage:
    """Return the record of a version."""
    return wire.decode(ReconstructedImage, bytes(row["payload"]), f"contact {row['contact_id']}")


def version_of(row: sqlite3.Row) -> Json:
    """Return a version of a picture."""
    image, rate = image_of(row), row["rate"]
    contact = image.contact
    airtime_s = None if rate is None else airtime_of_frames(image.frames_received, int(rate))
    layers: list[Json] = [
        {
            "name": layer.name,
            "measurable": layer.measurable,
            "synthesised": layer.synthesised,
            "reason": layer.reason,
        }
        for layer in LAYERS
    ]
    plain = ("version", "codec", "model", "complete", "missing_fraction", "bytes_received", "bytes_total")
    times = ("frames_received", "first_frame_utc_s", "last_frame_utc_s")
    return {
        **{name: getattr(image, name) for name in (*plain, *times)},
        "received_utc_s": row["received_utc_s"],
        "height_px": image.picture.height_px,
        "width_px": image.picture.width_px,
        "bits": image.picture.bits,
        "sha256": image.picture_sha256,
        "percent_received": percent_of(image),
        "missing_halves": list(image.missing_halves),
        "airtime_s": airtime_s,
        "airtime_is": None if airtime_s is None else "estimated",
        "pixel_along_m": contact.pixel_along_m if contact else None,
        "pixel_across_m": contact.pixel_across_m if contact else None,
        "notes": list(image.notes),
        "guessed_fraction": 0.0,
        "layers": layers,
    }


def record_of(image: ReconstructedImage) -> Json | None:
    """Return the contact record of a picture, with the side of the nadir; None where none arrived."""
    if image.contact is None:
        return None
    # Pictures are turned before they are sent so that the nadir is to the left, where the side is known.
    return {**image.contact.model_dump(), "nadir_side": "left" if image.contact.channel else None}
