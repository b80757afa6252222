"""Access control of the HTTP interface: sessions, CSRF tokens, roles, host names, headers, errors, shares of users."""

from __future__ import annotations

import asyncio
import hmac
import logging
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final, Literal, ParamSpec, TypeVar
from weakref import WeakValueDictionary

from anyio import CapacityLimiter, to_thread
from pydantic import BaseModel, ConfigDict, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.convertors import IntegerConvertor, register_url_convertor
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from sonarpost.errors import BadInputError, DeliveryError
from sonarpost.limits import limit
from sonarpost.logs import IntervalLog
from sonarpost.network.connections import TrustedProxies
from sonarpost.review.measurement import NotMeasurableError
from sonarpost.services.console.store.database import Actor, ConsoleSide, NotFoundError, Permission
from sonarpost.services.console.store.decisions import ConflictError
from sonarpost.services.console.store.users import Session, Users
from sonarpost.wire import first_error

log = logging.getLogger(__name__)

COOKIE: Final = "sonarpost_session"
"""Begin of the name of a session's cookie; see `cookie_name`."""
MAX_BODY_BYTES: Final = limit(65536, "bytes", "claims", "HTTP interface of the console", "client", "body", "413")
SECURITY_HEADERS: Final[Mapping[str, str]] = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; font-src 'self'; "
    "manifest-src 'self'; worker-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}
_LOCAL_NAMES: Final = ("127.0.0.1", "localhost", "[::1]")
RETRY_S: Final = 2
_failed_log: Final = IntervalLog(log, logging.ERROR, "Request failed")


ErrorCode = Literal[
    "bad_host",
    "bad_origin",
    "bad_request",
    "busy",
    "cancelled",
    "conflict",
    "csrf",
    "defect",
    "forbidden",
    "link_expired",
    "link_unknown",
    "link_used",
    "no_session",
    "not_found",
    "not_measurable",
    "not_now",
    "too_large",
    "too_many",
    "wrong_login",
]
"""Codes of error responses. The page has a text for each in its languages, `error.CODE` or `error.CODE.FIELD`."""


class ApiError(Exception):
    """An error response of the HTTP interface; docs/specifications/console-api.md lists the codes."""

    def __init__(
        self,
        status: int,
        code: ErrorCode,
        message: str,
        field: str | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(message)
        self.status = status
        self.code = code
        self.field = field
        self.headers = dict(headers or {})


class RequestBody(BaseModel):
    """Base class of request bodies: strict types, no unknown fields."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


_SURFACE: Final = "HTTP interface of the console"
MAX_THREADS: Final = limit(16, "requests", "shares", _SURFACE, "all users", "handled in total", "others wait")
MAX_THREADS_OF_USER: Final = limit(2, "requests", "shares", _SURFACE, "user", "handled at a time", "others wait")
MAX_WAITING_OF_USER: Final = limit(64, "requests", "shares", _SURFACE, "user", "waiting", "429 with Retry-After")

A = TypeVar("A")
R = TypeVar("R")
P = ParamSpec("P")
B = TypeVar("B", bound=RequestBody)
M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class Call:
    """One permitted request, with the network address of the browser. `session` is None without a log-in."""

    request: Request
    body: bytes
    session: Session | None
    address: str

    @property
    def actor(self) -> Actor:
        """The user; only for requests that need a session."""
        assert self.session is not None
        return Actor(self.session.name, self.session.role, self.address)

    def cookie_name(self, name: str) -> str:
        """Return the name of a cookie of this console."""
        return cookie_name(name, self.request.headers.get("host", ""))

    def parse_body(self, model: type[B]) -> B:
        """Return the validated body; raise ApiError with the name of an invalid field."""
        with _bad_request():
            return model.model_validate_json(self.body)

    def parse_query(self, model: type[M]) -> M:
        """Return the validated query string; raise ApiError with the name of an invalid parameter."""
        with _bad_request():
            return model.model_validate(dict(self.request.query_params))


@contextmanager
def _bad_request() -> Iterator[None]:
    """Convert an error of pydantic to an error response."""
    try:
        yield
    except ValidationError as error:
        field, _, expected = first_error(error)
        raise ApiError(400, "bad_request", expected, field or None) from error


Handler = Callable[[Call], Response]
Endpoint = Callable[[Request], Awaitable[Response]]


class AccessControl:
    """Checks session, CSRF token and role of requests.

    Args:
        users: Users and sessions; None for a server without log-in.
        side: Whether the console is on a vessel or at a shore site.
        proxies: Proxies whose `X-Forwarded-For` is used.
    """

    def __init__(self, users: Users | None, side: ConsoleSide, proxies: TrustedProxies | None = None) -> None:
        self._users = users
        self._side = side
        self._proxies = TrustedProxies() if proxies is None else proxies
        self._shares = ThreadShares()

    def session_of(self, request: Request, *, is_use: bool = True) -> Session | None:
        """Return the session of a request; None if it has none. See `Users.find_session`."""
        token = request.cookies.get(cookie_name(COOKIE, request.headers.get("host", "")), "")
        if self._users is None or not 0 < len(token) < 200:
            return None
        return self._users.find_session(token, is_use=is_use)

    def address_of(self, request: Request) -> str:
        """Return the network address of the browser."""
        host = request.client.host if request.client else "?"
        return self._proxies.client_address(host, request.headers.get("x-forwarded-for", ""))

    def endpoint(
        self, handler: Handler, *, permission: Permission | None = None, needs_session: bool = True
    ) -> Endpoint:
        """Return an endpoint that checks a request, and calls the handler in a thread of the user's share.

        Args:
            handler: Handler of the request; it may block.
            permission: Permission that the user needs; None for every user.
            needs_session: Whether the user must be logged in.
        """

        async def serve(request: Request) -> Response:
            try:
                body = await _read_body(request) if request.method == "POST" else b""
                session = await asyncio.to_thread(_with_error_responses, self.session_of, request)
                if needs_session:
                    self._check(request, session, permission)
                call = Call(request, body, session, self.address_of(request))
                if session is None:  # `LoginLimiter` limits the log-ins
                    return await run_in_threadpool(_with_error_responses, handler, call)
                return await self._shares.run(session.name, _with_error_responses, handler, call)
            except ApiError as error:
                return error_response(error)

        return serve

    def post(
        self, path: str, handler: Handler, permission: Permission | None = None, *, needs_session: bool = True
    ) -> Route:
        """Return a route of POST requests; see `endpoint`."""
        endpoint = self.endpoint(handler, permission=permission, needs_session=needs_session)
        return Route(path, endpoint, methods=["POST"])

    def _check(self, request: Request, session: Session | None, permission: Permission | None) -> None:
        if session is None:
            raise ApiError(401, "no_session", "log in first")
        given = request.headers.get("x-csrf-token", "").encode("utf-8", "surrogatepass")
        if request.method == "POST" and not hmac.compare_digest(given, session.csrf.encode()):
            raise ApiError(403, "csrf", "the page has an invalid session token: reload it")
        if permission is not None and not Actor(session.name, session.role, "").may(permission, self._side):
            site = "vessel" if self._side == "vessel" else "shore site"
            raise ApiError(403, "forbidden", f"the role {session.role} may not {permission} on this {site}")


def _with_error_responses(function: Callable[[A], R], argument: A) -> R:
    """Call a function, and convert its exceptions to error responses."""
    try:
        return function(argument)
    except ConflictError as error:
        raise ApiError(409, "conflict", str(error)) from error
    except NotMeasurableError as error:
        raise ApiError(409, "not_measurable", str(error), error.field) from error
    except NotFoundError as error:
        raise ApiError(404, "not_found", str(error), error.field) from error
    except BadInputError as error:
        raise ApiError(400, "bad_request", str(error), error.field) from error
    except (DeliveryError, OSError) as error:
        _failed_log.log(reason=str(error))
        raise ApiError(503, "not_now", "the console cannot read or write its disk at present") from error


def cookie_name(name: str, host: str) -> str:
    """Return the name of a cookie of the console at `host`, the value of the header Host: with its port.

    Browsers send a cookie to all ports of a host, so that two consoles on one host need two names.
    """
    port = host.removeprefix(_without_port(host)).removeprefix(":")
    return f"{name}_{port}" if port.isdecimal() else name


async def _read_body(request: Request) -> bytes:
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > MAX_BODY_BYTES:
            raise ApiError(413, "too_large", f"more than {MAX_BODY_BYTES} bytes", headers={"Connection": "close"})
    return bytes(body)


def error_response(error: ApiError) -> Response:
    """Return the response of an error."""
    body = {"error": {"code": error.code, "message": str(error), "field": error.field}}
    return JSONResponse(body, error.status, error.headers)


class SecurityMiddleware:
    """Checks host name and origin of requests, and adds security headers to responses.

    The check of the host name prevents DNS rebinding.

    Args:
        app: The application.
        names: Permitted host names, in addition to those of the local host.
        tls: Whether browsers must use TLS (HSTS).
    """

    def __init__(self, app: ASGIApp, names: tuple[str, ...], *, tls: bool) -> None:
        self._app = app
        self._names = frozenset(name.lower() for name in (*names, *_LOCAL_NAMES))
        self._headers = [(name.lower().encode(), value.encode()) for name, value in SECURITY_HEADERS.items()]
        if tls:
            self._headers.append((b"strict-transport-security", b"max-age=31536000"))
        self._defects = IntervalLog(log, logging.ERROR, "Unhandled exception in a request")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                present = {name for name, _ in message["headers"]}
                message["headers"] = [*message["headers"], *(h for h in self._headers if h[0] not in present)]
                if b"cache-control" not in present:
                    message["headers"].append((b"cache-control", b"no-store"))
            await send(message)

        error = self._check(Request(scope))
        try:
            await (self._app if error is None else error_response(error))(scope, receive, send_with_headers)
        except ClientDisconnect:
            pass
        except Exception as defect:  # noqa: BLE001  has its response; the server would log each traceback
            self._defects.log(defect, path=scope["path"][:100])

    def _check(self, request: Request) -> ApiError | None:
        host = request.headers.get("host", "").lower()
        if _without_port(host) not in self._names:
            return ApiError(400, "bad_host", "unknown host name: see `names` in [console]")
        origin = request.headers.get("origin")
        if request.method != "GET" and origin is not None and origin.lower().partition("://")[2] != host:
            return ApiError(403, "bad_origin", "the request comes from a page of another site")
        return None


class NumberConvertor(IntegerConvertor):
    """A number in a path, `{name:number}`. Longer ones than any number of the console match no route."""

    regex = "[0-9]{1,9}"


register_url_convertor("number", NumberConvertor())


def _without_port(host: str) -> str:
    if host.startswith("["):
        return host.partition("]")[0] + "]"
    return host.partition(":")[0]


class ThreadShares:
    """Runs functions in threads, with a share for each user. Used in the event loop."""

    def __init__(self) -> None:
        self._threads = CapacityLimiter(MAX_THREADS)
        self._shares: WeakValueDictionary[str, CapacityLimiter] = WeakValueDictionary()

    async def run(self, user: str, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Run a function in a thread; return its result.

        Raises:
            ApiError: The limit of waiting requests is reached.
        """
        # Requests hold the share of their user; without any it is deleted.
        share = self._shares.setdefault(user, CapacityLimiter(MAX_THREADS_OF_USER))
        if share.statistics().tasks_waiting >= MAX_WAITING_OF_USER:
            message = f"too many requests at a time: try again in {RETRY_S} s"
            raise ApiError(429, "too_many", message, headers={"Retry-After": str(RETRY_S)})
        async with share:
            return await to_thread.run_sync(lambda: function(*args, **kwargs), limiter=self._threads)
