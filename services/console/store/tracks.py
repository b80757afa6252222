"""Tracks of the vehicles: their statuses in the order of arrival, a limited number for each vehicle."""

from __future__ import annotations

import sqlite3
from itertools import groupby
from typing import Final

from sonarpost.limits import limit
from sonarpost.messages import ReceivedStatus
from sonarpost.services.console.store.database import insert_row
from sonarpost.services.console.store.serialisers import Json

MAX_POINTS: Final = 5000
"""Statuses of a vehicle that are stored of each vessel, the newest ones: 41 hours of one every 30 s."""
MAX_VEHICLES: Final = limit(200, "vehicles", "shares", "tracks of the console", "vessel", "vehicles", "ignored")
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


def store_status(db: sqlite3.Connection, record: ReceivedStatus) -> bool:
    """Store a status as the latest of its vehicle; return whether it is stored.

    Each vessel has a track of the vehicle: its statuses displace none of another vessel. A status with the time and
    position of the latest one replaces it: the vehicle has no newer position.
    """
    source = {"vessel_id": record.vessel_id, "vehicle_id": record.vehicle_id}
    of_source = "FROM track WHERE vessel_id = :vessel_id AND vehicle_id = :vehicle_id"
    newest = f"SELECT seq, time_utc_s, lat_deg, lon_deg {of_source} ORDER BY seq DESC LIMIT 1"
    last = db.execute(newest, source).fetchone()
    number = "SELECT COUNT(DISTINCT vehicle_id) FROM track WHERE vessel_id = ?"
    if last is None and db.execute(number, (record.vessel_id,)).fetchone()[0] >= MAX_VEHICLES:
        return False
    values = {name: getattr(record.status, name) for name in _VALUES}
    if last is not None and all(last[name] == values[name] for name in ("time_utc_s", "lat_deg", "lon_deg")):
        db.execute("DELETE FROM track WHERE seq = ?", (last["seq"],))
    received = {"received_utc_s": record.received_utc_s, "authenticated": int(record.authenticated)}
    insert_row(db, "track", {**source, **received, **values})
    old = f"(SELECT seq {of_source} ORDER BY seq DESC LIMIT 1 OFFSET {MAX_POINTS})"
    db.execute(f"DELETE {of_source} AND seq <= {old}", source)
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


def newest_status(db: sqlite3.Connection) -> int:
    """Return the number of the status that was stored last; 0 without one."""
    return int(db.execute("SELECT COALESCE(MAX(seq), 0) FROM track").fetchone()[0])


def all_tracks(db: sqlite3.Connection) -> list[list[sqlite3.Row]]:
    """Return the positions of each vehicle and vessel, by name and in the order of arrival.

    Returns:
        Rows with `vehicle_id`, `vessel_id`, `time_utc_s`, `lat_deg`, `lon_deg` and `swath_m`.
    """
    rows = db.execute(
        "SELECT vehicle_id, vessel_id, time_utc_s, lat_deg, lon_deg, swath_m FROM track WHERE lat_deg IS NOT NULL"
        " ORDER BY vehicle_id, vessel_id, seq"
    )
    return [list(points) for _, points in groupby(rows, key=lambda row: (row["vehicle_id"], row["vessel_id"]))]


def tracks_json(db: sqlite3.Connection) -> list[Json]:
    """Return the newest positions of each vehicle, (lat_deg, lon_deg) in the order of arrival."""
    return [
        {
            "vehicle_id": points[0]["vehicle_id"],
            "points": [[row["lat_deg"], row["lon_deg"]] for row in points[-MAX_POINTS_DRAWN:]],
        }
        for points in all_tracks(db)
    ]
