"""Route of the air time of vehicles: images that they still send, and the air time that verdicts gave back."""

from __future__ import annotations

from starlette.responses import JSONResponse
from starlette.routing import Route

from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.web.access import AccessControl


class AirTimeRoutes:
    """Route of the air time."""

    def __init__(self, state: ConsoleState) -> None:
        self._state = state

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the route."""
        return [Route("/api/airtime", access.endpoint(lambda _: JSONResponse(self._state.air_time())))]
