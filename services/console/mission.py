"""Progress of a mission: contacts, area, air time, queue and decisions, for each vehicle and in total.

Only what the console has received is counted. The surveyed area follows from the statuses of a vehicle; without them
only the area in which contacts lie is known. Air time on the uplink counts received packets since the start of the
console.
"""

from __future__ import annotations

import math
import sqlite3
import statistics
from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Final

from sonarpost.modem.interface import RateInfo
from sonarpost.review.positions import LocalFrame
from sonarpost.services.console.coverage import surveyed_area
from sonarpost.services.console.fleet import FleetMonitor
from sonarpost.services.console.store.serialisers import Json
from sonarpost.services.console.store.tracks import track_points

HOURS: Final = 24
HOUR_S: Final = 3600.0
MAX_CONTACTS: Final = 10_000
"""Maximum number of positions for the area, the newest ones."""
MAX_DECISIONS: Final = 20_000
"""Maximum number of decisions for the statistics of operators, the newest ones."""

Point = tuple[float, float]


def hull_area_m2(points: Sequence[Point]) -> float:
    """Return the area of the convex hull of points in metres; 0 for fewer than three.

    Andrew's monotone chain: A. M. Andrew, Information Processing Letters 9(5), 1979.
    """
    ordered = sorted(set(points))
    if len(ordered) < 3:
        return 0.0
    hull = _half_hull(ordered) + _half_hull(ordered[::-1])
    shifted = [*hull[1:], hull[0]]
    return abs(sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(hull, shifted, strict=True))) / 2


def _half_hull(ordered: Sequence[Point]) -> list[Point]:
    """Return one side of the hull without its last point."""
    half: list[Point] = []
    for point in ordered:
        while len(half) > 1 and _turn(half[-2], half[-1], point) <= 0:
            half.pop()
        half.append(point)
    return half[:-1]


def _turn(origin: Point, a: Point, b: Point) -> float:
    return (a[0] - origin[0]) * (b[1] - origin[1]) - (a[1] - origin[1]) * (b[0] - origin[0])


def contact_area(rows: Sequence[sqlite3.Row]) -> Json | None:
    """Return the area in which contacts and the vehicle at their recording lie.

    Args:
        rows: Contacts with `lat_deg`, `lon_deg`, `vehicle_lat_deg`, `vehicle_lon_deg`, `arrived_utc_s`.

    Returns:
        None if fewer than three positions are known.
    """
    lats: list[float] = []
    lons: list[float] = []
    located = [row for row in rows if row["lat_deg"] is not None]
    for row in located:
        for prefix in ("", "vehicle_"):
            if row[f"{prefix}lat_deg"] is not None:
                lats.append(row[f"{prefix}lat_deg"])
                lons.append(row[f"{prefix}lon_deg"])
    if len(set(zip(lats, lons, strict=True))) < 3:
        return None
    frame = LocalFrame(lats[0], lons[0])
    area_m2 = hull_area_m2(frame.to_local(lats, lons))
    newest = max(row["arrived_utc_s"] for row in located)
    return {"area_m2": round(area_m2, 1), "contacts": len(located), "time_utc_s": newest}


def hourly_counts(arrivals: Sequence[tuple[int, int]], now_utc_s: float) -> list[Json]:
    """Return the number of contacts that arrived in each of the last `HOURS` hours, the present one last.

    Args:
        arrivals: Hour since 1970, and number of contacts in it.
        now_utc_s: Present time.
    """
    counts = dict(arrivals)
    last = math.floor(now_utc_s / HOUR_S)
    hours = range(last - HOURS + 1, last + 1)
    return [{"start_utc_s": hour * HOUR_S, "contacts": counts.get(hour, 0)} for hour in hours]


def operator_statistics(decisions: Sequence[sqlite3.Row]) -> list[Json]:
    """Return the decisions of each operator, with the median time from a contact's arrival to its first verdict.

    Args:
        decisions: Decisions in their order, with `operator`, `verdict`, `contact_id`, `decided_utc_s`, `arrived_utc_s`.
    """
    verdicts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    delays: defaultdict[str, list[float]] = defaultdict(list)
    last: dict[str, float] = {}
    decided: set[str] = set()
    for row in decisions:
        operator = str(row["operator"])
        verdicts[operator][str(row["verdict"])] += 1
        last[operator] = max(last.get(operator, 0.0), row["decided_utc_s"])
        if row["contact_id"] not in decided:
            decided.add(row["contact_id"])
            delays[operator].append(max(0.0, row["decided_utc_s"] - row["arrived_utc_s"]))
    return [
        {
            "operator": operator,
            "decisions": counts.total(),
            "verdicts": dict(counts),
            "first_verdicts": len(delays[operator]),
            "median_s": round(statistics.median(delays[operator]), 1) if delays[operator] else None,
            "time_utc_s": last[operator],
        }
        for operator, counts in sorted(verdicts.items())
    ]


def queue_forecast(queue: Json | None, now_utc_s: float) -> Json | None:
    """Return how many images wait on a vehicle, and when it has sent them at the present rate.

    Args:
        queue: `queue` of a vehicle of the fleet; None if it is not reported.
        now_utc_s: Present time.
    """
    if queue is None:
        return None
    images = queue["images"]
    assert isinstance(images, list)
    ends = [float(image["expected_utc_s"]) for image in images]
    # The list may be shorter than the queue: then its end is not known.
    is_complete = len(ends) == queue["images_waiting"]
    end = max(ends, default=now_utc_s) if is_complete else None
    return {
        "images_waiting": queue["images_waiting"],
        "finished_utc_s": end,
        "work_off_s": None if end is None else round(max(0.0, end - now_utc_s), 1),
        "time_utc_s": queue["time_utc_s"],
        "stale": queue["stale"],
    }


def mission_json(monitor: FleetMonitor, db: sqlite3.Connection, downlink_rate: RateInfo, now_utc_s: float) -> Json:
    """Return the progress of the mission.

    Args:
        monitor: Frames, queues and seabed of the vehicles.
        db: Database of the console.
        downlink_rate: Rate of the vessel.
        now_utc_s: Present time.
    """
    known = monitor.vehicles()
    names = {row[0] for row in db.execute("SELECT vehicle_id FROM contact UNION SELECT vehicle_id FROM track")}
    vehicles: list[Json] = []
    for name in sorted({*known, *names}):
        state = known.get(name, {})
        queue = state.get("queue")
        vehicles.append(
            {
                "vehicle_id": name,
                **_contacts_json(db, name, downlink_rate, now_utc_s),
                "uplink": monitor.uplink_json(name),
                "queue": queue_forecast(queue if isinstance(queue, dict) else None, now_utc_s),
                "seabed": state.get("seabed"),
                "coverage": surveyed_area(track_points(db, name)),
            }
        )
    decisions = db.execute(
        "SELECT * FROM (SELECT d.seq, d.operator, d.verdict, d.contact_id, d.decided_utc_s, c.arrived_utc_s"
        " FROM decision d JOIN contact c ON c.id = d.contact_id WHERE d.undoes IS NULL ORDER BY d.seq DESC LIMIT ?)"
        " ORDER BY seq",
        (MAX_DECISIONS,),
    ).fetchall()
    return {
        "now_utc_s": now_utc_s,
        "vehicles": vehicles,
        "total": _contacts_json(db, None, downlink_rate, now_utc_s),
        "operators": operator_statistics(decisions),
    }


def _contacts_json(db: sqlite3.Connection, vehicle_id: str | None, downlink_rate: RateInfo, now_utc_s: float) -> Json:
    """Return what the database has about the contacts of a vehicle; of all vehicles for None."""
    of = {"vehicle": vehicle_id, "since": now_utc_s - (HOURS + 1) * HOUR_S, "limit": MAX_CONTACTS}
    reviews = db.execute(
        "SELECT review, COUNT(*) FROM contact WHERE :vehicle IS NULL OR vehicle_id = :vehicle GROUP BY review", of
    ).fetchall()
    totals = db.execute(
        "SELECT SUM(bytes_received) AS bytes, MAX(updated_utc_s) AS updated_utc_s, MAX(arrived_utc_s) AS arrived_utc_s"
        " FROM contact WHERE :vehicle IS NULL OR vehicle_id = :vehicle",
        of,
    ).fetchone()
    arrivals = db.execute(
        "SELECT CAST(arrived_utc_s / 3600 AS INTEGER), COUNT(*) FROM contact"
        " WHERE (:vehicle IS NULL OR vehicle_id = :vehicle) AND arrived_utc_s > :since GROUP BY 1",
        of,
    ).fetchall()
    located = db.execute(
        "SELECT lat_deg, lon_deg, vehicle_lat_deg, vehicle_lon_deg, arrived_utc_s FROM contact"
        " WHERE :vehicle IS NULL OR vehicle_id = :vehicle ORDER BY arrived_utc_s DESC LIMIT :limit",
        of,
    ).fetchall()
    sent = db.execute(
        "SELECT SUM(s.times_sent) AS packets, MAX(s.changed_utc_s) AS changed_utc_s FROM"
        " (SELECT contact_id, times_sent, changed_utc_s FROM decision WHERE times_sent > 0 UNION ALL"
        " SELECT contact_id, times_sent, changed_utc_s FROM request WHERE times_sent > 0) s"
        " JOIN contact c ON c.id = s.contact_id WHERE :vehicle IS NULL OR c.vehicle_id = :vehicle",
        of,
    ).fetchone()
    packets = sent["packets"] or 0
    return {
        "contacts": dict(map(tuple, reviews)),
        "contacts_utc_s": totals["arrived_utc_s"],
        "image_bytes": totals["bytes"] or 0,
        "image_bytes_utc_s": totals["updated_utc_s"],
        "hours": hourly_counts([tuple(row) for row in arrivals], now_utc_s),
        "area": contact_area(located),
        "downlink": {
            "transmissions": packets,
            "airtime_s": round(packets * downlink_rate.airtime_s, 1),
            "time_utc_s": sent["changed_utc_s"],
        },
    }
