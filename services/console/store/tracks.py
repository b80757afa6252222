"""Tracks of the vehicles: their statuses in the order of arrival, a limited number for each vehicle; surveyed area."""

from __future__ import annotations

import math
import sqlite3
import statistics
from collections.abc import Sequence
from itertools import groupby, pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.limits import limit
from sonarpost.messages import ReceivedStatus
from sonarpost.review.positions import LocalFrame
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


MAX_LEG_M: Final = 1000.0
"""A longer leg is not counted: positions in between were lost, or one is wrong."""
MAX_LEG_S: Final = 900.0
"""A leg of more time is not counted."""
_CELLS_PER_SWATH: Final = 10
_MIN_CELL_M: Final = 2.0
_MAX_CELLS: Final = 2_000_000
"""Cells that are examined; with more, the cells are larger."""

_Leg = tuple[float, float, float, float, float]
"""x and y of both ends, range to each side; metres."""


def surveyed_area(tracks: Sequence[Sequence[sqlite3.Row]]) -> Json | None:
    """Return the area of seabed that vehicles have surveyed together, from their tracks and the range of their sonars.

    Between two following positions the sonar covers a rectangle: the leg, and the smaller of both ranges to each side.
    The area is that of all rectangles together, counted in square cells, so that overlapping lines count once. Gaps
    below the vehicle, and at turns, are not subtracted.

    Args:
        tracks: Positions of each vehicle in the order of arrival, with `time_utc_s`, `lat_deg`, `lon_deg`, `swath_m`.

    Returns:
        `area_m2`, the time of the first counted position (`since_utc_s`), and the `legs`:
        (lat_deg, lon_deg, lat_deg, lon_deg, range_m); None without a leg of known range.
    """
    rows = [row for points in tracks for row in points]
    if not rows:
        return None
    frame = LocalFrame(rows[0]["lat_deg"], rows[0]["lon_deg"])
    places = frame.to_local([row["lat_deg"] for row in rows], [row["lon_deg"] for row in rows])
    legs: list[_Leg] = []
    drawn: list[tuple[float, ...]] = []
    since_utc_s = math.inf
    for (start, before), (end, row) in pairwise(zip(places, rows, strict=True)):
        if before["vehicle_id"] != row["vehicle_id"] or not before["swath_m"] or not row["swath_m"]:
            continue
        is_joined = 0 < row["time_utc_s"] - before["time_utc_s"] <= MAX_LEG_S
        if is_joined and 0 < math.dist(start, end) <= MAX_LEG_M:
            range_m = min(before["swath_m"], row["swath_m"])
            legs.append((*start, *end, range_m))
            drawn.append((before["lat_deg"], before["lon_deg"], row["lat_deg"], row["lon_deg"], range_m))
            since_utc_s = min(since_utc_s, before["time_utc_s"])
    if not legs:
        return None
    return {"area_m2": round(covered_area_m2(legs), 1), "since_utc_s": since_utc_s, "legs": drawn}


def covered_area_m2(legs: Sequence[_Leg]) -> float:
    """Return the area that the rectangles of legs cover together, accurate to about a cell along their edges."""
    cell_m = max(_MIN_CELL_M, statistics.median(leg[4] for leg in legs) / _CELLS_PER_SWATH)
    boxes_m2 = sum((abs(x1 - x0) + 2 * r) * (abs(y1 - y0) + 2 * r) for x0, y0, x1, y1, r in legs)
    cell_m = max(cell_m, math.sqrt(boxes_m2 / _MAX_CELLS))
    covered = np.unique(np.concatenate([_cells(leg, cell_m) for leg in legs]))
    return float(covered.size) * cell_m**2


def _cells(leg: _Leg, cell_m: float) -> npt.NDArray[np.int64]:
    """Return the numbers of the cells whose centres are in the rectangle of a leg."""
    x0, y0, x1, y1, range_m = leg
    columns = np.arange(
        math.floor((min(x0, x1) - range_m) / cell_m), math.ceil((max(x0, x1) + range_m) / cell_m), dtype=np.int64
    )
    rows = np.arange(
        math.floor((min(y0, y1) - range_m) / cell_m), math.ceil((max(y0, y1) + range_m) / cell_m), dtype=np.int64
    )
    east = (columns[None, :] + 0.5) * cell_m - x0
    north = (rows[:, None] + 0.5) * cell_m - y0
    length_m = math.hypot(x1 - x0, y1 - y0)
    along = (east * (x1 - x0) + north * (y1 - y0)) / length_m
    across = np.abs(north * (x1 - x0) - east * (y1 - y0)) / length_m
    inside = (along >= 0) & (along < length_m) & (across < range_m)
    numbers: npt.NDArray[np.int64] = (rows[:, None] << 32) + columns[None, :]
    return numbers[inside]
