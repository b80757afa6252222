"""Routes of sessions: log-in, log-out, password."""

from __future__ import annotations

import logging
import math
import time

from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from sonarpost.logs import kv
from sonarpost.services.console.store.database import PERMISSIONS, Actor, Side
from sonarpost.services.console.store.serialisers import Json
from sonarpost.services.console.store.users import MAX_PASSWORD, MIN_PASSWORD, LoginLimiter, Session, Users
from sonarpost.services.console.web.access import COOKIE, AccessControl, ApiError, Call, RequestBody

log = logging.getLogger(__name__)


class _LoginBody(RequestBody):
    user: str
    password: str


class _PasswordBody(RequestBody):
    old: str
    new: str


class SessionRoutes:
    """Routes of sessions.

    Args:
        tls: Whether the cookie is restricted to TLS.
        max_age_s: Lifetime of the cookie.
    """

    def __init__(self, users: Users, side: Side, *, tls: bool, max_age_s: float) -> None:
        self._users = users
        self._side = side
        self._tls = tls
        self._max_age_s = max_age_s
        self._limiter = LoginLimiter()

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        return [
            Route("/api/login", access.endpoint(self._login, needs_session=False), methods=["POST"]),
            Route("/api/session", access.endpoint(self._session)),
            Route("/api/logout", access.endpoint(self._logout), methods=["POST"]),
            Route("/api/password", access.endpoint(self._password), methods=["POST"]),
        ]

    def _login(self, call: Call) -> Response:
        body = call.parse_body(_LoginBody)
        self._check_rate(body.user, call.address)
        if not self._users.verify_password(body.user, body.password):
            self._limiter.add_failure(body.user, call.address, time.monotonic())
            log.warning("Log-in refused", extra=kv(user=body.user[:40], address=call.address))
            raise ApiError(401, "wrong_login", "wrong user name or password")
        self._limiter.clear(body.user)
        session = self._users.start_session(body.user)
        log.info("User logged in", extra=kv(user=session.name, role=session.role, address=call.address))
        response = JSONResponse(self._session_json(session))
        response.set_cookie(
            COOKIE, session.token, max_age=int(self._max_age_s), httponly=True, samesite="strict", secure=self._tls
        )
        return response

    def _check_rate(self, user: str, address: str) -> None:
        wait_s = self._limiter.wait_s(user, address, time.monotonic())
        if wait_s > 0:
            headers = {"Retry-After": str(math.ceil(wait_s))}
            raise ApiError(429, "too_many", "too many wrong passwords: wait some minutes", headers=headers)

    def _session_json(self, session: Session) -> Json:
        actor = Actor(session.name, session.role, "")
        return {
            "user": session.name,
            "role": session.role,
            "csrf": session.csrf,
            "expires_utc_s": session.expires_utc_s,
            "may": {permission: actor.may(permission, self._side) for permission in PERMISSIONS},
        }

    def _session(self, call: Call) -> Response:
        assert call.session is not None
        return JSONResponse(self._session_json(call.session))

    def _logout(self, call: Call) -> Response:
        assert call.session is not None
        self._users.end_session(call.session.token)
        response = Response(status_code=204)
        response.delete_cookie(COOKIE, httponly=True, samesite="strict", secure=self._tls)
        return response

    def _password(self, call: Call) -> Response:
        assert call.session is not None
        body = call.parse_body(_PasswordBody)
        name = call.session.name
        if not MIN_PASSWORD <= len(body.new) <= MAX_PASSWORD:
            message = f"a password has {MIN_PASSWORD} to {MAX_PASSWORD} characters; this one has {len(body.new)}"
            raise ApiError(400, "bad_request", message, "new")
        self._check_rate(name, call.address)
        if not self._users.verify_password(name, body.old):
            # Limited like a log-in, because an unattended page could be used to guess the password.
            self._limiter.add_failure(name, call.address, time.monotonic())
            log.warning("Password change refused", extra=kv(user=name, address=call.address))
            raise ApiError(403, "wrong_login", "this is not your present password", "old")
        self._users.set_password(name, body.new, keep=call.session.token)
        log.info("Password changed", extra=kv(user=name, address=call.address))
        return Response(status_code=204)
