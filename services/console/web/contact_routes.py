"""Routes of contacts: lists, details, images, decisions, measurements, requests and comments."""

from __future__ import annotations

import re
import uuid
from collections.abc import Callable
from typing import Annotated

import numpy as np
from pydantic import Field
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from sonarpost.messages import Advice, CommandKind, ReconstructedImage, Verdict
from sonarpost.review import rendering
from sonarpost.review.measurement import Line, MeasurementKind
from sonarpost.review.rendering import LAYERS, MAPS
from sonarpost.services.console.state import ConsoleState, NotFoundError
from sonarpost.services.console.store.contacts import REVIEW_FILTERS, SORT_COLUMNS, ContactFilter
from sonarpost.services.console.store.database import DisplayedImage, Permission
from sonarpost.services.console.store.decisions import DecisionInput
from sonarpost.services.console.web.access import AccessControl, ApiError, Call, RequestBody

_NUMBER = re.compile(r"-?\d{1,9}(\.\d{1,9})?")
_Version = Annotated[int, Field(ge=1, le=2**31)]
_Layer = Annotated[str, Field(max_length=20)]
_Point = tuple[Annotated[float, Field(ge=0, le=4096)], Annotated[float, Field(ge=0, le=4096)]]


class _AdviceBody(RequestBody):
    version: _Version
    verdict: Verdict | None = None
    confidence: Annotated[float, Field(ge=0, le=1)] | None = None
    mlo_class: Annotated[str, Field(min_length=1, max_length=60)] | None = None
    remark: Annotated[str, Field(max_length=2000)] = ""


class _DecisionBody(_AdviceBody):
    verdict: Verdict
    revision: Annotated[int, Field(ge=0)]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    layer: _Layer = "raw"


class _UndoBody(RequestBody):
    revision: Annotated[int, Field(ge=0)]
    decision_id: Annotated[str, Field(max_length=64)]


class _MeasureBody(RequestBody):
    version: _Version
    layer: _Layer = "raw"
    kind: MeasurementKind
    start: Annotated[_Point, Field(alias="from")]
    to: _Point
    keep: bool = False


class _RequestBody(RequestBody):
    kind: CommandKind
    airtime_s: Annotated[float, Field(ge=0, le=1e6)] | None = None


def number_parameter(call: Call, name: str, default: float | None, low: float, high: float) -> float | None:
    """Return a number of the query string; `default` if it is absent.

    Raises:
        ApiError: It is not a number from `low` to `high`.
    """
    text = call.request.query_params.get(name)
    if text is None:
        return default
    if _NUMBER.fullmatch(text) is None or not low <= float(text) <= high:
        raise ApiError(400, "bad_request", f"a number from {low:g} to {high:g}", name)
    return float(text)


def integer_parameter(call: Call, name: str, default: int, low: int, high: int) -> int:
    """Return an integer of the query string; `default` if it is absent.

    Raises:
        ApiError: It is not an integer from `low` to `high`.
    """
    number = number_parameter(call, name, default, low, high)
    if number is None or "." in call.request.query_params.get(name, ""):
        raise ApiError(400, "bad_request", f"a whole number from {low} to {high}", name)
    return int(number)


def choice_parameter(call: Call, name: str, default: str, allowed: tuple[str, ...]) -> str:
    """Return a word of the query string; `default` if it is absent.

    Raises:
        ApiError: It is not one of `allowed`.
    """
    text = call.request.query_params.get(name)
    if text is None:
        return default
    if text not in allowed:
        raise ApiError(400, "bad_request", "one of " + ", ".join(allowed), name)
    return text


def _text_parameter(call: Call, name: str, max_length: int) -> str | None:
    text = call.request.query_params.get(name)
    if text is not None and len(text) > max_length:
        raise ApiError(400, "bad_request", f"at most {max_length} characters", name)
    return text or None


def contact_filter(call: Call) -> ContactFilter:
    """Return the contact filter of a query string.

    Raises:
        ApiError: A parameter is invalid.
    """
    complete = choice_parameter(call, "complete", "", ("true", "false"))
    return ContactFilter(
        review=choice_parameter(call, "review", "", REVIEW_FILTERS) or None,
        vehicle=_text_parameter(call, "vehicle", 40),
        vessel=_text_parameter(call, "vessel", 40),
        min_confidence=number_parameter(call, "min_confidence", None, 0, 2),
        complete=complete == "true" if complete else None,
        group=_text_parameter(call, "group", 20),
        text=_text_parameter(call, "q", 80),
        sort=choice_parameter(call, "sort", "updated", tuple(SORT_COLUMNS)),
        descending=choice_parameter(call, "order", "desc", ("asc", "desc")) == "desc",
        offset=integer_parameter(call, "offset", 0, 0, 10**9),
        limit=integer_parameter(call, "limit", 100, 1, 500),
    )


class ContactRoutes:
    """Routes of contacts."""

    def __init__(self, state: ConsoleState) -> None:
        self._state = state

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        contact = "/api/contacts/{id}"
        version = contact + "/versions/{version:int}"
        read, state = access.endpoint, self._state

        def write(path: str, handler: Callable[[Call], Response], permission: Permission) -> Route:
            return Route(path, access.endpoint(handler, permission=permission), methods=["POST"])

        return [
            Route("/api/contacts", read(lambda call: JSONResponse(state.list_contacts(contact_filter(call))))),
            Route(contact, read(lambda call: JSONResponse(state.contact_detail(_id(call))))),
            Route(contact + "/costs", read(lambda call: JSONResponse({"costs": state.request_costs(_id(call))}))),
            Route(version + "/picture.png", read(self._image)),
            Route(version + "/mask.png", read(self._mask)),
            Route(version + "/thumbnail.png", read(self._thumbnail)),
            write(contact + "/decisions", self._decide, "decide"),
            write(contact + "/undo", self._undo, "decide"),
            write(contact + "/measure", self._measure, "measure"),
            write(contact + "/requests", self._add_request, "request"),
            write(contact + "/advice", self._add_advice, "advise"),
        ]

    # Images

    def _image(self, call: Call) -> Response:
        layer = choice_parameter(call, "layer", "raw", (*(layer.name for layer in LAYERS), "grain"))
        colour_map = choice_parameter(call, "map", "grey", MAPS)
        low = number_parameter(call, "low", 0, 0, 99) or 0.0
        high = number_parameter(call, "high", 100, 1, 100) or 100.0
        if low >= high:
            raise ApiError(400, "bad_request", "less than high", "low")
        gamma = number_parameter(call, "gamma", 1, 0.2, 5) or 1.0

        def draw(image: ReconstructedImage) -> bytes:
            grey = rendering.eight_bits(image.picture.to_array())
            if layer == "enhanced":
                grey = rendering.enhance(grey, image.missing())
            return rendering.encode_png(rendering.render(grey, colour_map, low, high, gamma))

        if layer == "grain":
            raise NotFoundError("image", "layer", layer, "a layer of this version")
        measurable = next(known.measurable for known in LAYERS if known.name == layer)
        response = self._png_response(call, draw)
        response.headers["X-Measurable"] = "true" if measurable else "false"
        return response

    def _mask(self, call: Call) -> Response:
        kind = choice_parameter(call, "kind", "missing", ("missing", "guessed"))
        layer = choice_parameter(call, "layer", "raw", tuple(known.name for known in LAYERS))

        def draw(image: ReconstructedImage) -> bytes:
            mask = image.missing()
            if kind == "guessed":
                # Enhancement changes all received pixels. Missing pixels stay black.
                mask = ~mask if layer != "raw" else np.zeros_like(mask)
            return rendering.encode_png(np.where(mask, np.uint8(255), np.uint8(0)))

        return self._png_response(call, draw)

    def _thumbnail(self, call: Call) -> Response:
        def draw(image: ReconstructedImage) -> bytes:
            grey = rendering.eight_bits(image.picture.to_array())
            return rendering.encode_png(rendering.thumbnail(grey, image.missing()))

        return self._png_response(call, draw)

    def _png_response(self, call: Call, draw: Callable[[ReconstructedImage], bytes]) -> Response:
        image = self._state.image(_id(call), int(call.request.path_params["version"]))
        headers = {"Cache-Control": "private, max-age=86400, immutable"}
        return Response(draw(image), media_type="image/png", headers=headers)

    # Actions

    def _decide(self, call: Call) -> Response:
        body = call.parse_body(_DecisionBody)
        displayed = DisplayedImage(body.version, body.sha256, body.layer)
        entered = DecisionInput(body.revision, displayed, body.verdict, body.confidence, body.mlo_class, body.remark)
        return JSONResponse(self._state.decide(_id(call), entered, call.actor), 201)

    def _undo(self, call: Call) -> Response:
        body = call.parse_body(_UndoBody)
        return JSONResponse(self._state.undo(_id(call), body.decision_id, body.revision, call.actor), 201)

    def _measure(self, call: Call) -> Response:
        body = call.parse_body(_MeasureBody)
        line = Line(body.version, body.layer, body.kind, body.start, body.to)
        return JSONResponse(self._state.measure(_id(call), line, call.actor, keep=body.keep))

    def _add_request(self, call: Call) -> Response:
        body = call.parse_body(_RequestBody)
        return JSONResponse(self._state.add_request(_id(call), body.kind, body.airtime_s, call.actor), 201)

    def _add_advice(self, call: Call) -> Response:
        body = call.parse_body(_AdviceBody)
        image = self._state.image(_id(call), body.version)
        record = Advice(
            **body.model_dump(exclude={"version"}),
            advice_id=f"a-{uuid.uuid4().hex}",
            vessel_id=image.vessel_id,
            vehicle_id=image.vehicle_id,
            image_id=image.image_id,
            image_version=body.version,
            author=call.actor.user,
            advised_utc_s=self._state.clock(),
        )
        return JSONResponse(self._state.add_advice(_id(call), record, call.actor), 201)


def _id(call: Call) -> str:
    return str(call.request.path_params["id"])
