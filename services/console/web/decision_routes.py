"""Routes of decisions: decide, overrule, undo, notices; objects with one verdict for all looks, split and merge."""

from __future__ import annotations

from dataclasses import replace
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
from sonarpost.services.console.web.contact_routes import ImageLayer, VerdictBody, Version, contact_id

_Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
_ContactId = Annotated[str, Field(min_length=1, max_length=200)]


class _DisplayedBody(RequestBody):
    revision: Annotated[int, Field(ge=0)]
    version: Version
    sha256: _Digest
    layer: ImageLayer = "raw"


class _DecisionBody(_DisplayedBody, VerdictBody):
    verdict: Verdict
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


class _LookBody(_DisplayedBody):
    contact: _ContactId


class _ObjectDecisionBody(VerdictBody):
    verdict: Verdict
    looks: Annotated[list[_LookBody], Field(min_length=1, max_length=MAX_OBJECT_LOOKS)]

    @model_validator(mode="after")
    def _names_each_look_once(self) -> _ObjectDecisionBody:
        if len({look.contact for look in self.looks}) < len(self.looks):
            raise ValueError("each look once")
        return self


class _ContactBody(RequestBody):
    contact: _ContactId


class DecisionRoutes:
    """Routes of decisions, notices and objects."""

    def __init__(self, state: ConsoleState) -> None:
        self._state = state

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        state, post = self._state, access.post
        return [
            Route("/api/decisions/last", access.endpoint(lambda c: JSONResponse(state.last_decision(c.actor.user)))),
            Route("/api/notices", access.endpoint(lambda c: JSONResponse({"notices": state.notices(c.actor.user)}))),
            Route("/api/objects/{id}", access.endpoint(lambda c: JSONResponse(state.object_detail(_object_id(c))))),
            post("/api/contacts/{id}/decisions", self._decide, "decide"),
            post("/api/contacts/{id}/undo", self._undo, "decide"),
            post("/api/notices/{id:number}/acknowledge", self._acknowledge, "decide"),
            post("/api/objects/{id}/decisions", self._decide_object, "decide"),
            post("/api/objects/{id}/split", self._split, "decide"),
            post("/api/objects/{id}/merge", self._merge, "decide"),
        ]

    def _decide(self, call: Call) -> Response:
        body = call.parse_body(_DecisionBody)
        entered = replace(_entered(body, body), overrules=body.overrules, shown_s=body.shown_s)
        return JSONResponse(self._state.decide(contact_id(call), entered, call.actor), 201)

    def _undo(self, call: Call) -> Response:
        body = call.parse_body(_UndoBody)
        displayed = DisplayedImage(body.version, body.sha256, body.layer)
        return JSONResponse(self._state.undo(contact_id(call), body.decision_id, displayed, call.actor), 201)

    def _acknowledge(self, call: Call) -> Response:
        call.parse_body(RequestBody)
        self._state.acknowledge_notice(int(call.request.path_params["id"]), call.actor)
        return Response(status_code=204)

    def _decide_object(self, call: Call) -> Response:
        body = call.parse_body(_ObjectDecisionBody)
        entered = {look.contact: _entered(body, look) for look in body.looks}
        return JSONResponse(self._state.decide_object(_object_id(call), entered, call.actor), 201)

    def _split(self, call: Call) -> Response:
        body = call.parse_body(_ContactBody)
        return JSONResponse(self._state.split_look(_object_id(call), body.contact, call.actor))

    def _merge(self, call: Call) -> Response:
        body = call.parse_body(_ContactBody)
        return JSONResponse(self._state.merge_objects(_object_id(call), body.contact, call.actor))


def _entered(verdict: _DecisionBody | _ObjectDecisionBody, image: _DisplayedBody) -> DecisionInput:
    values = verdict.model_dump(include={"verdict", "confidence", "mlo_class", "remark"})
    displayed = DisplayedImage(image.version, image.sha256, image.layer)
    return DecisionInput(revision=image.revision, displayed=displayed, **values)


def _object_id(call: Call) -> str:
    return contact_id(call)[:20]
