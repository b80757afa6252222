"""All routes together."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Final

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, RedirectResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from sonarpost.review.rendering import MAPS
from sonarpost.services.console.asking import KINDS
from sonarpost.services.console.board import Board
from sonarpost.services.console.contact_routes import ContactRoutes
from sonarpost.services.console.exporting import ExportRoutes
from sonarpost.services.console.place_routes import PlaceRoutes
from sonarpost.services.console.session_routes import SessionRoutes
from sonarpost.services.console.stream import Stream
from sonarpost.services.console.users import MAX_PASSWORD, MIN_PASSWORD, Users
from sonarpost.services.console.web import Call, Endpoint, Gate, Guard, RefusedError, answer, json_answer

STATIC: Final = Path(__file__).parent / "static"
_MEDIA: Final = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".mjs": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".woff2": "font/woff2",
    ".json": "application/json",
}
SERVICE_STALE_S: Final = 15.0
CONTACT_STALE_S: Final = 600.0


class ConsoleApp:
    """The console as a web application.

    Args:
        board: The console's state.
        users: Who may log in.
        platform_id: Where this is.
        training: Whether contacts are simulated.
        static: Folder of the page.
    """

    def __init__(
        self, board: Board, users: Users, platform_id: str, *, training: bool = False, static: Path = STATIC
    ) -> None:
        config = board.config
        self._static = static
        self._board = board
        self._platform_id = platform_id
        self._training = training
        self._gate = Gate(users, config.role, behind_proxy=config.behind_proxy)
        self._places = PlaceRoutes(board)
        self._stream = Stream(board, training=training)
        sessions = SessionRoutes(users, config.role, tls=config.tls, most_s=config.session_max_s)
        routes = [
            Route("/api/info", self._gate.open(self._info)),
            *sessions.routes(self._gate),
            *ContactRoutes(board).routes(self._gate),
            *self._places.routes(self._gate),
            *ExportRoutes(board).routes(self._gate),
            *self._stream.routes(self._gate),
            Route("/", self._page("index.html")),
            Route("/password", self._page("password.html")),
            Route("/login", lambda _: page_file(static, "login.html")),
            *static_routes(static),
        ]
        app = Starlette(routes=routes, exception_handlers={HTTPException: not_routed})
        self.asgi: ASGIApp = Guard(app, (config.host, *config.names), tls=config.tls)

    def end(self) -> None:
        """End the streams of events, so that the server can end."""
        self._stream.end()

    def _page(self, name: str) -> Endpoint:
        """Return the endpoint of a page for those who are logged in; others are sent to the log-in."""

        def serve(call: Call) -> Response:
            return RedirectResponse("/login", 303) if call.session is None else page_file(self._static, name)

        return self._gate.open(serve, needs_session=False)

    def _info(self, _call: Call) -> Response:
        config = self._board.config
        return json_answer(
            {
                "side": config.role,
                "platform_id": self._platform_id,
                "version": version("sonarpost"),
                "training": self._training,
                "now_utc_s": self._board.clock(),
                "classes": list(config.classes),
                "maps": list(MAPS),
                "requests": list(KINDS),
                "password_characters": [MIN_PASSWORD, MAX_PASSWORD],
                "stale_after_s": {
                    "service": SERVICE_STALE_S,
                    "vehicle": config.vehicle_stale_s,
                    "contact": CONTACT_STALE_S,
                },
                "tiles": self._places.tiles(),
            }
        )


def static_files(folder: Path) -> dict[str, Path]:
    """Return the files of a page by their addresses below `/static/`; nothing else is ever served from there."""
    if not folder.is_dir():
        return {}
    paths = (path for path in folder.rglob("*") if path.is_file() and path.suffix in _MEDIA)
    return {path.relative_to(folder).as_posix(): path for path in paths}


def static_routes(folder: Path) -> list[Route]:
    """Return the route of a page's own files."""

    def serve(request: Request) -> Response:
        return page_file(folder, str(request.path_params["path"]))

    return [Route("/static/{path:path}", serve)]


def page_file(folder: Path, name: str) -> Response:
    """Return one of a page's files; 404 for every other name."""
    path = static_files(folder).get(name)
    if path is None:
        return answer(RefusedError(404, "not_found", "no such file"))
    return FileResponse(path, media_type=_MEDIA[path.suffix], headers={"Cache-Control": "no-cache"})


async def not_routed(_request: Request, error: Exception) -> Response:
    """Answer a request that no route takes, in the words of all errors."""
    status = error.status_code if isinstance(error, HTTPException) else 500
    code = "not_found" if status == 404 else "bad_request"
    return answer(RefusedError(status, code, "no such route" if status == 404 else "this route takes no such request"))
