"""Routes of contacts: lists, details, images, measurements, requests and comments."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from sonarpost.messages import (
    MIN_REGION_BYTES,
    BoxEnd,
    BoxStart,
    CommandKind,
    Comment,
    ReconstructedImage,
    Verdict,
)
from sonarpost.review import rendering, true_scale
from sonarpost.review.measurement import Line, MeasurementKind
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.contacts import ContactFilter
from sonarpost.services.console.store.related_images import Relation
from sonarpost.services.console.web.access import AccessControl, Call, RequestBody

MAX_REGION_BYTES = 512
"""Longest stream of a region: what a vehicle sends of an image without a further command by default."""

Version = Annotated[int, Field(ge=1, le=2**31)]
ImageLayer = Literal["raw", Relation]
_Point = tuple[Annotated[float, Field(ge=0, le=4096)], Annotated[float, Field(ge=0, le=4096)]]


class VerdictBody(RequestBody):
    """Fields of a decision, and of a comment."""

    confidence: Annotated[float, Field(ge=0, le=1)] | None = None
    mlo_class: Annotated[str, Field(min_length=1, max_length=60)] | None = None
    remark: Annotated[str, Field(max_length=2000)] = ""


class _CommentBody(VerdictBody):
    version: Version
    verdict: Verdict | None = None


class _MeasureBody(RequestBody):
    version: Version
    layer: ImageLayer = "raw"
    kind: MeasurementKind
    start: Annotated[_Point, Field(alias="from")]
    to: _Point
    keep: bool = False


class _RequestBody(RequestBody):
    kind: CommandKind
    airtime_s: Annotated[float, Field(ge=0, le=1e6)] | None = None
    box: tuple[BoxStart, BoxStart, BoxEnd, BoxEnd] | None = None
    stream_bytes: Annotated[int, Field(ge=MIN_REGION_BYTES, le=MAX_REGION_BYTES)] | None = None


class ContactRoutes:
    """Routes of contacts."""

    def __init__(self, state: ConsoleState) -> None:
        self._state = state

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the routes."""
        contact = "/api/contacts/{id}"
        version = contact + "/versions/{version:number}"
        read, post, state = access.endpoint, access.post, self._state
        return [
            Route(
                "/api/contacts", read(lambda call: JSONResponse(state.list_contacts(call.parse_query(ContactFilter))))
            ),
            Route(contact, read(lambda call: JSONResponse(state.contact_detail(contact_id(call))))),
            Route(version + "/image.png", read(self._image)),
            Route(version + "/mask.png", read(self._mask)),
            Route(version + "/thumbnail.png", read(self._thumbnail)),
            post(contact + "/measure", self._measure, "measure"),
            post(contact + "/measure/{measurement:number}/withdraw", self._withdraw_measurement, "measure"),
            post(contact + "/requests", self._add_request, "request"),
            post(contact + "/comment", self._add_comment, "comment"),
        ]

    # Images

    def _image(self, call: Call) -> Response:
        return self._png_response(call, lambda image: rendering.eight_bits(image.pixels.to_array()))

    def _mask(self, call: Call) -> Response:
        return self._png_response(call, lambda image: np.where(image.missing(), np.uint8(255), np.uint8(0)))

    def _thumbnail(self, call: Call) -> Response:
        def draw(image: ReconstructedImage) -> npt.NDArray[np.uint8]:
            grey = rendering.eight_bits(image.pixels.to_array())
            return true_scale.thumbnail(grey, image.missing(), image.contact)

        return self._png_response(call, draw)

    def _png_response(self, call: Call, draw: Callable[[ReconstructedImage], npt.NDArray[np.uint8]]) -> Response:
        image = self._state.image(contact_id(call), int(call.request.path_params["version"]))
        headers = {"Cache-Control": "private, max-age=86400, immutable", "X-Image-SHA256": image.pixels_sha256}
        return Response(rendering.encode_png(draw(image)), media_type="image/png", headers=headers)

    # Actions

    def _measure(self, call: Call) -> Response:
        body = call.parse_body(_MeasureBody)
        line = Line(body.version, body.layer, body.kind, body.start, body.to)
        return JSONResponse(self._state.measure(contact_id(call), line, call.actor, keep=body.keep))

    def _withdraw_measurement(self, call: Call) -> Response:
        call.parse_body(RequestBody)
        measurement_id = int(call.request.path_params["measurement"])
        return JSONResponse(self._state.withdraw_measurement(contact_id(call), measurement_id, call.actor))

    def _add_request(self, call: Call) -> Response:
        body = call.parse_body(_RequestBody)
        arguments = body.model_dump(include={"box", "stream_bytes"}, exclude_none=True)
        found = self._state.add_request(contact_id(call), body.kind, body.airtime_s, call.actor, arguments)
        return JSONResponse(found, 201)

    def _add_comment(self, call: Call) -> Response:
        body = call.parse_body(_CommentBody)
        image = self._state.image(contact_id(call), body.version)
        record = Comment(
            **body.model_dump(exclude={"version"}),
            comment_id=f"a-{uuid.uuid4().hex}",
            vessel_id=image.vessel_id,
            vehicle_id=image.vehicle_id,
            image_id=image.image_id,
            image_version=body.version,
            author=call.actor.user,
            commented_utc_s=self._state.clock(),
        )
        return JSONResponse(self._state.add_comment(contact_id(call), record, call.actor), 201)


def contact_id(call: Call) -> str:
    """Return the identifier in the path of a request."""
    return str(call.request.path_params["id"])
