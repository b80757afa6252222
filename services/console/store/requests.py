"""Requests to vehicles with their costs and results, and comments from the shore site: storage, delivery."""

from __future__ import annotations

import sqlite3
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from pydantic import ValidationError

from sonarpost import wire
from sonarpost.codec.region import RegionBox
from sonarpost.codec.registry import default_registry
from sonarpost.errors import BadInputError
from sonarpost.messages import Command, CommandKind, ReconstructedImage
from sonarpost.modem.interface import RateInfo
from sonarpost.review.costs import (
    NEW_IMAGE_KINDS,
    LinkRecord,
    RequestCost,
    RequestEstimate,
    expected_arrival,
    request_cost,
)
from sonarpost.review.resolution import detail_px, pixel_m, sharp_to_m
from sonarpost.services.console.store.database import (
    Actor,
    DisplayedImage,
    add_audit_entry,
    find_record,
    insert_row,
)
from sonarpost.services.console.store.serialisers import Json, decode_image, find_image, newest_image
from sonarpost.wire import first_error

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
    row: sqlite3.Row,
    kind: CommandKind,
    airtime_s: float | None,
    actor: Actor,
    now_utc_s: float,
    *,
    link: VehicleLink,
    has_downlink: bool,
    arguments: Mapping[str, object],
) -> str:
    """Store a request; return its identifier.

    Args:
        db: Connection in a transaction.
        row: The contact.
        kind: Kind of the request.
        airtime_s: The displayed estimate, for the audit.
        actor: The user.
        now_utc_s: Present time.
        link: The present link to the vehicle.
        has_downlink: Whether this console can send requests to vehicles.
        arguments: Further fields of the command: `box` and `stream_bytes`.

    Raises:
        BadInputError: The request is not possible, or one of this kind has no result yet.
    """
    contact_id = row["id"]
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
    estimate = estimate_request(db, row, kind, link, record.stream_bytes)
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


RECENT_RESULTS: Final = 20
"""Latest requests of a vehicle from which the next one is estimated."""
UNKNOWN_COST_LATE_S: Final = 3600.0
LATE_FACTOR: Final = 2.0
LATE_MARGIN_S: Final = 300.0


def link_record(db: sqlite3.Connection, vehicle_id: str, loss_up: float | None) -> LinkRecord:
    """Return what the latest requests to a vehicle show of its link; `loss_up`: see `LinkRecord`."""
    rows = db.execute(
        "SELECT r.*, (r.arrived_utc_s - r.asked_utc_s) / (r.expected_utc_s - r.asked_utc_s) AS ratio"
        " FROM request r JOIN contact c ON c.id = r.contact_id WHERE c.vehicle_id = ? ORDER BY r.seq DESC LIMIT ?",
        (vehicle_id, RECENT_RESULTS),
    ).fetchall()
    tries = [row["times_sent"] for row in rows if row["state"] == "confirmed" and row["times_sent"]]
    ratios = tuple(row["ratio"] for row in rows if row["ratio"] is not None and row["ratio"] > 0)
    return LinkRecord(loss_up, sum(tries), sum(tries) - len(tries), ratios)


def request_columns(contact: sqlite3.Row, kind: str, estimate: RequestEstimate, now_utc_s: float) -> Json:
    """Return the columns of a new request by which its result is recognised.

    The answer is expected at `expected_utc_s`, with 90 % by `probable_utc_s`, and after `late_utc_s` it is late. The
    result of a `revisit` depends on the track of the vehicle: it has no expected time.
    """
    arrival, late_s = estimate.arrival, None
    if kind not in ("revisit", "prioritise"):
        late_s = UNKNOWN_COST_LATE_S if arrival is None else LATE_FACTOR * arrival.most_s + LATE_MARGIN_S
    return {
        "base_version": contact["version"],
        "base_bytes": contact["bytes_received"],
        "base_total": newest_image(contact)["bytes_total"],
        "bytes_wanted": estimate.cost.bytes_wanted,
        "expected_utc_s": arrival and now_utc_s + arrival.median_s,
        "probable_utc_s": arrival and now_utc_s + arrival.most_s,
        "late_utc_s": late_s and now_utc_s + late_s,
    }


_Result = tuple[str, int, int, bool]
"""What has arrived of an answer: contact or image that has it, its version, bytes in addition to those at the time of
the request, whether the answer is complete."""


def update_results(db: sqlite3.Connection, contact_id: str, now_utc_s: float) -> None:
    """Store the results of the requests about a contact after an image has arrived.

    Args:
        db: Connection in a transaction.
        contact_id: The contact of the requests.
        now_utc_s: Time of arrival.
    """
    contact = db.execute("SELECT * FROM contact WHERE id = ?", (contact_id,)).fetchone()
    open_requests = db.execute(
        "SELECT * FROM request WHERE contact_id = ? AND arrived_utc_s IS NULL AND state <> 'refused'", (contact_id,)
    ).fetchall()
    for request in open_requests:
        result = _result_of(db, request, contact)
        known = (request["result_contact"], request["result_version"], request["result_bytes"])
        if result is None or (not result[3] and result[:3] == known):
            continue
        db.execute(
            "UPDATE request SET result_contact = ?, result_version = ?, result_bytes = ?, arrived_utc_s = ?"
            " WHERE command_id = ?",
            (*result[:3], now_utc_s if result[3] else None, request["command_id"]),
        )


def _result_of(db: sqlite3.Connection, request: sqlite3.Row, contact: sqlite3.Row) -> _Result | None:
    kind, base_bytes = request["kind"], request["base_bytes"] or 0
    if kind == "revisit":
        return _revisit_result(db, request, contact)
    if kind == "prioritise":
        return None
    if kind == "region":
        return _region_result(db, request, contact)
    if kind in NEW_IMAGE_KINDS:
        row = db.execute(
            "SELECT id, version, bytes_received, complete FROM contact WHERE parent = ? AND relation = ?"
            " ORDER BY arrived_utc_s DESC LIMIT 1",
            (contact["id"], kind),
        ).fetchone()
        return None if row is None else tuple(row)
    if contact["version"] <= (request["base_version"] or 0):
        return None
    more_bytes = contact["bytes_received"] - base_bytes
    is_whole = bool(contact["complete"])
    if kind == "refine":
        # Bytes up to the length announced at the time of the request were coming without it.
        is_whole = is_whole and contact["bytes_received"] > max(base_bytes, request["base_total"] or 0)
    return (contact["id"], contact["version"], more_bytes, is_whole) if more_bytes > 0 or is_whole else None


def _region_result(db: sqlite3.Connection, request: sqlite3.Row, contact: sqlite3.Row) -> _Result | None:
    """Return the first image of the size of the requested region that answers no other request."""
    command = wire.decode(Command, bytes(request["payload"]), f"request {request['command_id']}")
    assert command.box is not None
    top, left, bottom, right = RegionBox(*command.box).pixels(contact["height_px"], contact["width_px"])
    row = db.execute(
        "SELECT id, version, bytes_received, complete FROM contact WHERE parent = ? AND relation = 'region'"
        " AND height_px = ? AND width_px = ? AND arrived_utc_s >= ? AND id NOT IN (SELECT result_contact FROM request"
        " WHERE result_contact IS NOT NULL AND command_id <> ?) ORDER BY arrived_utc_s LIMIT 1",
        (contact["id"], bottom - top, right - left, request["asked_utc_s"], request["command_id"]),
    ).fetchone()
    return None if row is None else tuple(row)


def _revisit_result(db: sqlite3.Connection, request: sqlite3.Row, contact: sqlite3.Row) -> _Result | None:
    """Return the first later look of the vehicle at the position of the contact."""
    row = db.execute(
        "SELECT id, version, bytes_received, 1 FROM contact"
        " WHERE group_id = ? AND vehicle_id = ? AND id <> ? AND seen_utc_s > ? ORDER BY seen_utc_s LIMIT 1",
        (contact["group_id"], contact["vehicle_id"], contact["id"], request["asked_utc_s"]),
    ).fetchone()
    return None if row is None else tuple(row)


def contacts_with_requests(db: sqlite3.Connection, contact_id: str) -> list[str]:
    """Return the contacts whose requests an image can answer: its contact, and the other looks at one position."""
    row = db.execute("SELECT id, parent, group_id FROM contact WHERE id = ?", (contact_id,)).fetchone()
    own = str(row["parent"] or row["id"])
    others = db.execute(
        "SELECT DISTINCT c.id FROM contact c JOIN request r ON r.contact_id = c.id"
        " WHERE c.group_id = ? AND c.id <> ? AND r.kind = 'revisit' AND r.arrived_utc_s IS NULL",
        (row["group_id"], own),
    )
    return [own, *(str(other["id"]) for other in others)]
