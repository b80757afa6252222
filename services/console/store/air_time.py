"""Air time in the database: images that vehicles still send, and the air time that verdicts give back."""

from __future__ import annotations

import sqlite3
import statistics
from typing import Final

from sonarpost.messages import QueueState
from sonarpost.modem.interface import RateInfo
from sonarpost.review.airtime import WaitingImage, gain_bits, gain_per_s, proposal
from sonarpost.review.costs import least_airtime_s
from sonarpost.services.console.store.database import insert_row
from sonarpost.services.console.store.serialisers import Json

HORIZON_S: Final = 60.0
"""Time of the proposal."""
MAX_IMAGES: Final = 100
"""Images of one vehicle in the list."""
MAX_GIVEN_BACK: Final = 20
RECENT_S: Final = 6 * 3600.0
"""Without a queue: an image that received nothing for this time is not expected any more."""
_TYPICAL_OF: Final = 50
FINAL: Final = ("mine_like", "not_mine_like")


def _typical_bytes(db: sqlite3.Connection, vehicle_id: str) -> float | None:
    """Return the median length of the last complete images of a vehicle; None if it has none."""
    rows = db.execute(
        "SELECT bytes_received FROM contact WHERE vehicle_id = ? AND complete AND bytes_received > 0"
        " ORDER BY updated_utc_s DESC LIMIT ?",
        (vehicle_id, _TYPICAL_OF),
    ).fetchall()
    return statistics.median(row[0] for row in rows) if rows else None


def waiting_rows(
    db: sqlite3.Connection, vehicle_id: str, queue: QueueState | None, now_utc_s: float
) -> list[tuple[sqlite3.Row, int, float | None]]:
    """Return contact, bytes left and expected time of the images that a vehicle still sends, in order of transmission.

    Without a queue they are estimated from incomplete images and the typical length of complete ones.
    """
    if queue is not None:
        found: list[tuple[sqlite3.Row, int, float | None]] = []
        for image in queue.images[:MAX_IMAGES]:
            row = db.execute(
                "SELECT * FROM contact WHERE vehicle_id = ? AND image_id = ? ORDER BY first_s DESC LIMIT 1",
                (vehicle_id, image.image_id),
            ).fetchone()
            if row is not None:
                found.append((row, image.bytes_left, image.expected_utc_s))
        return found
    typical = _typical_bytes(db, vehicle_id)
    if typical is None:
        return []
    rows = db.execute(
        "SELECT * FROM contact WHERE vehicle_id = ? AND NOT complete AND updated_utc_s > ?"
        " ORDER BY first_frame_utc_s, id LIMIT ?",
        (vehicle_id, now_utc_s - RECENT_S, MAX_IMAGES),
    ).fetchall()
    return [
        (row, round(typical - row["bytes_received"]), None)
        for row in rows
        if row["bytes_received"] < typical and not _is_stopped(db, row)
    ]


def _is_stopped(db: sqlite3.Connection, row: sqlite3.Row) -> bool:
    found = db.execute(
        "SELECT 1 FROM decision WHERE decision_id = ? AND vehicle = 'confirmed' AND verdict IN (?, ?)",
        (row["effective"], *FINAL),
    ).fetchone()
    return found is not None


def _p_mine_like(row: sqlite3.Row) -> float | None:
    if row["p_mine_like"] is not None:
        return float(row["p_mine_like"])
    return None if row["atd_confidence"] is None else float(row["atd_confidence"]) / 2.0


def vehicle_json(
    db: sqlite3.Connection, vehicle_id: str, queue: QueueState | None, rate: RateInfo | None, now_utc_s: float
) -> Json:
    """Return the images that a vehicle still sends, with cost and gain, and the proposal for the next minute.

    `rate` is that of the queue, if there is one.
    """
    images: list[Json] = []
    waiting: list[WaitingImage] = []
    rows = [] if rate is None else waiting_rows(db, vehicle_id, queue, now_utc_s)
    for row, bytes_left, expected_utc_s in rows:
        assert rate is not None
        cost_s = least_airtime_s(bytes_left, rate)
        image = WaitingImage(
            row["id"], row["bytes_received"], bytes_left, cost_s, _p_mine_like(row), row["review"] in FINAL
        )
        waiting.append(image)
        images.append(
            {
                "id": row["id"],
                "name": row["name"],
                "review": row["review"],
                "bytes_received": row["bytes_received"],
                "bytes_left": bytes_left,
                "cost_s": round(cost_s, 1),
                "gain_bits": round(gain_bits(image), 4),
                "gain_per_s": round(gain_per_s(image), 5),
                "expected_utc_s": expected_utc_s,
            }
        )
    names = {str(image["id"]): image["name"] for image in images}
    first = [{"id": key, "name": names[key]} for key in proposal(waiting, HORIZON_S)]
    return {
        "vehicle_id": vehicle_id,
        "rate": None if rate is None else rate.number,
        "basis": "queue" if queue is not None else "estimate",
        "images": images,
        "proposal": {"horizon_s": HORIZON_S, "send": first},
    }


def store_given_back(
    db: sqlite3.Connection,
    decision_id: str,
    contact_id: str,
    queue: QueueState | None,
    rate: RateInfo | None,
    now: float,
) -> None:
    """Store the estimate of the air time that a final verdict gives back; nothing if nothing of the image is left.

    `rate` is that of the queue, if there is one.
    """
    contact = db.execute("SELECT vehicle_id FROM contact WHERE id = ?", (contact_id,)).fetchone()
    rows = waiting_rows(db, contact["vehicle_id"], queue, now)
    bytes_left = next((left for row, left, _ in rows if row["id"] == contact_id), 0)
    if rate is None or bytes_left <= 0:
        return
    values: Json = {
        "decision_id": decision_id,
        "contact_id": contact_id,
        "bytes_left": bytes_left,
        "seconds": least_airtime_s(bytes_left, rate),
        "basis": "queue" if queue is not None else "estimate",
    }
    insert_row(db, "given_back", values)


def given_back_json(db: sqlite3.Connection) -> Json:
    """Return the air time that verdicts gave back: the sum of the confirmed ones, and the latest verdicts."""
    query = (
        " FROM given_back g JOIN decision d ON d.decision_id = g.decision_id JOIN contact c ON c.id = g.contact_id"
        " WHERE NOT d.undone"
    )
    total = db.execute("SELECT COALESCE(SUM(g.seconds), 0)" + query + " AND d.vehicle = 'confirmed'").fetchone()[0]
    rows = db.execute(
        "SELECT g.*, c.name, d.vehicle, d.verdict" + query + " ORDER BY d.seq DESC LIMIT ?", (MAX_GIVEN_BACK,)
    ).fetchall()
    names = ("decision_id", "contact_id", "name", "verdict", "bytes_left", "seconds", "basis", "vehicle")
    return {"total_s": round(total, 1), "decisions": [{name: row[name] for name in names} for row in rows]}
