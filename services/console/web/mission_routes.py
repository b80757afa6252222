"""Route of the mission's progress."""

from __future__ import annotations

from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from sonarpost.services.console.mission import mission_json
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.web.access import AccessControl, Call


class MissionRoutes:
    """Route of the mission's progress."""

    def __init__(self, state: ConsoleState) -> None:
        self._state = state

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the route."""
        return [Route("/api/mission", access.endpoint(self._mission))]

    def _mission(self, _call: Call) -> Response:
        state = self._state
        with state.database.read() as db:
            return JSONResponse(mission_json(state.fleet, db, state.downlink_rate, state.clock()))
