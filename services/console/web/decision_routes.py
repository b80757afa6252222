"""Routes of decisions: decide, overrule, undo, and notices about decisions of other operators."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from sonarpost.messages import Verdict
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.database import DisplayedImage
from sonarpost.services.console.store.decisions import DecisionInput
from sonarpost.services.console.web.access import AccessControl, Call, RequestBody
from sonarpost.services.console.web.contact_routes import CommentBody, ImageLayer, Version, contact_id

_Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class _DecisionBody(CommentBody):
    verdict: Verdict
    revision: Annotated[int, Field(ge=0)]
    sha256: _Digest
    layer: ImageLayer = "raw"
    overrules: bool = False
    shown_s: Annotated[float, Field(ge=0, le=86400)] | None = None

    @model_validator(mode="after")
    def _has_reason(self) -> _DecisionBody:
        if self.overrules and not self.remark.strip():
            raise ValueError("a remark with the reason, if overrules is true")
        return self


class _UndoBody(RequestBody):
    decision_id: Annotated[str, Field(max_length=64)]
    version: Version | None = None
    sha256: _Digest | None = None
    layer: ImageLayer | None = None


class DecisionRoutes:
    """Routes of decisions and notices."""

    def __init__(self, state: ConsoleState) -> None:
        self._state = state

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        contact, endpoint = "/api/contacts/{id}", access.endpoint
        return [
            Route(contact + "/decisions", endpoint(self._decide, permission="decide"), methods=["POST"]),
            Route(contact + "/undo", endpoint(self._undo, permission="decide"), methods=["POST"]),
            Route("/api/decisions/last", endpoint(self._last)),
            Route("/api/notices", endpoint(self._notices)),
            Route(
                "/api/notices/{id:number}/acknowledge",
                endpoint(self._acknowledge, permission="decide"),
                methods=["POST"],
            ),
        ]

    def _decide(self, call: Call) -> Response:
        body = call.parse_body(_DecisionBody)
        displayed = DisplayedImage(body.version, body.sha256, body.layer)
        values = body.model_dump(include={"verdict", "confidence", "mlo_class", "remark", "overrules", "shown_s"})
        entered = DecisionInput(revision=body.revision, displayed=displayed, **values)
        return JSONResponse(self._state.decide(contact_id(call), entered, call.actor), 201)

    def _undo(self, call: Call) -> Response:
        body = call.parse_body(_UndoBody)
        displayed = DisplayedImage(body.version, body.sha256, body.layer)
        return JSONResponse(self._state.undo(contact_id(call), body.decision_id, displayed, call.actor), 201)

    def _last(self, call: Call) -> Response:
        return JSONResponse(self._state.last_decision(call.actor.user))

    def _notices(self, call: Call) -> Response:
        return JSONResponse({"notices": self._state.notices(call.actor.user)})

    def _acknowledge(self, call: Call) -> Response:
        call.parse_body(RequestBody)
        self._state.acknowledge_notice(int(call.request.path_params["id"]), call.actor)
        return Response(status_code=204)
