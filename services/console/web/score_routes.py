"""Route of the score of operators on contacts whose object is known."""

from __future__ import annotations

from starlette.responses import JSONResponse
from starlette.routing import Route

from sonarpost.services.console.known_objects import KnownObjects
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.web.access import AccessControl


class ScoreRoutes:
    """Route of the score."""

    def __init__(self, state: ConsoleState) -> None:
        self._known = KnownObjects(state)

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the route."""
        return [Route("/api/score", access.endpoint(lambda call: JSONResponse(self._known.score_sheet(call.actor))))]
