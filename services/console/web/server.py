"""All routes together."""

from __future__ import annotations

import logging
import socket
import ssl
import threading
from importlib.metadata import version
from pathlib import Path
from typing import Final

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, RedirectResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from sonarpost.config import TlsConfig
from sonarpost.errors import ConfigError, PortError
from sonarpost.logs import kv
from sonarpost.review.rendering import MAPS
from sonarpost.services.console.state import Board
from sonarpost.services.console.store.requests import KINDS
from sonarpost.services.console.store.users import MAX_PASSWORD, MIN_PASSWORD, Users
from sonarpost.services.console.web.access import Call, Endpoint, Gate, Guard, RefusedError, answer, json_answer
from sonarpost.services.console.web.contact_routes import ContactRoutes
from sonarpost.services.console.web.event_stream import Stream
from sonarpost.services.console.web.export_routes import ExportRoutes
from sonarpost.services.console.web.map_routes import PlaceRoutes
from sonarpost.services.console.web.session_routes import SessionRoutes

STATIC: Final = Path(__file__).parents[1] / "static"
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


log = logging.getLogger(__name__)

STOP_S = 1.0
MOST_CONNECTIONS = 200


class WebServer:
    """Serves an application on one address.

    Args:
        app: What is served.
        host: Address to listen on.
        port: TCP port; 0 for any that is free.
        tls: Certificate, for TLS; plain HTTP without.

    Raises:
        PortError: The address cannot be listened on.
        ConfigError: The certificate cannot be used.
    """

    def __init__(self, app: ASGIApp, host: str, port: int, tls: TlsConfig | None = None) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_STREAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind((host, port))
            # From here on browsers wait instead of being turned away; they are served when the thread runs.
            self._socket.listen(MOST_CONNECTIONS)
            config = uvicorn.Config(
                app,
                log_config=None,
                access_log=False,
                ws="none",
                lifespan="off",
                server_header=False,
                proxy_headers=False,
                timeout_graceful_shutdown=1,
                limit_concurrency=MOST_CONNECTIONS,
                ssl_certfile=None if tls is None else tls.certificate,
                ssl_keyfile=None if tls is None else tls.key,
            )
            config.load()
        except ssl.SSLError as error:
            self._socket.close()
            raise ConfigError("[platform.tls]", "certificate", str(error), "a certificate and its key (PEM)") from error
        except OSError as error:
            self._socket.close()
            raise PortError(f"{host}:{port}: cannot be listened on: {error}") from error
        self.host = host
        self.port = int(self._socket.getsockname()[1])
        self._tls = tls is not None
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._run, name="web", daemon=True)

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if self._tls else 'http'}://{host}:{self.port}/"

    @property
    def running(self) -> bool:
        """Whether it serves."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()
        log.info("Page served", extra=kv(address=self.address))

    def stop(self) -> None:
        """Stop serving, within a second or so."""
        self._server.should_exit = True
        if self._thread.ident is not None:
            self._thread.join(timeout=STOP_S)
            if self._thread.is_alive():
                self._server.force_exit = True
                self._thread.join(timeout=STOP_S)
        self._socket.close()

    def _run(self) -> None:
        self._server.run(sockets=[self._socket])
