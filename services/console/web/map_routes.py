"""Routes of the map, its tiles, and the fleet."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.contacts import NotFoundError
from sonarpost.services.console.store.serialisers import Json
from sonarpost.services.console.store.tracks import latest_statuses, tracks_json
from sonarpost.services.console.web.access import AccessControl, Call

MAX_CONTACTS = 10_000


class MapRoutes:
    """Routes of the map, its tiles, and the fleet."""

    def __init__(self, state: ConsoleState) -> None:
        self._state = state
        self._tiles_dir = state.config.tiles_dir
        self._zoom_levels = _zoom_levels(self._tiles_dir)

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        return [
            Route("/api/fleet", access.endpoint(lambda _: JSONResponse(self._state.fleet_state()))),
            Route("/api/map", access.endpoint(lambda _: JSONResponse(map_json(self._state)))),
            Route("/tiles/{z:int}/{x:int}/{y:int}.png", access.endpoint(self._tile)),
        ]

    def tiles(self) -> Json | None:
        """Return URL and zoom levels of the map tiles; None if there are none."""
        if not self._zoom_levels:
            return None
        levels = {"min_zoom": min(self._zoom_levels), "max_zoom": max(self._zoom_levels)}
        return {"url": "/tiles/{z}/{x}/{y}.png", **levels}

    def _tile(self, call: Call) -> Response:
        # The parameters are integers: no text of a request becomes part of the path.
        z, x, y = (int(call.request.path_params[name]) for name in "zxy")
        path = None if self._tiles_dir is None else self._tiles_dir / str(z) / str(x) / f"{y}.png"
        if path is None or not path.is_file():
            raise NotFoundError("tile", "", f"{z}/{x}/{y}", "a tile of the folder")
        return FileResponse(path, media_type="image/png", headers={"Cache-Control": "private, max-age=86400"})


def _zoom_levels(folder: Path | None) -> list[int]:
    if folder is None or not folder.is_dir():
        return []
    return sorted(int(path.name) for path in folder.iterdir() if path.is_dir() and path.name.isdecimal())


def map_json(state: ConsoleState) -> Json:
    """Return contacts, vehicles and vessel with WGS 84 positions in degrees."""
    with state.database.read() as db:
        rows = db.execute(
            "SELECT c.id, c.name, c.vehicle_id, c.lat_deg, c.lon_deg, c.position_sigma_m, c.review, c.atd_confidence,"
            " c.atd_class, c.group_id, c.vehicle_lat_deg, c.vehicle_lon_deg, c.heading_deg,"
            " c.pixel_along_m * c.height_px AS along_m,"
            " COALESCE(c.seen_utc_s, c.first_frame_utc_s) AS at_utc_s,"
            " COUNT(*) OVER (PARTITION BY COALESCE(c.group_id, c.id)) AS looks"
            " FROM contact c WHERE c.parent IS NULL AND c.sealed < 2"
            " AND c.lat_deg IS NOT NULL AND c.lon_deg IS NOT NULL ORDER BY at_utc_s DESC LIMIT ?",
            (MAX_CONTACTS,),
        ).fetchall()
        unlocated = db.execute(
            "SELECT COUNT(*) FROM contact WHERE parent IS NULL AND sealed < 2 AND (lat_deg IS NULL OR lon_deg IS NULL)"
        ).fetchone()[0]
        statuses, tracks = latest_statuses(db), tracks_json(db)
    config = state.config
    fleet = state.fleet.vehicles()
    last: dict[str, tuple[float, Json]] = {}  # with the time of the position
    for row in rows:
        if row["vehicle_lat_deg"] is not None:
            place = _place_json(row["vehicle_lat_deg"], row["vehicle_lon_deg"], row["heading_deg"])
            last.setdefault(row["vehicle_id"], (row["at_utc_s"], place))
    for name, row in statuses.items():
        if row["lat_deg"] is not None and (name not in last or row["time_utc_s"] >= last[name][0]):
            last[name] = (row["time_utc_s"], _place_json(row["lat_deg"], row["lon_deg"], row["heading_deg"]))
    return {
        "contacts": [_contact_json(row) for row in rows],
        "unlocated": unlocated,
        "vehicles": [
            {"vehicle_id": name, **place, "utc_s": utc_s, "stale": name not in fleet or fleet[name]["stale"]}
            for name, (utc_s, place) in sorted(last.items())
        ],
        "tracks": tracks,
        "ranges": [{"vehicle_id": name, **measured} for name, measured in state.fleet.measured_ranges().items()],
        "vessel": None
        if config.vessel_lat_deg is None
        else {"lat_deg": config.vessel_lat_deg, "lon_deg": config.vessel_lon_deg},
        "ring_m": list(config.ring_m),
    }


def _place_json(lat_deg: float, lon_deg: float, heading_deg: float | None) -> Json:
    return {"lat_deg": lat_deg, "lon_deg": lon_deg, "heading_deg": heading_deg}


def _contact_json(row: sqlite3.Row) -> Json:
    names = ("id", "name", "lat_deg", "lon_deg", "review", "atd_confidence", "atd_class", "looks")
    return {name: row[name] for name in names} | {
        "sigma_m": row["position_sigma_m"],
        "group": row["group_id"] if row["looks"] > 1 else None,
        "vehicle_lat_deg": row["vehicle_lat_deg"],
        "vehicle_lon_deg": row["vehicle_lon_deg"],
        "heading_deg": row["heading_deg"],
        "along_m": row["along_m"],
    }
