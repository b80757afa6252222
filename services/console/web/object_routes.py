"""Routes of objects: an object with its looks, one verdict for all of them, and changes by a person."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from sonarpost.messages import Verdict
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.database import DisplayedImage
from sonarpost.services.console.store.decisions import DecisionInput
from sonarpost.services.console.store.objects import MAX_OBJECT_LOOKS
from sonarpost.services.console.web.access import AccessControl, Call, RequestBody
from sonarpost.services.console.web.contact_routes import ImageLayer, Version

_ContactId = Annotated[str, Field(min_length=1, max_length=200)]


class _LookBody(RequestBody):
    contact: _ContactId
    revision: Annotated[int, Field(ge=0)]
    version: Version
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    layer: ImageLayer = "raw"


class _DecisionBody(RequestBody):
    looks: Annotated[list[_LookBody], Field(min_length=1, max_length=MAX_OBJECT_LOOKS)]
    verdict: Verdict
    confidence: Annotated[float, Field(ge=0, le=1)] | None = None
    mlo_class: Annotated[str, Field(min_length=1, max_length=60)] | None = None
    remark: Annotated[str, Field(max_length=2000)] = ""

    @model_validator(mode="after")
    def _names_each_look_once(self) -> _DecisionBody:
        if len({look.contact for look in self.looks}) < len(self.looks):
            raise ValueError("each look once")
        return self


class _ContactBody(RequestBody):
    contact: _ContactId


class ObjectRoutes:
    """Routes of objects."""

    def __init__(self, state: ConsoleState) -> None:
        self._state = state

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        path, endpoint = "/api/objects/{id}", access.endpoint
        return [
            Route(path, endpoint(lambda call: JSONResponse(self._state.object_detail(_object_id(call))))),
            Route(path + "/decisions", endpoint(self._decide, permission="decide"), methods=["POST"]),
            Route(path + "/split", endpoint(self._split, permission="decide"), methods=["POST"]),
            Route(path + "/merge", endpoint(self._merge, permission="decide"), methods=["POST"]),
        ]

    def _decide(self, call: Call) -> Response:
        body = call.parse_body(_DecisionBody)
        entered = {
            look.contact: DecisionInput(
                look.revision,
                DisplayedImage(look.version, look.sha256, look.layer),
                body.verdict,
                body.confidence,
                body.mlo_class,
                body.remark,
            )
            for look in body.looks
        }
        return JSONResponse(self._state.decide_object(_object_id(call), entered, call.actor), 201)

    def _split(self, call: Call) -> Response:
        body = call.parse_body(_ContactBody)
        return JSONResponse(self._state.split_look(_object_id(call), body.contact, call.actor))

    def _merge(self, call: Call) -> Response:
        body = call.parse_body(_ContactBody)
        return JSONResponse(self._state.merge_objects(_object_id(call), body.contact, call.actor))


def _object_id(call: Call) -> str:
    return str(call.request.path_params["id"])[:20]
