"""Where everything is and how it is: map, fleet, tiles."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from starlette.responses import FileResponse, Response
from starlette.routing import Route

from sonarpost.review.local import LocalFrame, distance_m
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.state import Board, NoSuchError
from sonarpost.services.console.store.serialisers import Json
from sonarpost.services.console.web.access import Call, Gate, json_answer

MOST_ON_MAP = 10_000


class PlaceRoutes:
    """The routes of map and fleet.

    Args:
        board: The console's state.
    """

    def __init__(self, board: Board) -> None:
        self._board = board
        self._tiles = tile_levels(board.config.tiles_dir)

    def routes(self, gate: Gate) -> list[Route]:
        """Return the routes."""
        return [
            Route("/api/fleet", gate.open(lambda _: json_answer(fleet(self._board)))),
            Route("/api/map", gate.open(lambda _: json_answer(chart(self._board)))),
            Route("/tiles/{z:int}/{x:int}/{y:int}.png", gate.open(self._tile)),
        ]

    def tiles(self) -> Json | None:
        """Return where tiles are, None where there are none."""
        if not self._tiles:
            return None
        return {"url": "/tiles/{z}/{x}/{y}.png", "min_zoom": min(self._tiles), "max_zoom": max(self._tiles)}

    def _tile(self, call: Call) -> Response:
        # Whole numbers only: no name from outside becomes part of a path.
        z, x, y = (int(call.request.path_params[name]) for name in "zxy")
        folder = self._board.config.tiles_dir
        path = None if folder is None else folder / str(z) / str(x) / f"{y}.png"
        if path is None or not path.is_file():
            raise NoSuchError("tile", "", f"{z}/{x}/{y}", "a tile of the folder")
        return FileResponse(path, media_type="image/png", headers={"Cache-Control": "private, max-age=86400"})


def tile_levels(folder: Path | None) -> list[int]:
    """Return the zoom levels of a folder of tiles, none where there is no folder."""
    if folder is None or not folder.is_dir():
        return []
    return sorted(int(path.name) for path in folder.iterdir() if path.is_dir() and path.name.isdecimal())


def fleet(board: Board) -> Json:
    """Return what is known of services and vehicles now."""
    with board.database.reading() as db:
        places = {row["vehicle_id"]: row for row in _last_places(db)}
        orders = dict(
            db.execute(
                "SELECT c.vehicle_id, COUNT(*) FROM request r JOIN contact c ON c.id = r.contact_id"
                " WHERE r.state IN ('waiting', 'asked', 'sent') GROUP BY c.vehicle_id"
            ).fetchall()
        )
    vehicles = {str(vehicle["vehicle_id"]): vehicle for vehicle in board.fleet.link()}
    config = board.config
    found: list[Json] = []
    for name in sorted({*vehicles, *places}):
        place = places.get(name)
        lat, lon = (None, None) if place is None else (place["vehicle_lat_deg"], place["vehicle_lon_deg"])
        range_m = None if place is None else _range_m(config, place["vehicle_lat_deg"], place["vehicle_lon_deg"])
        at = place and place["seen_utc_s"]
        found.append(
            {
                **(vehicles.get(name) or _never_heard(name)),
                "range_m": range_m,
                "range_utc_s": None if range_m is None else at,
                "lat_deg": lat,
                "lon_deg": lon,
                "position_utc_s": None if lat is None else at,
                "open_orders": orders.get(name, 0),
            }
        )
    return {"now_utc_s": board.clock(), "services": [*board.fleet.service_list()], "vehicles": [*found]}


def _range_m(config: ConsoleConfig, lat_deg: float, lon_deg: float) -> float | None:
    """Return how far from the vessel a position is, None where the vessel's own is not configured."""
    if config.vessel_lat_deg is None or config.vessel_lon_deg is None:
        return None
    return round(distance_m(config.vessel_lat_deg, config.vessel_lon_deg, lat_deg, lon_deg), 1)


def _never_heard(name: str) -> Json:
    unknown = ("last_heard_utc_s", "age_s", "rate", "snr_in_db", "snr_out_db", "loss", "queue")
    return {
        "vehicle_id": name,
        **dict.fromkeys(unknown),
        "stale": True,
        "frames": 0,
        "bad_frames": 0,
        "frames_per_minute": 0,
    }


def _last_places(db: sqlite3.Connection) -> list[sqlite3.Row]:
    return db.execute(
        "SELECT vehicle_id, vehicle_lat_deg, vehicle_lon_deg,"
        " MAX(COALESCE(seen_utc_s, first_frame_utc_s)) AS seen_utc_s"
        " FROM contact WHERE vehicle_lat_deg IS NOT NULL GROUP BY vehicle_id"
    ).fetchall()


def chart(board: Board) -> Json:
    """Return contacts, tracks and the vessel in metres around an origin."""
    with board.database.reading() as db:
        rows = db.execute(
            "SELECT c.id, c.name, c.vehicle_id, c.lat_deg, c.lon_deg, c.position_sigma_m, c.review, c.atd_confidence,"
            " c.group_id, c.vehicle_lat_deg, c.vehicle_lon_deg,"
            " COALESCE(c.seen_utc_s, c.first_frame_utc_s) AS at_utc_s,"
            " COUNT(*) OVER (PARTITION BY COALESCE(c.group_id, c.id)) AS looks"
            " FROM contact c WHERE c.lat_deg IS NOT NULL AND c.lon_deg IS NOT NULL"
            " ORDER BY at_utc_s DESC LIMIT ?",
            (MOST_ON_MAP,),
        ).fetchall()
        unlocated = db.execute("SELECT COUNT(*) FROM contact WHERE lat_deg IS NULL OR lon_deg IS NULL").fetchone()[0]
    config = board.config
    if config.vessel_lat_deg is not None and config.vessel_lon_deg is not None:
        frame = LocalFrame(config.vessel_lat_deg, config.vessel_lon_deg)
    elif rows:
        # The first contact that came: the origin must not wander while one looks.
        frame = LocalFrame(rows[-1]["lat_deg"], rows[-1]["lon_deg"])
    else:
        return _empty_chart(board, unlocated)
    stale = {str(vehicle["vehicle_id"]): bool(vehicle["stale"]) for vehicle in board.fleet.link()}
    tracks: dict[str, list[list[float]]] = {}
    seen = [row for row in reversed(rows) if row["vehicle_lat_deg"] is not None]
    places = frame.to_local_all([r["vehicle_lat_deg"] for r in seen], [r["vehicle_lon_deg"] for r in seen])
    for row, (x_m, y_m) in zip(seen, places, strict=True):
        tracks.setdefault(row["vehicle_id"], []).append([x_m, y_m, row["at_utc_s"]])
    points = frame.to_local_all([row["lat_deg"] for row in rows], [row["lon_deg"] for row in rows])
    return {
        "origin": {"lat_deg": frame.lat_deg, "lon_deg": frame.lon_deg},
        "contacts": [_on_chart(row, point) for row, point in zip(rows, points, strict=True)],
        "unlocated": unlocated,
        "vehicles": [
            {"vehicle_id": name, "track": track, "stale": stale.get(name, True)}
            for name, track in sorted(tracks.items())
        ],
        "vessel": None if config.vessel_lat_deg is None else {"x_m": 0.0, "y_m": 0.0},
        "ring_m": list(config.ring_m),
    }


def _empty_chart(board: Board, unlocated: int) -> Json:
    return {
        "origin": None,
        "contacts": [],
        "unlocated": unlocated,
        "vehicles": [],
        "vessel": None,
        "ring_m": list(board.config.ring_m),
    }


def _on_chart(row: sqlite3.Row, point: tuple[float, float]) -> Json:
    return {
        "id": row["id"],
        "name": row["name"],
        "x_m": point[0],
        "y_m": point[1],
        "sigma_m": row["position_sigma_m"],
        "review": row["review"],
        "atd_confidence": row["atd_confidence"],
        "group": row["group_id"] if row["looks"] > 1 else None,
        "looks": row["looks"],
    }
