"""Routes of the settings of a user: language, keys, theme and others, which follow the user to another computer."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import Field
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from sonarpost.services.console.store.users import Users
from sonarpost.services.console.web.access import AccessControl, ApiError, Call, RequestBody

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
            Route("/api/settings", access.endpoint(self._read), methods=["GET"]),
            Route("/api/settings", access.endpoint(self._write), methods=["POST"]),
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
