"""Contacts: lists, one of them, its pictures; what people do with it."""

from __future__ import annotations

import re
import uuid
from collections.abc import Callable
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from starlette.responses import Response
from starlette.routing import Route

from sonarpost.messages import Advice, CommandKind, ReconstructedImage, Verdict
from sonarpost.review import rendering
from sonarpost.review.rendering import LAYERS, MAPS
from sonarpost.services.console.measures import Line
from sonarpost.services.console.state import Board, NoSuchError
from sonarpost.services.console.store.contacts import REVIEWS, SORTS, Filter
from sonarpost.services.console.store.database import OnScreen
from sonarpost.services.console.store.decisions import DecisionInput
from sonarpost.services.console.web.access import Body, Call, Gate, RefusedError, json_answer

_NUMBER = re.compile(r"-?\d{1,9}(\.\d{1,9})?")
_Sure = Annotated[float, Field(ge=0, le=1)] | None
_Class = Annotated[str, Field(min_length=1, max_length=60)] | None
_Remark = Annotated[str, Field(max_length=2000)]
_Version = Annotated[int, Field(ge=1, le=2**31)]
_Pixels = tuple[Annotated[float, Field(ge=0, le=4096)], Annotated[float, Field(ge=0, le=4096)]]


class _Decide(Body):
    revision: Annotated[int, Field(ge=0)]
    version: _Version
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    layer: Annotated[str, Field(max_length=20)] = "raw"
    verdict: Verdict
    confidence: _Sure = None
    mlo_class: _Class = None
    remark: _Remark = ""


class _Undo(Body):
    revision: Annotated[int, Field(ge=0)]
    decision_id: Annotated[str, Field(max_length=64)]


class _Measure(Body):
    version: _Version
    layer: Annotated[str, Field(max_length=20)] = "raw"
    kind: Literal["length", "width", "shadow"]
    start: Annotated[_Pixels, Field(alias="from")]
    to: _Pixels
    keep: bool = False


class _Request(Body):
    kind: CommandKind
    airtime_s: Annotated[float, Field(ge=0, le=1e6)] | None = None


class _Advise(Body):
    version: _Version
    verdict: Verdict | None = None
    confidence: _Sure = None
    mlo_class: _Class = None
    remark: _Remark = ""


def number(
    call: Call, name: str, default: float | None, low: float, high: float, *, whole: bool = False
) -> float | None:
    """Return a number of the query, `default` where it is absent.

    Raises:
        RefusedError: It is no number from `low` to `high`.
    """
    text = call.request.query_params.get(name)
    if text is None:
        return default
    if _NUMBER.fullmatch(text) is None or not low <= float(text) <= high or (whole and "." in text):
        kind = "whole number" if whole else "number"
        raise RefusedError(400, "bad_request", f"a {kind} from {low:g} to {high:g}", name)
    return float(text)


def choice(call: Call, name: str, default: str | None, allowed: tuple[str, ...]) -> str | None:
    """Return a word of the query, `default` where it is absent.

    Raises:
        RefusedError: It is not allowed.
    """
    text = call.request.query_params.get(name)
    if text is None:
        return default
    if text not in allowed:
        raise RefusedError(400, "bad_request", "one of " + ", ".join(allowed), name)
    return text


def filter_of(call: Call, most: int = 500) -> Filter:
    """Return the filter that a query asks for.

    Raises:
        RefusedError: A parameter is wrong.
    """

    def text(name: str, length: int) -> str | None:
        given = call.request.query_params.get(name)
        if given is not None and len(given) > length:
            raise RefusedError(400, "bad_request", f"at most {length} characters", name)
        return given or None

    complete = choice(call, "complete", None, ("true", "false"))
    return Filter(
        review=choice(call, "review", None, REVIEWS),
        vehicle=text("vehicle", 40),
        vessel=text("vessel", 40),
        min_confidence=number(call, "min_confidence", None, 0, 2),
        complete=None if complete is None else complete == "true",
        group=text("group", 20),
        text=text("q", 80),
        sort=choice(call, "sort", "updated", tuple(SORTS)) or "updated",
        descending=choice(call, "order", "desc", ("asc", "desc")) == "desc",
        offset=int(number(call, "offset", 0, 0, 10**9, whole=True) or 0),
        limit=int(number(call, "limit", min(100, most), 1, most, whole=True) or 1),
    )


class ContactRoutes:
    """The routes of contacts.

    Args:
        board: The console's state.
    """

    def __init__(self, board: Board) -> None:
        self._board = board

    def routes(self, gate: Gate) -> list[Route]:
        """Return the routes."""
        one = "/api/contacts/{id}"
        picture = one + "/versions/{version:int}"
        return [
            Route("/api/contacts", gate.open(lambda call: json_answer(self._board.contacts(filter_of(call))))),
            Route(one, gate.open(lambda call: json_answer(self._board.contact(_id(call))))),
            Route(one + "/costs", gate.open(lambda call: json_answer({"costs": [*self._board.costs(_id(call))]}))),
            Route(picture + "/picture.png", gate.open(self._picture)),
            Route(picture + "/mask.png", gate.open(self._mask)),
            Route(picture + "/thumbnail.png", gate.open(self._thumbnail)),
            Route(one + "/decisions", gate.open(self._decide, act="decide"), methods=["POST"]),
            Route(one + "/undo", gate.open(self._undo, act="decide"), methods=["POST"]),
            Route(one + "/measure", gate.open(self._measure, act="measure"), methods=["POST"]),
            Route(one + "/requests", gate.open(self._ask, act="request"), methods=["POST"]),
            Route(one + "/advice", gate.open(self._advise, act="advise"), methods=["POST"]),
        ]

    # Pictures

    def _picture(self, call: Call) -> Response:
        layer = choice(call, "layer", "raw", (*(layer.name for layer in LAYERS), "grain"))
        colour_map = choice(call, "map", "grey", MAPS) or "grey"
        low, high = number(call, "low", 0, 0, 99) or 0.0, number(call, "high", 100, 1, 100) or 100.0
        if low >= high:
            raise RefusedError(400, "bad_request", "less than high", "low")
        gamma = number(call, "gamma", 1, 0.2, 5) or 1.0

        def draw(image: ReconstructedImage) -> bytes:
            grey = rendering.eight_bits(image.picture.to_array())
            if layer == "enhanced":
                grey = rendering.enhanced(grey, image.missing())
            return rendering.png(rendering.shown(grey, colour_map, low, high, gamma))

        if layer == "grain":
            raise NoSuchError("picture", "layer", layer, "a layer of this version: none of its codec's making")
        measurable = next(known.measurable for known in LAYERS if known.name == layer)
        response = self._drawn(call, draw)
        response.headers["X-Measurable"] = "true" if measurable else "false"
        return response

    def _mask(self, call: Call) -> Response:
        kind = choice(call, "kind", "missing", ("missing", "guessed"))
        layer = choice(call, "layer", "raw", tuple(known.name for known in LAYERS))

        def draw(image: ReconstructedImage) -> bytes:
            mask = image.missing()
            if kind == "guessed":
                # What is treated is treated everywhere but where nothing arrived, which stays black.
                mask = ~mask if layer != "raw" else np.zeros_like(mask)
            return rendering.png(np.where(mask, np.uint8(255), np.uint8(0)))

        return self._drawn(call, draw)

    def _thumbnail(self, call: Call) -> Response:
        def draw(image: ReconstructedImage) -> bytes:
            grey = rendering.eight_bits(image.picture.to_array())
            return rendering.png(rendering.thumbnail(grey, image.missing()))

        return self._drawn(call, draw)

    def _drawn(self, call: Call, draw: Callable[[ReconstructedImage], bytes]) -> Response:
        image = self._board.image(_id(call), int(call.request.path_params["version"]))
        headers = {"Cache-Control": "private, max-age=86400, immutable"}
        return Response(draw(image), media_type="image/png", headers=headers)

    # What people do

    def _decide(self, call: Call) -> Response:
        given = call.parsed(_Decide)
        judgement = DecisionInput(
            given.revision,
            OnScreen(given.version, given.sha256, given.layer),
            given.verdict,
            given.confidence,
            given.mlo_class,
            given.remark,
        )
        return json_answer(self._board.decide(_id(call), judgement, call.actor), 201)

    def _undo(self, call: Call) -> Response:
        given = call.parsed(_Undo)
        return json_answer(self._board.undo(_id(call), given.decision_id, given.revision, call.actor), 201)

    def _measure(self, call: Call) -> Response:
        given = call.parsed(_Measure)
        line = Line(given.version, given.layer, given.kind, given.start, given.to)
        return json_answer(self._board.measure(_id(call), line, call.actor, keep=given.keep))

    def _ask(self, call: Call) -> Response:
        given = call.parsed(_Request)
        return json_answer(self._board.ask(_id(call), given.kind, given.airtime_s, call.actor), 201)

    def _advise(self, call: Call) -> Response:
        given = call.parsed(_Advise)
        image = self._board.image(_id(call), given.version)
        record = Advice(
            advice_id=f"a-{uuid.uuid4().hex}",
            vessel_id=image.vessel_id,
            vehicle_id=image.vehicle_id,
            image_id=image.image_id,
            image_version=given.version,
            verdict=given.verdict,
            confidence=given.confidence,
            mlo_class=given.mlo_class,
            remark=given.remark,
            author=call.actor.user,
            advised_utc_s=self._board.clock(),
        )
        return json_answer(self._board.advise(_id(call), record, call.actor), 201)


def _id(call: Call) -> str:
    return str(call.request.path_params["id"])
