"""JSON objects of the HTTP interface, made from database rows and records."""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any, Final, Literal

from sonarpost import wire
from sonarpost.limits import limit
from sonarpost.messages import Comment, Decision, ReconstructedImage
from sonarpost.modem.interface import RateInfo
from sonarpost.review.image_geometry import contact_box, contact_mark, range_axis
from sonarpost.review.resolution import CODEBOOK_CODECS, codebook_edge_px, sharp_to_m
from sonarpost.services.console.store.database import NotFoundError, Table

Json = dict[str, Any]
Stage = Literal["record", "preview", "part", "sent", "refined"]

MAX_VERSIONS: Final = limit(50, "versions", "claims", "contacts of the console", "vehicle", "shown", "the newest")

NEWER_DETAIL: Final = (
    "(c.version > c.decided_version AND (c.decided_bytes IS NULL OR c.bytes_received > c.decided_bytes))"
)
"""SQL condition: the decision was made on fewer bytes than the newest version has."""

COUNTS: Final = "vehicle NOT IN ('disputed', 'withdrawn') AND shore <> 'withdrawn'"
"""SQL condition of decisions whose delivery is displayed, if they are the latest one: neither taken back before they
were sent, nor of a verdict that does not count."""

CONTACT_QUERY: Final = f"""
SELECT c.*, {NEWER_DETAIL} AS newer_detail, t.label, t.is_mine_like,
    d.shore AS d_shore, d.vehicle AS d_vehicle, d.reason AS d_reason, d.times_sent AS d_times_sent,
    d.changed_utc_s AS d_changed_utc_s,
    (SELECT COUNT(*) FROM contact g WHERE g.group_id = c.group_id AND g.sealed < 2) AS looks,
    (SELECT COUNT(*) FROM request r WHERE r.contact_id = c.id AND r.arrived_utc_s IS NULL
        AND r.state NOT IN ('refused', 'expired') AND (r.kind <> 'prioritise' OR r.state <> 'confirmed')
        AND COALESCE(r.late_utc_s, r.asked_utc_s + 86400) > CAST(strftime('%s') AS REAL)) AS asking,
    (SELECT MIN(MAX(r.base_bytes, r.base_total)) FROM request r
        WHERE r.contact_id = c.id AND r.kind = 'refine') AS refine_base
FROM contact c LEFT JOIN truth t ON t.contact_id = c.id AND t.revealed_utc_s IS NOT NULL
LEFT JOIN decision d ON d.seq = (SELECT MAX(seq) FROM decision WHERE contact_id = c.id AND {COUNTS})
"""  # noqa: S608  constants only
"""Start of every query for rows of `contact_json`."""

LISTED: Final = "c.parent IS NULL AND c.sealed < 2"
"""Condition of the contacts in lists: neither the answer to a request nor a sealed contact after its decision."""

_CONTACT_COLUMNS: Final = (
    "id name vessel_id vehicle_id image_id revision version review mlo_class confidence decided_by decided_utc_s"
    " range_m seen_utc_s first_frame_utc_s bytes_received height_px width_px"
)
_IMAGE_FIELDS: Final = "bytes_total complete authenticated"
_RECORD_FIELDS: Final = "atd_class atd_confidence p_mine_like p_other_object lat_deg lon_deg position_sigma_m"
_DELIVERY_COLUMNS: Final = "shore vehicle reason times_sent changed_utc_s"
_REQUEST_COLUMNS: Final = (
    "command_id kind user asked_utc_s airtime_s state times_sent reason changed_utc_s bytes_wanted probable_utc_s"
    " expected_utc_s late_utc_s arrived_utc_s"
)
_NAMED_BY_CONTACT: Final = {"vessel_id", "vehicle_id", "image_id"}
_AUDIT_COLUMNS: Final = "seq utc_s user role address action version sha256 layer"
_VERSION_FIELDS: Final = (
    "version codec model complete missing_fraction bytes_received bytes_total first_frame_utc_s authenticated"
    " despeckle_strength"
)


def _select(row: sqlite3.Row, columns: str, prefix: str = "") -> Json:
    return {name: row[prefix + name] for name in columns.split()}


def newest_image(row: sqlite3.Row) -> Json:
    """Return the newest image version of a contact without pixels, with its contact record, as in a side-car."""
    found: Json = json.loads(row["image"])
    return found


def contact_json(row: sqlite3.Row) -> Json:
    """Return a contact as in lists."""
    decided_on, bytes_decided = row["decided_version"], row["decided_bytes"]
    image = newest_image(row)
    record = image["contact"] or {}
    return {
        **_select(row, _CONTACT_COLUMNS),
        **{name: image[name] for name in _IMAGE_FIELDS.split()},
        **{name: record.get(name) for name in _RECORD_FIELDS.split()},
        "percent_received": row["percent"] if image["complete"] or image["bytes_total"] else None,
        "stage": stage_of(
            complete=image["complete"],
            has_image=bool(row["has_image"]),
            bytes_received=row["bytes_received"],
            bytes_total=image["bytes_total"],
            refine_base=row["refine_base"],
        ),
        "has_image": bool(row["has_image"]),
        "looks": max(1, row["looks"]),
        "object": row["group_id"],
        "contradictory": bool(row["contradictory"]),
        "decided_on": None if decided_on is None else {"version": decided_on, "bytes": bytes_decided},
        "newer_detail": bool(row["newer_detail"]),
        "commented": bool(row["commented"]),
        "delivery": None if row["d_shore"] is None else _select(row, _DELIVERY_COLUMNS, "d_"),
        "open_requests": row["asking"],
        "known": None if row["label"] is None else {"label": row["label"], "is_mine_like": bool(row["is_mine_like"])},
    }


def decision_json(row: sqlite3.Row) -> Json:
    """Return a decision with all fields of its record."""
    record = wire.decode(Decision, bytes(row["payload"]), f"decision {row['decision_id']}")
    return {
        "version": record.image_version,
        "undoes": record.withdraws,
        **record.model_dump(exclude={*_NAMED_BY_CONTACT, "image_version", "withdraws"}),
        **_select(row, "sha256 layer"),
        "undone": bool(row["undone"]),
        "take_back_utc_s": row["send_after_utc_s"],
        "elsewhere": bool(row["elsewhere"]),
        "delivery": _select(row, _DELIVERY_COLUMNS),
    }


def request_json(row: sqlite3.Row) -> Json:
    """Return a request."""
    result: Json | None = None
    if row["result_contact"] is not None:
        result = {"id": row["result_contact"], "version": row["result_version"], "bytes": row["result_bytes"]}
    return {**_select(row, _REQUEST_COLUMNS), "result": result}


def comment_json(row: sqlite3.Row) -> Json:
    """Return a comment with all fields of its record."""
    record = wire.decode(Comment, bytes(row["payload"]), f"comment {row['comment_id']}")
    fields = record.model_dump(exclude={*_NAMED_BY_CONTACT, "image_version"})
    delivery = None if row["state"] is None else {"state": row["state"], "reason": row["reason"]}
    return {"version": record.image_version, **fields, "delivery": delivery}


RECORD_JSON: Final[Mapping[Table, Callable[[sqlite3.Row], Json]]] = {
    "decision": decision_json,
    "request": request_json,
    "comment": comment_json,
}


def list_records(db: sqlite3.Connection, table: Table, contact_id: str) -> list[Json]:
    """Return the decisions, requests or comments about a contact, newest first."""
    rows = db.execute(f"SELECT * FROM {table} WHERE contact_id = ? ORDER BY seq DESC", (contact_id,))  # noqa: S608
    return [RECORD_JSON[table](row) for row in rows]


def audit_json(row: sqlite3.Row) -> Json:
    """Return an entry of the audit."""
    return {**_select(row, _AUDIT_COLUMNS), "detail": json.loads(row["detail"])}


def stage_of(
    *, complete: bool, has_image: bool, bytes_received: int, bytes_total: int, refine_base: int | None
) -> Stage:
    """Return how far the transmission of an image has come.

    Args:
        complete: Everything arrived that the vehicle has planned to send so far.
        has_image: Whether a part of the image arrived.
        bytes_received: Received bytes of the stream.
        bytes_total: Announced length of the stream; 0 if unknown.
        refine_base: Length of the stream at the first request for more detail; None without such a request.
    """
    if not has_image:
        return "record"
    if not complete:
        return "part" if bytes_total else "preview"
    return "sent" if refine_base is None or bytes_received <= refine_base else "refined"


def percent_received(image: ReconstructedImage) -> float:
    """Return the received part of the announced stream in percent; 0 if its length is unknown."""
    if image.complete:
        return 100.0
    if image.bytes_total:
        return round(min(100.0, 100.0 * image.bytes_received / image.bytes_total), 1)
    return 0.0


def decode_image(row: sqlite3.Row) -> ReconstructedImage:
    """Return the record of an image version."""
    return wire.decode(ReconstructedImage, bytes(row["payload"]), f"contact {row['contact_id']}")


def find_image(db: sqlite3.Connection, contact_id: str, version: int | None = None) -> ReconstructedImage:
    """Return the record of an image version, by default of the newest one.

    Raises:
        NotFoundError: There is no such version.
    """
    sql = "SELECT * FROM version WHERE contact_id = ? AND version = IFNULL(?, version) ORDER BY version DESC LIMIT 1"
    row = db.execute(sql, (contact_id, version)).fetchone()
    if row is None:
        raise NotFoundError("contact", "version", version, f"a version of {contact_id}")
    return decode_image(row)


def _airtime(image: ReconstructedImage, rate: RateInfo | None) -> Json:
    """Return the air time of an image.

    A wire format that does not count frames puts several images and messages into one. Their bytes then give the least
    air time.
    """
    if rate is None or not (image.frames_received or image.bytes_received):
        return {"airtime_s": None, "airtime_is": None}
    if image.frames_received:
        return {"airtime_s": math.ceil(image.frames_received / rate.frames) * rate.airtime_s, "airtime_is": "estimated"}
    return {"airtime_s": image.bytes_received / rate.packet_bytes * rate.airtime_s, "airtime_is": "at_least"}


def versions_json(
    db: sqlite3.Connection, contact_id: str, rates: Mapping[int, RateInfo], refine_base: int | None = None
) -> list[Json]:
    """Return the newest `MAX_VERSIONS` image versions of a contact, the latest last; see `version_json`."""
    sql = "SELECT * FROM version WHERE contact_id = ? ORDER BY version DESC LIMIT ?"
    # One image is in memory at a time.
    return [version_json(row, rates, refine_base) for row in db.execute(sql, (contact_id, MAX_VERSIONS))][::-1]


def version_json(row: sqlite3.Row, rates: Mapping[int, RateInfo], refine_base: int | None = None) -> Json:
    """Return an image version; `rates` are those of the modem, `refine_base`: see `stage_of`."""
    image = decode_image(row)
    contact = image.contact
    has_codebook = image.codec in CODEBOOK_CODECS
    pixels = image.pixels.height_px * image.pixels.width_px
    percent = percent_received(image) if image.complete or image.bytes_total else None
    return {
        **{name: getattr(image, name) for name in _VERSION_FIELDS.split()},
        "received_utc_s": row["received_utc_s"],
        "height_px": image.pixels.height_px,
        "width_px": image.pixels.width_px,
        "sha256": image.pixels_sha256,
        "percent_received": percent,
        "stage": stage_of(
            complete=image.complete,
            has_image=bool(image.codec),
            bytes_received=image.bytes_received,
            bytes_total=image.bytes_total,
            refine_base=refine_base,
        ),
        "frames_received": image.frames_received or None,
        "sharp_to_m": sharp_to_m(image),
        **_airtime(image, rates.get(row["rate"])),
        "pixel_along_m": contact.pixel_along_m if contact else None,
        "pixel_across_m": contact.pixel_across_m if contact else None,
        "range_axis": range_axis(contact),
        **_mark_json(image),
        "notes": list(image.notes),
        "texture": "codebook" if has_codebook else None,
        "texture_edge_px": codebook_edge_px(image.bytes_total or image.bytes_received, pixels)
        if has_codebook
        else None,
    }


def _mark_json(image: ReconstructedImage) -> Json:
    """Return the place of the contact in an image, and the box that contains it; null where unknown."""
    size = image.pixels.height_px, image.pixels.width_px
    mark, box = contact_mark(image.contact, *size), contact_box(image.contact, *size)
    return {"mark": None if mark is None else asdict(mark), "box": None if box is None else asdict(box)}
