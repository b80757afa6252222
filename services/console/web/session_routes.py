"""Routes of sessions and users: log-in, log-out, password, settings. Limits of password checks.

The limits are token buckets that are charged before a password is checked.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Final

from pydantic import Field
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from sonarpost.limits import limit
from sonarpost.logs import kv
from sonarpost.network.connections import address_group
from sonarpost.services.console.store.database import PERMISSIONS, Actor, ConsoleSide
from sonarpost.services.console.store.serialisers import Json
from sonarpost.services.console.store.users import DEVICE_S, LINK_S, MAX_PASSWORD, MIN_PASSWORD, Session, Users
from sonarpost.services.console.web.access import COOKIE, AccessControl, ApiError, Call, ErrorCode, RequestBody


@dataclass(frozen=True, slots=True)
class Rate:
    """A number of attempts at once, and the time in which one more is permitted."""

    burst: int
    interval_s: float


RATE_OF_SOURCE: Final = Rate(
    limit(
        5, "attempts", "shares", "log-in", "browser, address", "wrong passwords of a user", "429; one more after 60 s"
    ),
    60.0,
)
"""Wrong passwords of one user from one source: a known browser, a network address, or a session."""
RATE_OF_ADDRESS: Final = Rate(
    limit(20, "attempts", "shares", "log-in", "address", "wrong passwords of all users", "429; one more after 15 s"),
    15.0,
)
"""Wrong passwords from unknown browsers at one network address."""
RATE_OF_USER: Final = Rate(100, 10.0)
"""Wrong passwords of one user from all unknown browsers."""
MAX_CHECKS: Final = limit(
    8, "checks", "shares", "log-in", "all unknown browsers", "checks that run or wait", "503, Retry-After"
)
"""Password checks at a time, running and waiting, of unknown browsers; as many again of known ones."""
BUSY_RETRY_S: Final = 5
ROUNDING_S: Final = 1e-3
MAX_NAME: Final = 41
"""Longer than the longest name of a user."""


Buckets = Mapping[tuple[str, ...], Rate]
"""Rates of token buckets by their names."""


class LoginLimiter:
    """Limits wrong passwords without locking users out.

    An attempt is charged to several buckets before its password is checked, and refunded if the password is correct.
    Parallel attempts therefore do not pass the limits. A browser that has logged in before has its own bucket: wrong
    passwords from other browsers and addresses do not delay it.

    Args:
        clock: Monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._full_at_s: dict[tuple[str, ...], float] = {}
        """Time at which a bucket is full again, by name; full buckets are deleted."""
        self._checks = {known: threading.BoundedSemaphore(MAX_CHECKS) for known in (True, False)}

    def buckets_of_login(self, user: str, address: str, device: str | None) -> Buckets:
        """Return the buckets of a log-in.

        Args:
            user: Name of the user, who need not exist.
            address: Network address, or group of addresses.
            device: Token of a browser that is known for this user; None for any other.
        """
        user = user[:MAX_NAME]
        if device is not None:
            return {("device", user, device): RATE_OF_SOURCE}
        return {
            ("user at address", user, address): RATE_OF_SOURCE,
            ("address", address): RATE_OF_ADDRESS,
            ("user", user): RATE_OF_USER,
        }

    @contextmanager
    def attempt(self, buckets: Buckets, *, known: bool) -> Iterator[Callable[[], None]]:
        """Charge an attempt and limit the number of checks. Yields a function that refunds the attempt.

        Raises:
            ApiError: 429 if a bucket is empty; 503 if too many checks are waiting.
        """
        wait_s = self._charge(buckets)
        if wait_s > 0:
            seconds = int(wait_s) + 1
            message = f"too many failed attempts: try again in {seconds} s"
            raise ApiError(429, "too_many", message, headers={"Retry-After": str(seconds)})
        if not self._checks[known].acquire(blocking=False):
            self._refund(buckets)
            headers = {"Retry-After": str(BUSY_RETRY_S)}
            message = f"too many log-ins at this moment: try again in {BUSY_RETRY_S} s"
            raise ApiError(503, "busy", message, headers=headers)
        try:
            yield lambda: self._refund(buckets)
        finally:
            self._checks[known].release()

    def _charge(self, buckets: Buckets) -> float:
        """Charge all buckets and return 0; if one is empty, charge none and return the time to wait."""
        with self._lock:
            now_s = self._clock()
            # Full buckets are deleted, so that invented names do not fill the memory.
            self._full_at_s = {name: at_s for name, at_s in self._full_at_s.items() if at_s > now_s}
            charged = {
                name: max(now_s, self._full_at_s.get(name, now_s)) + rate.interval_s for name, rate in buckets.items()
            }
            wait_s = max(charged[name] - now_s - rate.burst * rate.interval_s for name, rate in buckets.items())
            if wait_s > ROUNDING_S:
                return wait_s
            self._full_at_s |= charged
            return 0.0

    def _refund(self, buckets: Buckets) -> None:
        with self._lock:
            for name, rate in buckets.items():
                if name in self._full_at_s:
                    self._full_at_s[name] -= rate.interval_s


log = logging.getLogger(__name__)

LOGIN: Final = "/api/login"
_LINK_PROBLEMS: Final[Mapping[str, tuple[ErrorCode, str]]] = {
    "unknown": ("link_unknown", "this log-in link is not valid"),
    "used": ("link_used", "this log-in link was used before; it is valid once"),
    "expired": ("link_expired", f"this log-in link has expired; it is valid for {LINK_S / 60:.0f} minutes"),
}
DEVICE_COOKIE: Final = "sonarpost_device"
"""Identifies a browser in which a user has logged in before; it grants nothing but an own limit of wrong passwords."""


class _LoginBody(RequestBody):
    user: str
    password: str


class _LinkBody(RequestBody):
    token: str = Field(min_length=1, max_length=100)


class _PasswordBody(RequestBody):
    old: str
    new: str


SETTINGS: Final = ("keys", "language", "map", "review", "sort", "theme", "type")
"""Names of the settings that are stored. The page keeps all others in the browser alone."""
MAX_VALUE: Final = 100
"""Characters of a value."""


class _SettingsBody(RequestBody):
    settings: Annotated[dict[str, Annotated[str, Field(max_length=MAX_VALUE)]], Field(max_length=len(SETTINGS))]


class SessionRoutes:
    """Routes of sessions and settings. Every user reads and writes the own settings.

    Args:
        tls: Whether the cookie is restricted to TLS.
        max_age_s: Lifetime of the cookie.
    """

    def __init__(self, users: Users, side: ConsoleSide, *, tls: bool, max_age_s: float) -> None:
        self._users = users
        self._side = side
        self._tls = tls
        self._max_age_s = max_age_s
        self._limiter = LoginLimiter()

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        return [
            access.post(LOGIN, self._login, needs_session=False),
            access.post("/api/login-link", self._login_link, needs_session=False),
            Route("/api/session", access.endpoint(self._session)),
            access.post("/api/logout", self._logout),
            access.post("/api/password", self._password),
            Route("/api/settings", access.endpoint(self._read_settings)),
            access.post("/api/settings", self._write_settings),
        ]

    def _login(self, call: Call) -> Response:
        body = call.parse_body(_LoginBody)
        device = call.request.cookies.get(call.cookie_name(DEVICE_COOKIE), "")[:200]
        known = self._users.is_known_device(body.user, device)
        buckets = self._limiter.buckets_of_login(body.user, address_group(call.address), device if known else None)
        with self._limiter.attempt(buckets, known=known) as refund:
            if not self._users.verify_password(body.user, body.password):
                log.warning("Log-in refused", extra=kv(user=body.user[:40], address=call.address))
                raise ApiError(401, "wrong_login", "wrong user name or password")
            refund()
        device = self._users.add_device(body.user, device)
        response = self._log_in(call, body.user)
        self._set_cookie(call, response, DEVICE_COOKIE, device, LOGIN, DEVICE_S)
        return response

    def _login_link(self, call: Call) -> Response:
        body = call.parse_body(_LinkBody)
        buckets: Buckets = {("link at address", address_group(call.address)): RATE_OF_ADDRESS}
        with self._limiter.attempt(buckets, known=False) as refund:
            state, name = self._users.use_login_link(body.token)
            if state != "valid":
                log.warning("Log-in link refused", extra=kv(user=name, state=state, address=call.address))
                raise ApiError(401, *_LINK_PROBLEMS[state])
            refund()
        return self._log_in(call, name)

    def _log_in(self, call: Call, name: str) -> Response:
        """Start a session, and return its response with the cookie."""
        session = self._users.start_session(name)
        log.info("User logged in", extra=kv(user=session.name, role=session.role, address=call.address))
        response = JSONResponse(self._session_json(session))
        self._set_cookie(call, response, COOKIE, session.token, "/", self._max_age_s)
        return response

    def _set_cookie(self, call: Call, response: Response, name: str, value: str, path: str, max_age_s: float) -> None:
        response.set_cookie(
            call.cookie_name(name),
            value,
            max_age=int(max_age_s),
            path=path,
            httponly=True,
            samesite="strict",
            secure=self._tls,
        )

    def _session_json(self, session: Session) -> Json:
        actor = Actor(session.name, session.role, "")
        return {
            "user": session.name,
            "role": session.role,
            "csrf": session.csrf,
            "begun_utc_s": session.begun_utc_s,
            "may": {permission: actor.may(permission, self._side) for permission in PERMISSIONS},
        }

    def _session(self, call: Call) -> Response:
        assert call.session is not None
        return JSONResponse(self._session_json(call.session))

    def _logout(self, call: Call) -> Response:
        assert call.session is not None
        self._users.end_session(call.session.token)
        response = Response(status_code=204)
        response.delete_cookie(call.cookie_name(COOKIE), httponly=True, samesite="strict", secure=self._tls)
        return response

    def _password(self, call: Call) -> Response:
        assert call.session is not None
        body = call.parse_body(_PasswordBody)
        name = call.session.name
        if not MIN_PASSWORD <= len(body.new) <= MAX_PASSWORD:
            message = f"a password has {MIN_PASSWORD} to {MAX_PASSWORD} characters; this one has {len(body.new)}"
            raise ApiError(400, "bad_request", message, "new")
        # An unattended page could be used to guess the password.
        with self._limiter.attempt({("session", call.session.token): RATE_OF_SOURCE}, known=False) as refund:
            if not self._users.verify_password(name, body.old):
                log.warning("Password change refused", extra=kv(user=name, address=call.address))
                raise ApiError(403, "wrong_login", "this is not your current password", "old")
            refund()
            self._users.set_password(name, body.new, keep=call.session.token)
        log.info("Password changed", extra=kv(user=name, address=call.address))
        return Response(status_code=204)

    def _read_settings(self, call: Call) -> Response:
        return JSONResponse({"names": list(SETTINGS), "settings": self._users.settings(call.actor.user)})

    def _write_settings(self, call: Call) -> Response:
        values = call.parse_body(_SettingsBody).settings
        for name in values:
            if name not in SETTINGS:
                raise ApiError(400, "bad_request", f"unknown setting; known: {', '.join(SETTINGS)}", f"settings.{name}")
        self._users.store_settings(call.actor.user, values)
        return Response(status_code=204)
