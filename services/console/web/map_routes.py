"""Routes of the map, its tiles, and the fleet."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.database import NotFoundError
from sonarpost.services.console.store.serialisers import LISTED, Json
from sonarpost.services.console.store.tracks import all_tracks, newest_status, surveyed_area, tracks_json
from sonarpost.services.console.web.access import AccessControl, Call

_COLUMNS: Final = {
    "id": "c.id",
    "name": "c.name",
    "lat_deg": "ROUND(c.lat_deg, 7)",
    "lon_deg": "ROUND(c.lon_deg, 7)",
    "sigma_m": "ROUND(c.position_sigma_m, 2)",
    "review": "c.review",
    "atd_class": "c.atd_class",
    "heading_deg": "c.heading_deg",
}
"""Values of a contact on the map, with their SQL."""


class MapRoutes:
    """Routes of the map, its tiles, and the fleet."""

    def __init__(self, state: ConsoleState) -> None:
        self._state = state
        self._tiles_dir = state.config.tiles_dir
        self._zoom_levels = _zoom_levels(self._tiles_dir)
        self._surveyed: tuple[int, Json | None] = (0, None)

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        return [
            Route("/api/fleet", access.endpoint(lambda _: JSONResponse(self._state.fleet_state()))),
            Route("/api/map", access.endpoint(lambda _: JSONResponse(self._map()))),
            Route("/api/map/tracks", access.endpoint(lambda _: JSONResponse(self._tracks()))),
            Route("/tiles/{z:number}/{x:number}/{y:number}.png", access.endpoint(self._tile)),
        ]

    def tiles(self) -> Json | None:
        """Return URL and zoom levels of the map tiles; None if there are none."""
        if not self._zoom_levels:
            return None
        levels = {"min_zoom": min(self._zoom_levels), "max_zoom": max(self._zoom_levels)}
        return {"url": "/tiles/{z}/{x}/{y}.png", **levels}

    def _map(self) -> Json:
        """Return all contacts with a position, and the vessel; WGS 84 positions in degrees.

        A contact is a list of the values that `columns` names: a mission has many thousands of them.
        """
        with self._state.database.read() as db:
            rows = db.execute(
                f"SELECT {', '.join(_COLUMNS.values())} FROM contact c"  # noqa: S608  constants only
                f" WHERE {LISTED} AND c.lat_deg IS NOT NULL AND c.lon_deg IS NOT NULL ORDER BY c.id"
            ).fetchall()
            total = db.execute(f"SELECT COUNT(*) FROM contact c WHERE {LISTED}").fetchone()[0]  # noqa: S608
        config = self._state.config
        return {
            "columns": list(_COLUMNS),
            "contacts": [tuple(row) for row in rows],
            "unlocated": total - len(rows),
            "vessel": None
            if config.vessel_lat_deg is None
            else {"lat_deg": config.vessel_lat_deg, "lon_deg": config.vessel_lon_deg},
            "ring_m": list(config.ring_m),
        }

    def _tracks(self) -> Json:
        """Return the tracks of the vehicles, and the area that they have surveyed together."""
        with self._state.database.read() as db:
            newest, drawn = newest_status(db), tracks_json(db)
            known, surveyed = self._surveyed
            if known != newest:
                surveyed = surveyed_area(all_tracks(db))
                self._surveyed = (newest, surveyed)
        return {"tracks": drawn, "surveyed": surveyed}

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
