"""Log-in, log-out, password."""

from __future__ import annotations

import logging
import math
import time

from starlette.responses import Response
from starlette.routing import Route

from sonarpost.logs import kv
from sonarpost.services.console.store.serialisers import Json
from sonarpost.services.console.store.users import MAX_PASSWORD, MIN_PASSWORD, Actor, Attempts, Session, Side, Users
from sonarpost.services.console.web.access import COOKIE, Body, Call, Gate, RefusedError, json_answer

log = logging.getLogger(__name__)


class _Login(Body):
    user: str
    password: str


class _Password(Body):
    old: str
    new: str


class SessionRoutes:
    """The routes of sessions.

    Args:
        users: Who may log in.
        side: Which side of the water this is.
        tls: Whether the cookie is for TLS only.
        most_s: How long a cookie is kept.
    """

    def __init__(self, users: Users, side: Side, *, tls: bool, most_s: float) -> None:
        self._users = users
        self._side = side
        self._tls = tls
        self._most_s = most_s
        self._attempts = Attempts()

    def routes(self, gate: Gate) -> list[Route]:
        """Return the routes."""
        return [
            Route("/api/login", gate.open(self._login, needs_session=False), methods=["POST"]),
            Route("/api/session", gate.open(self._session)),
            Route("/api/logout", gate.open(self._logout), methods=["POST"]),
            Route("/api/password", gate.open(self._password), methods=["POST"]),
        ]

    def _login(self, call: Call) -> Response:
        given = call.parsed(_Login)
        self._wait(given.user, call.address)
        if not self._users.right(given.user, given.password):
            self._attempts.failed(given.user, call.address, time.monotonic())
            log.warning("Log-in refused", extra=kv(user=given.user[:40], address=call.address))
            raise RefusedError(401, "wrong_login", "no user has this name and password")
        self._attempts.succeeded(given.user)
        session = self._users.begin(given.user)
        log.info("Logged in", extra=kv(user=session.name, role=session.role, address=call.address))
        response = json_answer(self._said(session))
        response.set_cookie(
            COOKIE, session.token, max_age=int(self._most_s), httponly=True, samesite="strict", secure=self._tls
        )
        return response

    def _wait(self, user: str, address: str) -> None:
        wait_s = self._attempts.wait_s(user, address, time.monotonic())
        if wait_s > 0:
            raise RefusedError(
                429, "too_many", "too many wrong passwords: wait", headers={"Retry-After": str(math.ceil(wait_s))}
            )

    def _said(self, session: Session) -> Json:
        actor = Actor(session.name, session.role, "")
        may: Json = {
            "decide": actor.may("decide", self._side),
            "measure": actor.may("measure", self._side),
            "request": actor.may("request", self._side),
            "advise": actor.may("advise", self._side),
        }
        return {
            "user": session.name,
            "role": session.role,
            "csrf": session.csrf,
            "expires_utc_s": session.expires_utc_s,
            "may": may,
        }

    def _session(self, call: Call) -> Response:
        assert call.session is not None
        return json_answer(self._said(call.session))

    def _logout(self, call: Call) -> Response:
        assert call.session is not None
        self._users.end(call.session.token)
        response = Response(status_code=204)
        response.delete_cookie(COOKIE, httponly=True, samesite="strict", secure=self._tls)
        return response

    def _password(self, call: Call) -> Response:
        assert call.session is not None
        given = call.parsed(_Password)
        name = call.session.name
        if not MIN_PASSWORD <= len(given.new) <= MAX_PASSWORD:
            expected = f"a password has {MIN_PASSWORD} to {MAX_PASSWORD} characters; this one has {len(given.new)}"
            raise RefusedError(400, "bad_request", expected, "new")
        self._wait(name, call.address)
        if not self._users.right(name, given.old):
            self._attempts.failed(name, call.address, time.monotonic())
            # Somebody may be guessing at a page that was left open.
            log.warning("Change of password refused", extra=kv(user=name, address=call.address))
            raise RefusedError(403, "wrong_login", "this is not your present password", "old")
        self._users.set_password(name, given.new, keep=call.session.token)
        log.info("Password changed", extra=kv(user=name, address=call.address))
        return Response(status_code=204)
