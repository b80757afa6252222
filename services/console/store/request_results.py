"""Results of requests: what they show of the link, when they are expected, and the image that answers a request."""

from __future__ import annotations

import sqlite3
from typing import Final

from sonarpost import wire
from sonarpost.codec.region import RegionBox
from sonarpost.messages import Command
from sonarpost.review.costs import NEW_IMAGE_KINDS, LinkRecord, RequestEstimate
from sonarpost.services.console.store.serialisers import Json, newest_image

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
