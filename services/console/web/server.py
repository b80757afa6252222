"""The console's web application, the files that a browser installs, and its server: a thread, with deadlines."""

from __future__ import annotations

import asyncio
import functools
import hashlib
import json
import logging
import math
import os
import re
import socket
import ssl
import threading
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Final

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import PathLike, StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from typing_extensions import override

from sonarpost.config import TlsConfig
from sonarpost.errors import ConfigError, PortError
from sonarpost.logs import kv
from sonarpost.network.connections import ConnectionLimits, LimitedListener, TrustedProxies
from sonarpost.services.console.chain import SERVICE_STALE_S
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.users import MAX_PASSWORD, MIN_PASSWORD, Users
from sonarpost.services.console.web.access import (
    AccessControl,
    ApiError,
    Call,
    SecurityMiddleware,
    error_response,
)
from sonarpost.services.console.web.contact_routes import ContactRoutes
from sonarpost.services.console.web.decision_routes import DecisionRoutes
from sonarpost.services.console.web.event_stream import EventStream
from sonarpost.services.console.web.export_routes import ExportRoutes, offered_formats
from sonarpost.services.console.web.map_routes import MapRoutes
from sonarpost.services.console.web.report import ReportRoutes
from sonarpost.services.console.web.session_routes import SessionRoutes

log = logging.getLogger(__name__)

STATIC: Final = Path(__file__).parents[1] / "static"
CONTACT_STALE_S: Final = 600.0
STOP_S: Final = 1.0
BACKLOG: Final = 128


class ConsoleApp:
    """The console's web application; `training` marks all contacts as simulated."""

    def __init__(self, state: ConsoleState, users: Users, platform_id: str, *, training: bool = False) -> None:
        config = state.config
        self._state = state
        self._platform_id = platform_id
        self._training = training
        self._map = MapRoutes(state)
        self._exports = ExportRoutes(state)
        self._stream = EventStream(state)
        access = AccessControl(users, config.role, TrustedProxies(config.trusted_proxies))
        sessions = SessionRoutes(users, config.role, tls=config.tls, max_age_s=config.session_max_s)
        routes = [
            Route("/api/info", access.endpoint(self._info)),
            *sessions.routes(access),
            *ContactRoutes(state).routes(access),
            *DecisionRoutes(state).routes(access),
            *self._map.routes(access),
            Route("/api/score", access.endpoint(lambda call: JSONResponse(state.score_sheet(call.actor)))),
            *self._exports.routes(access),
            *ReportRoutes(state, self._exports, training=training).routes(access),
            *self._stream.routes(access),
            Route("/", access.endpoint(_index, needs_session=False)),
            Route("/login", lambda _: page(STATIC / "login.html")),
            *installation_routes(STATIC),
            Mount("/static", StaticFolder(directory=STATIC)),
        ]
        app = Starlette(routes=routes, exception_handlers={HTTPException: routing_error, Exception: defect_response})
        self.asgi: ASGIApp = SecurityMiddleware(app, (config.host, *config.names), tls=config.tls)

    def stop(self) -> None:
        """End the event streams and the running export, so that the server can stop."""
        self._exports.stop()
        self._stream.stop()

    def _info(self, _call: Call) -> Response:
        config = self._state.config
        return JSONResponse(
            {
                "side": config.role,
                "platform_id": self._platform_id,
                "version": version("sonarpost"),
                "training": self._training,
                "known_objects": self._training or config.calibration_share > 0,
                "now_utc_s": self._state.clock(),
                "last_event": self._state.events.event_id(self._state.events.last),
                "classes": [{"group": name, "classes": found} for name, found in config.class_groups().items()],
                "password_characters": [MIN_PASSWORD, MAX_PASSWORD],
                "stale_after_s": {
                    "service": SERVICE_STALE_S,
                    "vehicle": config.vehicle_stale_s,
                    "contact": CONTACT_STALE_S,
                },
                "tiles": self._map.tiles(),
                "exports": {name: one.label for name, one in offered_formats().items()},
            }
        )


def _index(call: Call) -> Response:
    """Return the page of the console; without a session, the way to the log-in page."""
    if call.session is None:
        return RedirectResponse("/login", 303)
    return HTMLResponse(index_page(STATIC), headers={"Cache-Control": "no-cache"})


class StaticFolder(StaticFiles):
    """Static files that browsers revalidate at each use."""

    @override
    def file_response(
        self, full_path: PathLike, stat_result: os.stat_result, scope: Scope, status_code: int = 200
    ) -> Response:
        response = super().file_response(full_path, stat_result, scope, status_code)
        response.headers["Cache-Control"] = "no-cache"
        return response


def page(path: Path) -> Response:
    """Return the response of a page."""
    return FileResponse(path, headers={"Cache-Control": "no-cache"})


async def routing_error(_request: Request, error: Exception) -> Response:
    """Return the response to a request without a matching route."""
    if isinstance(error, HTTPException) and error.status_code != 404:
        return error_response(ApiError(error.status_code, "bad_request", "this route does not accept the method"))
    return error_response(ApiError(404, "not_found", "no such route"))


async def defect_response(_request: Request, _error: Exception) -> Response:
    """Return the response to a request with an unexpected exception."""
    return error_response(ApiError(500, "defect", "internal error: see the log of the console"))


class _Server(uvicorn.Server):
    """A server that closes all connections when it ends, also those whose client does not read."""

    @override
    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop to accept, wait for running requests, then abort the connections that are left."""
        await super().shutdown(sockets)
        for connection in list(self.server_state.connections):
            if connection.transport is not None:
                connection.transport.abort()
        await asyncio.sleep(0)  # lets the event loop close the aborted connections


class WebServer:
    """Runs an application on one address, in a thread.

    Args:
        app: The application.
        host: Address to listen on.
        port: TCP port; 0 for any free port.
        tls: Certificate for HTTPS; None for HTTP.
        limits: Limits of the connections; None for the default ones, without a proxy.

    Raises:
        PortError: The address cannot be bound.
        ConfigError: The certificate cannot be used.
    """

    def __init__(
        self, app: ASGIApp, host: str, port: int, tls: TlsConfig | None = None, limits: ConnectionLimits | None = None
    ) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self.limits = ConnectionLimits() if limits is None else limits
        self._socket = LimitedListener(family, socket.SOCK_STREAM)
        self._socket.limits = self.limits
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind((host, port))
            # Connections are accepted after `start`; until then they wait in the backlog.
            self._socket.listen(BACKLOG)
            config = uvicorn.Config(
                ConnectionDeadlines(app, self.limits),
                # Other event loops do not use the socket's `accept`.
                loop="asyncio",
                backlog=BACKLOG,
                callback_notify=self._close_overdue,
                timeout_notify=1,
                log_config=None,
                access_log=False,
                ws="none",
                lifespan="off",
                server_header=False,
                proxy_headers=False,
                timeout_graceful_shutdown=1,
                ssl_certfile=None if tls is None else tls.certificate,
                ssl_keyfile=None if tls is None else tls.key,
            )
            config.load()
        except ssl.SSLError as error:
            self._socket.close()
            raise ConfigError("[platform.tls]", "certificate", str(error), "a certificate and its key (PEM)") from error
        except OSError as error:
            self._socket.close()
            raise PortError(f"{host}:{port}: cannot be bound: {error}") from error
        self.host = host
        self.port = int(self._socket.getsockname()[1])
        self._tls = tls is not None
        self._server = _Server(config)
        self._thread = threading.Thread(target=self._run, name="web", daemon=True)

    @property
    def address(self) -> str:
        """URL of the server."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if self._tls else 'http'}://{host}:{self.port}/"

    @property
    def running(self) -> bool:
        """Whether the server runs."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start to serve."""
        self._thread.start()
        log.info("Web server started", extra=kv(address=self.address))

    def stop(self) -> None:
        """Stop the server, within about two seconds."""
        self._server.should_exit = True
        if self._thread.ident is not None:
            self._thread.join(timeout=STOP_S)
            if self._thread.is_alive():
                self._server.force_exit = True
                self._thread.join(timeout=STOP_S)
        self._socket.close()

    async def _close_overdue(self) -> None:
        self.limits.close_overdue()

    def _run(self) -> None:
        self._server.run(sockets=[self._socket])


MANIFEST: Final = "manifest.webmanifest"
WORKER: Final = "service_worker.js"
_IMPORT: Final = re.compile(r'^import [^;]*?from "(\.[^"]+)";', re.MULTILINE)
_START: Final = '  <script type="module" src="/static/js/app.js">'
_NO_CACHE: Final = {"Cache-Control": "no-cache"}


def imported_scripts(script: Path) -> list[Path]:
    """Return the scripts that a script imports, directly or through others, sorted and without itself."""
    found: set[Path] = set()
    waiting = [script.resolve()]
    while waiting:
        one = waiting.pop()
        found.add(one)
        others = {(one.parent / name).resolve() for name in _IMPORT.findall(one.read_text(encoding="utf-8"))}
        waiting += others - found
    return sorted(found - {script.resolve()})


@functools.cache
def index_page(static: Path) -> str:
    """Return the page of the console, with links by which the browser loads all its scripts at once."""
    scripts = imported_scripts(static / "js" / "app.js")
    names = [path.relative_to(static.resolve()).as_posix() for path in scripts]
    links = "".join(f'  <link rel="modulepreload" href="/static/{name}">\n' for name in names)
    return (static / "index.html").read_text(encoding="utf-8").replace(_START, links + _START)


@functools.cache
def service_worker(static: Path) -> str:
    """Return the script of the service worker for a folder of static files.

    It begins with the version, a hash of all files, and the addresses of the files that the browser may store. A
    browser installs it again when a file has changed, and removes the files of the version before.
    """
    digest = hashlib.sha256()
    addresses = []
    for path in sorted(path for path in static.rglob("*") if path.is_file()):
        name = path.relative_to(static).as_posix()
        digest.update(f"{name}\0{path.stat().st_size}\0".encode())
        digest.update(path.read_bytes())
        # Pages other than that without a connection need the server.
        if name not in (WORKER, MANIFEST) and (path.suffix != ".html" or name == "offline.html"):
            addresses.append(f"/static/{name}")
    constants = f"const VERSION = {json.dumps(digest.hexdigest()[:16])};\nconst FILES = {json.dumps(addresses)};\n"
    return constants + (static / WORKER).read_text(encoding="utf-8")


def installation_routes(static: Path) -> list[Route]:
    """Return the routes. They need no session, because they contain no data."""

    async def manifest(_request: Request) -> Response:
        return FileResponse(static / MANIFEST, media_type="application/manifest+json", headers=_NO_CACHE)

    async def worker(_request: Request) -> Response:
        return Response(service_worker(static), media_type="text/javascript", headers=_NO_CACHE)

    return [Route(f"/{MANIFEST}", manifest), Route(f"/{WORKER}", worker)]


CHUNK_BYTES: Final = 65536
"""Size of the parts of a response; a client has a limited time to read each."""


class ConnectionDeadlines:
    """ASGI middleware that sets the deadlines of connections.

    A client has `request_s` to send a request, and `read_s` to read each chunk of the response. While the server
    prepares a response, and between the events of a stream, there is no deadline.

    Args:
        app: The application.
        limits: The open connections.
    """

    def __init__(self, app: ASGIApp, limits: ConnectionLimits) -> None:
        self._app = app
        self._limits = limits

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limits, peer = self._limits, scope["client"]
        if peer not in limits:
            # The connection was closed for another one, and its address is unknown.
            response = PlainTextResponse("too many connections", 503, {"Connection": "close"})
            await response(scope, receive, send)
            return

        async def receive_in_time() -> Message:
            message = await receive()
            if not message.get("more_body", False):
                limits.set_deadline(peer, math.inf)
            return message

        async def send_in_time(message: Message) -> None:
            for part in _parts(message):
                limits.set_deadline(peer, limits.read_s)
                await send(part)
            limits.set_deadline(peer, math.inf)

        if scope["method"] in ("GET", "HEAD"):
            limits.set_deadline(peer, math.inf)
        try:
            await self._app(scope, receive_in_time, send_in_time)
        finally:
            limits.set_deadline(peer, limits.request_s)


def _parts(message: Message) -> Iterable[Message]:
    """Split the body of a response: the server waits for the client only between messages."""
    body = message.get("body", b"")
    if message["type"] != "http.response.body" or len(body) <= CHUNK_BYTES:
        yield message
        return
    for start in range(0, len(body), CHUNK_BYTES):
        yield {**message, "body": bytes(body[start : start + CHUNK_BYTES]), "more_body": True}
    yield {**message, "body": b""}
