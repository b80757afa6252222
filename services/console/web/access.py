"""The frame of every request: who asks, whether they may, what goes wrong in which words."""

from __future__ import annotations

import json
import logging
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Final, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from sonarpost.errors import BadInputError, DeliveryError
from sonarpost.logs import kv
from sonarpost.review.measuring import NotMeasurableError
from sonarpost.services.console.state import NoSuchError
from sonarpost.services.console.store.decisions import ConflictError
from sonarpost.services.console.store.serialisers import Json
from sonarpost.services.console.store.users import Act, Actor, Session, Side, Users, same
from sonarpost.wire import expected_text

log = logging.getLogger(__name__)

COOKIE: Final = "sonarpost_session"
MAX_BODY_BYTES: Final = 65536
SECURITY_HEADERS: Final[Mapping[str, str]] = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; font-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}
_LOCAL: Final = ("127.0.0.1", "localhost", "[::1]")


class RefusedError(Exception):
    """A request is refused.

    Args:
        status: Of HTTP.
        code: As in the interface's description.
        message: For people.
        field: What of the request is wrong.
        headers: Of the answer.
    """

    def __init__(
        self, status: int, code: str, message: str, field: str | None = None, headers: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(message)
        self.status = status
        self.code = code
        self.field = field
        self.headers = dict(headers or {})


class Body(BaseModel):
    """Base of every body: strictly typed, nothing unknown."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


B = TypeVar("B", bound=Body)


@dataclass(frozen=True, slots=True)
class Call:
    """One request, let in.

    Attributes:
        request: As Starlette has it.
        body: Its bytes, empty unless it is a POST.
        session: Whose it is; None for what needs none.
        address: Where it comes from.
    """

    request: Request
    body: bytes
    session: Session | None
    address: str

    @property
    def actor(self) -> Actor:
        """Who asks; for what needs a session."""
        assert self.session is not None
        return Actor(self.session.name, self.session.role, self.address)

    def parsed(self, model: type[B]) -> B:
        """Return the body.

        Raises:
            RefusedError: It is no JSON, or not what is expected; names the field.
        """
        try:
            return model.model_validate_json(self.body)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            field = ".".join(str(part) for part in first["loc"]) or None
            raise RefusedError(400, "bad_request", expected_text(first["type"], first["msg"]), field) from error


Handler = Callable[[Call], Response]
Endpoint = Callable[[Request], Awaitable[Response]]


class Gate:
    """Lets requests in.

    Args:
        users: Who may log in; None where nobody does.
        side: Which side of the water this is.
        behind_proxy: Whether `X-Forwarded-For` says where a request comes from.
    """

    def __init__(self, users: Users | None, side: Side, *, behind_proxy: bool) -> None:
        self._users = users
        self._side = side
        self._behind_proxy = behind_proxy

    def session_of(self, request: Request, *, use: bool = True) -> Session | None:
        """Return the session that a request belongs to, None where it has none; see `Users.session`."""
        token = request.cookies.get(COOKIE, "")
        if self._users is None:
            return None
        return self._users.session(token, use=use) if 0 < len(token) < 200 else None

    def address_of(self, request: Request) -> str:
        """Return where a request comes from."""
        forwarded = request.headers.get("x-forwarded-for", "") if self._behind_proxy else ""
        # The last one is what the proxy itself has seen; those before it anybody may have written.
        nearest = forwarded.rpartition(",")[2].strip()
        return (nearest or (request.client.host if request.client else "?"))[:100]

    def open(self, handler: Handler, *, act: Act | None = None, needs_session: bool = True) -> Endpoint:
        """Return an endpoint that checks session, token and role, and calls the handler in a thread.

        Args:
            handler: Does the work; may block.
            act: What the user must be allowed to do.
            needs_session: Whether one must be logged in.
        """

        async def endpoint(request: Request) -> Response:
            try:
                body = await _body_of(request) if request.method == "POST" else b""
                return await run_in_threadpool(self._call, request, body, handler, act, needs_session)
            except RefusedError as refused:
                return answer(refused)

        return endpoint

    def _call(self, request: Request, body: bytes, handler: Handler, act: Act | None, needs_session: bool) -> Response:  # noqa: FBT001
        try:
            session = self.session_of(request)
            if needs_session:
                self._check(request, session, act)
            return handler(Call(request, body, session, self.address_of(request)))
        except RefusedError:
            raise
        except ConflictError as error:
            body_: Json = {"contact": error.contact, "decision": error.decision}
            return JSONResponse({**_error("conflict", str(error), None), **body_}, 409)
        except NotMeasurableError as error:
            extra: Json = {"measurable": False, "reason": str(error)}
            return JSONResponse({**_error("not_measurable", str(error), error.field), **extra}, 409)
        except NoSuchError as error:
            raise RefusedError(404, "not_found", str(error), error.field) from error
        except BadInputError as error:
            raise RefusedError(400, "bad_request", str(error), error.field) from error
        except (DeliveryError, OSError) as error:
            log.error("Request not served", extra=kv(path=request.url.path, reason=str(error)))
            raise RefusedError(503, "not_now", "the console cannot write or read its disk at the moment") from error
        except Exception as error:
            log.exception("Defect while serving a request", extra=kv(path=request.url.path))
            raise RefusedError(500, "defect", "something is wrong in the console: its log says what") from error

    def _check(self, request: Request, session: Session | None, act: Act | None) -> None:
        if session is None:
            raise RefusedError(401, "no_session", "log in first")
        if request.method == "POST" and not same(request.headers.get("x-csrf-token", ""), session.csrf):
            raise RefusedError(403, "csrf", "the token of this page is not that of the session: load it again")
        if act is not None and not Actor(session.name, session.role, "").may(act, self._side):
            raise RefusedError(403, "forbidden", f"the role {session.role} may not {act} on this {self._side}")


async def _body_of(request: Request) -> bytes:
    found = bytearray()
    async for chunk in request.stream():
        found += chunk
        if len(found) > MAX_BODY_BYTES:
            raise RefusedError(413, "too_large", f"more than {MAX_BODY_BYTES} bytes", headers={"Connection": "close"})
    return bytes(found)


def _error(code: str, message: str, field: str | None) -> Json:
    return {"error": {"code": code, "message": message, "field": field}}


def answer(refused: RefusedError) -> Response:
    """Return the answer to a refused request."""
    return JSONResponse(_error(refused.code, str(refused), refused.field), refused.status, refused.headers)


class Guard:
    """Around everything: which host names are ours, where a page may come from, headers of every answer.

    A page of another site that makes a browser ask us by a name of its own (DNS rebinding) is stopped here.

    Args:
        app: What is guarded.
        names: Host names that are ours, besides the host's own.
        tls: Whether browsers must come back by TLS.
    """

    def __init__(self, app: ASGIApp, names: tuple[str, ...], *, tls: bool) -> None:
        self._app = app
        self._names = frozenset(name.lower() for name in (*names, *_LOCAL))
        self._headers = [(name.lower().encode(), value.encode()) for name, value in SECURITY_HEADERS.items()]
        if tls:
            self._headers.append((b"strict-transport-security", b"max-age=31536000"))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                there = {name for name, _ in message["headers"]}
                message["headers"] = [*message["headers"], *(h for h in self._headers if h[0] not in there)]
                if b"cache-control" not in there:
                    message["headers"].append((b"cache-control", b"no-store"))
            await send(message)

        refused = self._refused(Request(scope))
        await (self._app if refused is None else answer(refused))(scope, receive, send_with_headers)

    def _refused(self, request: Request) -> RefusedError | None:
        host = request.headers.get("host", "").lower()
        if _without_port(host) not in self._names:
            return RefusedError(400, "bad_host", "this name is not one of the console's: see `names` in [console]")
        origin = request.headers.get("origin")
        if request.method != "GET" and origin is not None and origin.lower().partition("://")[2] != host:
            return RefusedError(403, "bad_origin", "this page is not the console's")
        return None


def _without_port(host: str) -> str:
    if host.startswith("["):
        return host.partition("]")[0] + "]"
    return host.partition(":")[0]


def json_answer(body: Json | list[Json], status: int = 200) -> Response:
    """Return JSON."""
    # Not Starlette's own: a number that is none must never reach a page as one.
    text = json.dumps(body, allow_nan=False, separators=(",", ":"))
    return Response(text, status, media_type="application/json")
