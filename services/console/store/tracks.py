"""Tracks of the vehicles: their statuses in the order of arrival, a limited number for each vehicle."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from typing import Final

from sonarpost.messages import ReceivedStatus
from sonarpost.services.console.store.serialisers import Json

MAX_POINTS: Final = 5000
"""Statuses that are stored of a vehicle, the newest ones: 41 hours of one every 30 s."""
MAX_VEHICLES: Final = 200
"""Vehicles of which statuses are stored; those of further ones are ignored."""
MAX_POINTS_DRAWN: Final = 1000
"""Positions of a vehicle on the map, the newest ones."""

_VALUES: Final = (
    "time_utc_s",
    "lat_deg",
    "lon_deg",
    "heading_deg",
    "speed_mps",
    "depth_m",
    "altitude_m",
    "swath_m",
    "battery",
    "images_waiting",
    "disk_free_bytes",
)
_INSERT: Final = (
    "INSERT INTO track (vehicle_id, received_utc_s, authenticated, time_utc_s, lat_deg, lon_deg, heading_deg,"
    " speed_mps, depth_m, altitude_m, swath_m, battery, images_waiting, disk_free_bytes)"
    " VALUES (:vehicle_id, :received_utc_s, :authenticated, :time_utc_s, :lat_deg, :lon_deg, :heading_deg,"
    " :speed_mps, :depth_m, :altitude_m, :swath_m, :battery, :images_waiting, :disk_free_bytes)"
)


def store_status(db: sqlite3.Connection, record: ReceivedStatus) -> bool:
    """Store a status as the latest of its vehicle; return whether it is stored.

    A status with the time and position of the latest one replaces it: the vehicle has no newer position.
    """
    vehicle = record.vehicle_id
    last = db.execute(
        "SELECT seq, time_utc_s, lat_deg, lon_deg FROM track WHERE vehicle_id = ? ORDER BY seq DESC LIMIT 1", (vehicle,)
    ).fetchone()
    if last is None and db.execute("SELECT COUNT(DISTINCT vehicle_id) FROM track").fetchone()[0] >= MAX_VEHICLES:
        return False
    values = {name: getattr(record.status, name) for name in _VALUES}
    if last is not None and all(last[name] == values[name] for name in ("time_utc_s", "lat_deg", "lon_deg")):
        db.execute("DELETE FROM track WHERE seq = ?", (last["seq"],))
    db.execute(
        _INSERT,
        {
            "vehicle_id": vehicle,
            "received_utc_s": record.received_utc_s,
            "authenticated": int(record.authenticated),
            **values,
        },
    )
    db.execute(
        "DELETE FROM track WHERE vehicle_id = :vehicle AND seq <= (SELECT seq FROM track WHERE vehicle_id = :vehicle"
        " ORDER BY seq DESC LIMIT 1 OFFSET :points)",
        {"vehicle": vehicle, "points": MAX_POINTS},
    )
    return True


def latest_statuses(db: sqlite3.Connection) -> dict[str, sqlite3.Row]:
    """Return the latest status of each vehicle by name, all columns of the table."""
    rows = db.execute(
        "SELECT * FROM track WHERE seq IN (SELECT MAX(seq) FROM track GROUP BY vehicle_id) ORDER BY vehicle_id"
    )
    return {row["vehicle_id"]: row for row in rows}


def status_json(row: sqlite3.Row) -> Json:
    """Return a status for the page."""
    return {
        "received_utc_s": row["received_utc_s"],
        "authenticated": bool(row["authenticated"]),
        **{name: row[name] for name in _VALUES},
    }


def track_points(db: sqlite3.Connection, vehicle_id: str, limit: int = MAX_POINTS) -> Sequence[sqlite3.Row]:
    """Return the newest positions of a vehicle in the order of arrival.

    Returns:
        Rows with `seq`, `time_utc_s`, `lat_deg`, `lon_deg`, `heading_deg` and `swath_m`.
    """
    return db.execute(
        "SELECT * FROM (SELECT seq, time_utc_s, lat_deg, lon_deg, heading_deg, swath_m FROM track"
        " WHERE vehicle_id = ? AND lat_deg IS NOT NULL ORDER BY seq DESC LIMIT ?) ORDER BY seq",
        (vehicle_id, limit),
    ).fetchall()


def tracks_json(db: sqlite3.Connection) -> list[Json]:
    """Return the newest positions of each vehicle, (lat_deg, lon_deg) in the order of arrival."""
    names = [row[0] for row in db.execute("SELECT DISTINCT vehicle_id FROM track ORDER BY vehicle_id")]
    tracks: list[Json] = []
    for name in names:
        points = track_points(db, name, MAX_POINTS_DRAWN)
        if points:
            tracks.append({"vehicle_id": name, "points": [[row["lat_deg"], row["lon_deg"]] for row in points]})
    return tracks
