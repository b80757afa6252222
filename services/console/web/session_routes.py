"""Routes of sessions and users: log-in, log-out, password, settings."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Annotated, Final

from pydantic import Field
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from sonarpost.logs import kv
from sonarpost.network.connections import address_group
from sonarpost.services.console.store.database import PERMISSIONS, Actor, ConsoleSide
from sonarpost.services.console.store.serialisers import Json
from sonarpost.services.console.store.users import DEVICE_S, LINK_S, MAX_PASSWORD, MIN_PASSWORD, Session, Users
from sonarpost.services.console.web.access import COOKIE, AccessControl, ApiError, Call, ErrorCode, RequestBody
from sonarpost.services.console.web.login_limiter import LoginLimiter

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


class SessionRoutes:
    """Routes of sessions.

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
        with self._limiter.attempt(self._limiter.buckets_of_link(address_group(call.address)), known=False) as refund:
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
        with self._limiter.attempt(self._limiter.buckets_of_session(call.session.token), known=False) as refund:
            if not self._users.verify_password(name, body.old):
                log.warning("Password change refused", extra=kv(user=name, address=call.address))
                raise ApiError(403, "wrong_login", "this is not your current password", "old")
            refund()
            self._users.set_password(name, body.new, keep=call.session.token)
        log.info("Password changed", extra=kv(user=name, address=call.address))
        return Response(status_code=204)


SETTINGS: Final = ("keys", "language", "map", "review", "sort", "theme", "type")
"""Names of the settings that are stored. The page keeps all others in the browser alone."""
MAX_VALUE: Final = 100
"""Characters of a value."""


class _SettingsBody(RequestBody):
    settings: Annotated[dict[str, Annotated[str, Field(max_length=MAX_VALUE)]], Field(max_length=len(SETTINGS))]


class SettingsRoutes:
    """Routes of settings. Every user reads and writes the own ones."""

    def __init__(self, users: Users) -> None:
        self._users = users

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        return [
            Route("/api/settings", access.endpoint(self._read)),
            access.post("/api/settings", self._write),
        ]

    def _read(self, call: Call) -> Response:
        assert call.session is not None
        return JSONResponse({"names": list(SETTINGS), "settings": self._users.settings(call.session.name)})

    def _write(self, call: Call) -> Response:
        assert call.session is not None
        values = call.parse_body(_SettingsBody).settings
        for name in values:
            if name not in SETTINGS:
                raise ApiError(400, "bad_request", f"unknown setting; known: {', '.join(SETTINGS)}", f"settings.{name}")
        self._users.store_settings(call.session.name, values)
        return Response(status_code=204)
