"""Results of requests: expected time of arrival, and the image that answers a request."""

from __future__ import annotations

import sqlite3
import statistics
from dataclasses import asdict, dataclass
from typing import Final

from sonarpost import wire
from sonarpost.codec.region import RegionBox
from sonarpost.messages import Command
from sonarpost.review.costs import NEW_IMAGE_KINDS, RequestCost
from sonarpost.services.console.store.serialisers import Json

RECENT_RESULTS: Final = 5
"""Answered requests of a vehicle from which the duration of the next one is estimated."""
UNKNOWN_COST_LATE_S: Final = 3600.0
FIRST_REQUEST_LATE_FACTOR: Final = 20.0
"""Without an answered request: a request is late after this multiple of its air time and queue."""
LATE_FACTOR: Final = 2.0
LATE_MARGIN_S: Final = 300.0


@dataclass(frozen=True, slots=True)
class ExpectedTimes:
    """When the result of a request is expected, UTC; None if unknown.

    Attributes:
        earliest_utc_s: After the queue of the vehicle and the air time. Turns of other stations add to it.
        expected_utc_s: From the durations of the vehicle's last answered requests.
        late_utc_s: After this time a request without a result is late.
    """

    earliest_utc_s: float | None = None
    expected_utc_s: float | None = None
    late_utc_s: float | None = None


def expected_times(
    db: sqlite3.Connection, vehicle_id: str, cost: RequestCost, kind: str, wait_s: float | None, now_utc_s: float
) -> ExpectedTimes:
    """Return when the result of a new request is expected.

    The result of a `revisit` depends on the track of the vehicle: it has no expected time.
    """
    if kind in ("revisit", "prioritise"):
        return ExpectedTimes()
    if cost.airtime_s is None:
        return ExpectedTimes(late_utc_s=now_utc_s + UNKNOWN_COST_LATE_S)
    shortest_s = cost.airtime_s + (wait_s or 0.0)
    rows = db.execute(
        "SELECT (r.arrived_utc_s - r.asked_utc_s) / r.airtime_s FROM request r JOIN contact c ON c.id = r.contact_id"
        " WHERE c.vehicle_id = ? AND r.arrived_utc_s IS NOT NULL AND r.airtime_s > 0 AND r.kind <> 'revisit'"
        " ORDER BY r.seq DESC LIMIT ?",
        (vehicle_id, RECENT_RESULTS),
    ).fetchall()
    if not rows:
        late_s = FIRST_REQUEST_LATE_FACTOR * shortest_s + LATE_MARGIN_S
        return ExpectedTimes(now_utc_s + shortest_s, None, now_utc_s + late_s)
    expected_s = max(shortest_s, statistics.median(row[0] for row in rows) * cost.airtime_s)
    late_s = LATE_FACTOR * expected_s + LATE_MARGIN_S
    return ExpectedTimes(now_utc_s + shortest_s, now_utc_s + expected_s, now_utc_s + late_s)


def request_columns(
    db: sqlite3.Connection, contact: sqlite3.Row, kind: str, cost: RequestCost, wait_s: float | None, now_utc_s: float
) -> Json:
    """Return the columns of a new request by which its result is recognised."""
    times = expected_times(db, contact["vehicle_id"], cost, kind, wait_s, now_utc_s)
    return {
        "base_version": contact["version"],
        "base_bytes": contact["bytes_received"],
        "base_total": contact["bytes_total"],
        "bytes_wanted": cost.bytes_wanted,
        **asdict(times),
    }


@dataclass(frozen=True, slots=True)
class _Result:
    """What has arrived of the answer to a request.

    Attributes:
        contact_id: Contact or image that has it.
        version: Its version.
        bytes: Received bytes in addition to those at the time of the request.
        is_whole: Whether the answer is complete.
    """

    contact_id: str
    version: int
    bytes: int
    is_whole: bool


def update_results(db: sqlite3.Connection, contact_id: str, now_utc_s: float) -> list[str]:
    """Store the results of the requests about a contact after an image has arrived; return the changed requests.

    Args:
        db: Connection in a transaction.
        contact_id: The contact of the requests.
        now_utc_s: Time of arrival.
    """
    contact = db.execute("SELECT * FROM contact WHERE id = ?", (contact_id,)).fetchone()
    open_requests = db.execute(
        "SELECT * FROM request WHERE contact_id = ? AND arrived_utc_s IS NULL AND state <> 'refused'", (contact_id,)
    ).fetchall()
    changed: list[str] = []
    for request in open_requests:
        result = _result_of(db, request, contact)
        known = (request["result_contact"], request["result_version"], request["result_bytes"])
        if result is None or (not result.is_whole and (result.contact_id, result.version, result.bytes) == known):
            continue
        db.execute(
            "UPDATE request SET result_contact = ?, result_version = ?, result_bytes = ?, arrived_utc_s = ?"
            " WHERE command_id = ?",
            (
                result.contact_id,
                result.version,
                result.bytes,
                now_utc_s if result.is_whole else None,
                request["command_id"],
            ),
        )
        changed.append(str(request["command_id"]))
    return changed


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
        return None if row is None else _Result(row["id"], row["version"], row["bytes_received"], bool(row["complete"]))
    if contact["version"] <= (request["base_version"] or 0):
        return None
    more_bytes = contact["bytes_received"] - base_bytes
    is_whole = bool(contact["complete"])
    if kind == "refine":
        # Bytes up to the length announced at the time of the request were coming without it.
        is_whole = is_whole and contact["bytes_received"] > max(base_bytes, request["base_total"] or 0)
    return _Result(contact["id"], contact["version"], more_bytes, is_whole) if more_bytes > 0 or is_whole else None


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
    return None if row is None else _Result(row["id"], row["version"], row["bytes_received"], bool(row["complete"]))


def _revisit_result(db: sqlite3.Connection, request: sqlite3.Row, contact: sqlite3.Row) -> _Result | None:
    """Return the first later look of the vehicle at the position of the contact."""
    row = db.execute(
        "SELECT id, version, bytes_received FROM contact"
        " WHERE group_id = ? AND vehicle_id = ? AND id <> ? AND seen_utc_s > ? ORDER BY seen_utc_s LIMIT 1",
        (contact["group_id"], contact["vehicle_id"], contact["id"], request["asked_utc_s"]),
    ).fetchone()
    return None if row is None else _Result(row["id"], row["version"], row["bytes_received"], is_whole=True)


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
