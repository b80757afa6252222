"""Costs of the requests about a contact: air time, arrival of the answer, and the detail that it adds."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from sonarpost.messages import CommandKind, ReconstructedImage
from sonarpost.modem.interface import RateInfo
from sonarpost.review.costs import NEW_IMAGE_KINDS, RequestCost, RequestEstimate, expected_arrival, request_cost
from sonarpost.review.resolution import detail_px, pixel_m, sharp_to_m
from sonarpost.services.console.store.request_results import link_record
from sonarpost.services.console.store.requests import REQUEST_KINDS, find_obstacle
from sonarpost.services.console.store.serialisers import Json, decode_image

FRAME_HEADER_BYTES: Final = 13
"""Header of a frame in the format of the paper; a v1 header with authentication is shorter."""
REGION_BYTES: Final = 192
"""Bytes of a region before the operator chooses others."""
_REGION_SHARE: Final = 0.25
"""Share of the image's pixels for which the detail of a region is stated: a box of half of the sides."""


@dataclass(frozen=True, slots=True)
class VehicleLink:
    """Rates of both directions and the loss of the vehicle's frames; None if unknown."""

    downlink: RateInfo
    uplink: RateInfo | None
    loss: float | None


def estimate_request(
    db: sqlite3.Connection, row: sqlite3.Row, kind: CommandKind, link: VehicleLink, stream_bytes: int | None = None
) -> RequestEstimate:
    """Return cost and arrival of a request about a contact; `stream_bytes` is the length of a region's stream."""
    is_new_image = kind in (*NEW_IMAGE_KINDS, "region")
    total = row["bytes_total"]
    if is_new_image:
        total = (stream_bytes or REGION_BYTES) if kind == "region" else _first_stream_bytes(db, row)
    cost = request_cost(
        kind,
        downlink_rate=link.downlink,
        uplink_rate=link.uplink,
        bytes_received=0 if is_new_image else row["bytes_received"],
        bytes_total=total,
        loss=link.loss,
        overhead_bytes=FRAME_HEADER_BYTES,
    )
    record = link_record(db, row["vehicle_id"], link.loss)
    arrival = None
    if kind not in ("revisit", "prioritise") and link.uplink is not None and cost.bytes_wanted is not None:
        arrival = expected_arrival(cost, link.uplink, FRAME_HEADER_BYTES, record)
    return RequestEstimate(cost, arrival, record)


def costs_json(
    db: sqlite3.Connection, row: sqlite3.Row, link: VehicleLink, now_utc_s: float, *, has_downlink: bool
) -> list[Json]:
    """Return the cost of each kind of request for a contact, in the order of the page."""
    image = decode_image(
        db.execute("SELECT * FROM version WHERE contact_id = ? ORDER BY version DESC LIMIT 1", (row["id"],)).fetchone()
    )
    found: list[Json] = []
    for kind in REQUEST_KINDS:
        estimate = estimate_request(db, row, kind, link)
        cost, arrival = estimate.cost, estimate.arrival
        found.append(
            {
                "kind": kind,
                "reason_code": find_obstacle(db, row, kind, now_utc_s, has_downlink=has_downlink),
                "airtime_s": cost.airtime_s,
                "downlink_s": cost.downlink_s,
                "bytes": cost.bytes_wanted,
                "median_s": arrival and arrival.median_s,
                "most_s": arrival and arrival.most_s,
                **_gain(kind, cost, image),
                "loss_up": estimate.link.loss_up,
                "packets_sent": estimate.link.sent,
                "packets_lost": estimate.link.lost,
                "past_requests": len(estimate.link.ratios),
            }
        )
    return found


def _gain(kind: CommandKind, cost: RequestCost, image: ReconstructedImage) -> Mapping[str, float | None]:
    """Return the smallest detail of the image now and with the answer, in metres; None if unknown or not better."""
    now_m, size_m = sharp_to_m(image), pixel_m(image)
    pixels = image.pixels.height_px * image.pixels.width_px * (_REGION_SHARE if kind == "region" else 1.0)
    width_px = None
    if kind in ("refine", "resend", "region") and cost.bytes_total:
        width_px = detail_px(image.codec, cost.bytes_total, round(pixels))
    then_m = None if width_px is None or size_m is None else width_px * size_m
    if now_m is None or then_m is None or then_m >= now_m:
        return {"detail_m": None, "new_detail_m": None}
    return {"detail_m": now_m, "new_detail_m": then_m}


def _first_stream_bytes(db: sqlite3.Connection, row: sqlite3.Row) -> int:
    """Return the length of a contact's stream before more detail was requested: that of a new image is similar."""
    versions = db.execute("SELECT * FROM version WHERE contact_id = ? ORDER BY version LIMIT 20", (row["id"],))
    lengths = (decode_image(version).bytes_total for version in versions)
    return int(next((length for length in lengths if length), row["bytes_total"]))
