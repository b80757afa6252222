"""Requests to vehicles with their costs, and comments from the shore site, in the database, and their delivery."""

from __future__ import annotations

import sqlite3
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from pydantic import ValidationError

from sonarpost import wire
from sonarpost.codec.registry import default_registry
from sonarpost.errors import BadInputError
from sonarpost.limits import limit
from sonarpost.messages import Command, CommandKind, Comment, Decision, ReconstructedImage, TaskingState
from sonarpost.modem.interface import RateInfo
from sonarpost.review.costs import NEW_IMAGE_KINDS, RequestCost, RequestEstimate, expected_arrival, request_cost
from sonarpost.review.resolution import detail_px, pixel_m, sharp_to_m
from sonarpost.services.console.store.contacts import find_contact, find_contact_of_image
from sonarpost.services.console.store.database import (
    Actor,
    DisplayedImage,
    add_audit_entry,
    find_record,
    insert_row,
)
from sonarpost.services.console.store.request_results import link_record, request_columns
from sonarpost.services.console.store.serialisers import Json, decode_image, find_image, newest_image
from sonarpost.wire import first_error

MAX_WAITING: Final = limit(
    1000, "records", "shares", "the console's records", "vessel", "decisions before images; comments", "it is refused"
)
REQUEST_KINDS: Final[tuple[CommandKind, ...]] = (
    "refine",
    "region",
    "expand",
    "original",
    "resend",
    "prioritise",
    "revisit",
)
"""Kinds in the order of the page."""

_STATE_ORDER: Final = {
    "none": 0,
    "waiting": 0,
    "asked": 1,
    "sent": 2,
    "delivered": 3,
    "confirmed": 3,
    "refused": 3,
    "expired": 3,
}


REFUSAL_VALID_S: Final = 86_400.0
"""Time for which a kind that a vehicle does not support is not offered again."""

_UNSUPPORTED: Final = "unsupported"
"""Reason of a vehicle without a consumer for a kind of command, as op_modem states it."""


def find_obstacle(
    db: sqlite3.Connection, row: sqlite3.Row, kind: CommandKind, now_utc_s: float, *, has_downlink: bool
) -> str | None:
    """Return why a kind of request is not possible for a contact; None if it is. console-api.md explains the reasons.

    Args:
        db: Connection.
        row: The contact.
        kind: Kind of the request.
        now_utc_s: Present time.
        has_downlink: Whether this console can send requests to vehicles.
    """
    image = newest_image(row)
    codec, despeckling = image["codec"], image["despeckle_strength"]
    is_new_image, is_original = kind in NEW_IMAGE_KINDS, kind == "original"
    obstacles = {
        "no_downlink": not has_downlink,
        "unsupported": _is_unsupported(db, row["vehicle_id"], kind, now_utc_s),
        "no_position": kind == "revisit" and (row["lat_deg"] is None or row["lon_deg"] is None),
        "complete": kind in ("resend", "prioritise") and bool(row["complete"]),
        "no_image": kind in ("refine", "original", "region") and not codec,
        "fixed_codec": kind == "refine" and not default_registry().is_embedded(codec),
        "despeckling_unknown": is_original and despeckling is None,
        "not_despeckled": is_original and not despeckling,
        "here": is_new_image and _is_here(db, row["id"], kind),
        "related": is_new_image and row["parent"] is not None,
    }
    return next((obstacle for obstacle, applies in obstacles.items() if applies), None)


def _is_unsupported(db: sqlite3.Connection, vehicle_id: str, kind: CommandKind, now_utc_s: float) -> bool:
    """Return whether the latest answer of a vehicle to this kind is a recent refusal as unsupported."""
    row = db.execute(
        "SELECT r.state, r.reason, r.changed_utc_s FROM request r JOIN contact c ON c.id = r.contact_id"
        " WHERE c.vehicle_id = ? AND r.kind = ? AND (r.state = 'confirmed' OR (r.state = 'refused' AND r.reason = ?))"
        " ORDER BY r.changed_utc_s DESC LIMIT 1",
        (vehicle_id, kind, _UNSUPPORTED),
    ).fetchone()
    return row is not None and row["state"] == "refused" and now_utc_s - row["changed_utc_s"] < REFUSAL_VALID_S


def _is_here(db: sqlite3.Connection, contact_id: str, kind: CommandKind) -> bool:
    sql = "SELECT 1 FROM contact WHERE parent = ? AND relation = ? AND complete"
    return db.execute(sql, (contact_id, kind)).fetchone() is not None


def is_pending(row: sqlite3.Row, now_utc_s: float) -> bool:
    """Return whether a request waits for its result: delivered or on its way, not answered and not late."""
    if row["arrived_utc_s"] is not None:
        return False
    if row["state"] in ("waiting", "asked", "sent"):
        return True
    is_late = row["late_utc_s"] is None or now_utc_s > row["late_utc_s"]
    return row["state"] in ("confirmed", "delivered") and not is_late


def add_request(
    db: sqlite3.Connection,
    contact_id: str,
    kind: CommandKind,
    airtime_s: float | None,
    actor: Actor,
    now_utc_s: float,
    *,
    estimate: RequestEstimate,
    has_downlink: bool,
    arguments: Mapping[str, object],
) -> str:
    """Store a request; return its identifier.

    Args:
        db: Connection in a transaction.
        contact_id: The contact.
        kind: Kind of the request.
        airtime_s: The displayed estimate, for the audit.
        actor: The user.
        now_utc_s: Present time.
        estimate: The present estimate.
        has_downlink: Whether this console can send requests to vehicles.
        arguments: Further fields of the command: `box` and `stream_bytes`.

    Raises:
        BadInputError: The request is not possible, or one of this kind has no result yet.
    """
    row = find_contact(db, contact_id)
    if obstacle := find_obstacle(db, row, kind, now_utc_s, has_downlink=has_downlink):
        raise BadInputError("request", "kind", kind, f"another kind: {obstacle}")
    earlier = db.execute("SELECT * FROM request WHERE contact_id = ? AND kind = ?", (contact_id, kind))
    if kind != "region" and any(is_pending(request, now_utc_s) for request in earlier):
        raise BadInputError("request", "kind", kind, "a kind without a request in progress")
    has_position = kind == "revisit"
    fields = {
        "command_id": f"c-{uuid.uuid4().hex}",
        "kind": kind,
        "vehicle_id": row["vehicle_id"],
        "image_id": row["image_id"],
        "lat_deg": row["lat_deg"] if has_position else None,
        "lon_deg": row["lon_deg"] if has_position else None,
        "issued_by": actor.user,
        "issued_utc_s": now_utc_s,
        "place": "first" if kind == "prioritise" else None,
    }
    try:
        record = Command.model_validate({**fields, **arguments})
    except ValidationError as error:
        raise BadInputError("request", *first_error(error)) from error
    values: Json = {
        "command_id": record.command_id,
        "contact_id": contact_id,
        "vessel_id": row["vessel_id"],
        "kind": kind,
        "user": actor.user,
        "asked_utc_s": now_utc_s,
        "airtime_s": airtime_s,
        "state": "waiting",
        "changed_utc_s": now_utc_s,
        "payload": wire.encode(record),
        "sent": 0,
        **request_columns(row, kind, estimate, now_utc_s),
    }
    insert_row(db, "request", values)
    detail = {"command_id": record.command_id, "kind": kind, "airtime_s": airtime_s, **arguments}
    add_audit_entry(db, contact_id, actor, "request", now_utc_s, DisplayedImage(row["version"]), detail)
    return record.command_id


def is_later_state(known: str, known_times_sent: int, state: str, times_sent: int | None) -> bool:
    """Return whether a delivery state is later than the known one.

    Times are not compared: clocks of hosts differ, and an acknowledgement may arrive after the first state record.
    """
    if known == state:
        return state == "sent" and times_sent is not None and times_sent > known_times_sent
    return _STATE_ORDER[state] > _STATE_ORDER[known]


def update_request_state(
    db: sqlite3.Connection, command_id: str, state: str, reason: str, times_sent: int | None, utc_s: float
) -> None:
    """Update the delivery state of a request."""
    row = find_record(db, "request", command_id)
    if row is None or not is_later_state(row["state"], row["times_sent"], state, times_sent):
        return
    db.execute(
        "UPDATE request SET state = ?, reason = ?, times_sent = ?, changed_utc_s = ? WHERE command_id = ?",
        (state, reason, row["times_sent"] if times_sent is None else times_sent, utc_s, command_id),
    )


def apply_tasking_state(db: sqlite3.Connection, state: TaskingState) -> None:
    """Update the delivery of a request or comment to the vessel."""
    if state.kind == "command":
        update_request_state(db, state.record_id, state.state, state.reason, None, state.changed_utc_s)
        return
    row = find_record(db, "comment", state.record_id)
    if row is None or row["state"] in (None, "delivered", "refused") or row["state"] == state.state:
        return
    db.execute(
        "UPDATE comment SET state = ?, reason = ? WHERE comment_id = ?", (state.state, state.reason, state.record_id)
    )


def refuse_comment(db: sqlite3.Connection, comment_id: str, reason: str) -> None:
    """Mark a comment as refused by c2."""
    db.execute(
        "UPDATE comment SET state = 'refused', reason = ? WHERE comment_id = ? AND state = 'waiting'",
        (reason, comment_id),
    )


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


FRAME_HEADER_BYTES: Final = 13
"""Header of a frame in the format of the paper; a v1 header with authentication is shorter."""
REGION_BYTES: Final = 192
"""Bytes of a region before the operator chooses others."""
_REGION_SHARE: Final = 0.25
"""Share of the image's pixels for which the detail of a region is stated: a box of half of the sides."""


@dataclass(frozen=True, slots=True)
class VehicleLink:
    """Rates of both directions and the loss of the vehicle's frames; None if unknown."""

    downlink: RateInfo
    uplink: RateInfo | None
    loss: float | None


def estimate_request(
    db: sqlite3.Connection, row: sqlite3.Row, kind: CommandKind, link: VehicleLink, stream_bytes: int | None = None
) -> RequestEstimate:
    """Return cost and arrival of a request about a contact; `stream_bytes` is the length of a region's stream."""
    is_new_image = kind in (*NEW_IMAGE_KINDS, "region")
    total = newest_image(row)["bytes_total"]
    if is_new_image:
        total = (stream_bytes or REGION_BYTES) if kind == "region" else _first_stream_bytes(db, row)
    cost = request_cost(
        kind,
        downlink_rate=link.downlink,
        uplink_rate=link.uplink,
        bytes_received=0 if is_new_image else row["bytes_received"],
        bytes_total=total,
        loss=link.loss,
        overhead_bytes=FRAME_HEADER_BYTES,
    )
    record = link_record(db, row["vehicle_id"], link.loss)
    arrival = None
    if kind not in ("revisit", "prioritise") and link.uplink is not None and cost.bytes_wanted is not None:
        arrival = expected_arrival(cost, link.uplink, FRAME_HEADER_BYTES, record)
    return RequestEstimate(cost, arrival, record)


def costs_json(
    db: sqlite3.Connection, row: sqlite3.Row, link: VehicleLink, now_utc_s: float, *, has_downlink: bool
) -> list[Json]:
    """Return the cost of each kind of request for a contact, in the order of the page."""
    image = find_image(db, row["id"])
    found: list[Json] = []
    for kind in REQUEST_KINDS:
        estimate = estimate_request(db, row, kind, link)
        cost, arrival = estimate.cost, estimate.arrival
        found.append(
            {
                "kind": kind,
                "reason_code": find_obstacle(db, row, kind, now_utc_s, has_downlink=has_downlink),
                "airtime_s": cost.airtime_s,
                "downlink_s": cost.downlink_s,
                "bytes": cost.bytes_wanted,
                "median_s": arrival and arrival.median_s,
                "most_s": arrival and arrival.most_s,
                **_gain(kind, cost, image),
                "loss_up": estimate.link.loss_up,
                "packets_sent": estimate.link.sent,
                "packets_lost": estimate.link.lost,
                "past_requests": len(estimate.link.ratios),
            }
        )
    return found


def _gain(kind: CommandKind, cost: RequestCost, image: ReconstructedImage) -> Mapping[str, float | None]:
    """Return the smallest detail of the image now and with the answer, in metres; None if unknown or not better."""
    now_m, size_m = sharp_to_m(image), pixel_m(image)
    pixels = image.pixels.height_px * image.pixels.width_px * (_REGION_SHARE if kind == "region" else 1.0)
    width_px = None
    if kind in ("refine", "resend", "region") and cost.bytes_total:
        width_px = detail_px(image.codec, cost.bytes_total, round(pixels))
    then_m = None if width_px is None or size_m is None else width_px * size_m
    if now_m is None or then_m is None or then_m >= now_m:
        return {"detail_m": None, "new_detail_m": None}
    return {"detail_m": now_m, "new_detail_m": then_m}


def _first_stream_bytes(db: sqlite3.Connection, row: sqlite3.Row) -> int:
    """Return the length of a contact's stream before more detail was requested: that of a new image is similar."""
    versions = db.execute("SELECT * FROM version WHERE contact_id = ? ORDER BY version LIMIT 20", (row["id"],))
    lengths = (decode_image(version).bytes_total for version in versions)
    return int(next((length for length in lengths if length), newest_image(row)["bytes_total"]))
