"""Air time of requests to a vehicle."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from sonarpost.modem.interface import RateInfo

NEW_IMAGE_KINDS: Final = ("wider", "original")
"""Kinds of requests that are answered with an image of its own."""


@dataclass(frozen=True, slots=True)
class RequestCost:
    """Estimated cost of a request.

    Attributes:
        downlink_s: Air time of the request packet.
        uplink_s: Air time of the vehicle's answer; None if unknown.
        bytes_wanted: Size of the answer; None if unknown.
        packets: Number of packets of the answer; None if unknown.
        basis: Assumptions of the estimate, as text for the operator.
    """

    downlink_s: float
    uplink_s: float | None
    bytes_wanted: int | None
    packets: int | None
    basis: str

    @property
    def airtime_s(self) -> float | None:
        """Air time of both directions; None if the uplink is unknown."""
        return None if self.uplink_s is None else self.downlink_s + self.uplink_s


def packets_for(payload_bytes: int, rate: RateInfo, overhead_bytes: int) -> int:
    """Return the number of packets of a rate for a payload, with `overhead_bytes` in each frame."""
    frame_bytes = rate.frame_bytes - overhead_bytes
    return math.ceil(math.ceil(payload_bytes / frame_bytes) / rate.frames)


def airtime_of_frames(frames: int, rate: RateInfo) -> float:
    """Return the air time in seconds of the packets that carry this number of frames."""
    return math.ceil(frames / rate.frames) * rate.airtime_s


def least_airtime_s(payload_bytes: int, rate: RateInfo) -> float:
    """Return the air time in seconds of a payload that shares full packets of a rate with other data."""
    return payload_bytes / rate.packet_bytes * rate.airtime_s


def request_cost(
    kind: str,
    *,
    downlink_rate: RateInfo,
    uplink_rate: RateInfo | None,
    bytes_received: int,
    bytes_total: int,
    loss: float | None,
    overhead_bytes: int,
) -> RequestCost:
    """Estimate the cost of a request.

    `refine` doubles the length of the stream, and `resend` completes the present stream. `wider` (expand) and
    `original` request a new image. A `revisit` costs only its request packet, because its result is a new contact. Lost
    frames are sent again, so that the uplink takes 1 / (1 - loss) times as long.

    Args:
        kind: Kind of the request.
        downlink_rate: Rate of the vessel.
        uplink_rate: Latest rate of the vehicle; None if unknown.
        bytes_received: Received bytes of the stream; 0 for `NEW_IMAGE_KINDS`.
        bytes_total: Announced length of the stream; for `NEW_IMAGE_KINDS` the expected length of the new stream.
        loss: Fraction of recently lost frames; None if unknown.
        overhead_bytes: Header bytes in each frame.
    """
    downlink_s = downlink_rate.airtime_s
    if kind in ("revisit", "prioritise"):
        result = "the result is a new contact" if kind == "revisit" else "the images are sent in another order"
        return RequestCost(downlink_s, 0.0, 0, 0, f"one packet down at rate {downlink_rate.number}; {result}")
    if uplink_rate is None:
        return RequestCost(downlink_s, None, None, None, "rate of the vehicle unknown: no frame received")
    if bytes_total == 0:
        return RequestCost(downlink_s, None, None, None, "length of the image stream unknown")
    total_bytes = 2 * bytes_total if kind == "refine" else bytes_total
    wanted_bytes = max(0, total_bytes - bytes_received)
    loss = min(0.9, loss or 0.0)
    packets = packets_for(math.ceil(wanted_bytes / (1 - loss)), uplink_rate, overhead_bytes)
    size = (
        f"a new image of {total_bytes} bytes"
        if kind in (*NEW_IMAGE_KINDS, "region")
        else f"{wanted_bytes} of {total_bytes} bytes missing"
    )
    basis = f"latest rate {uplink_rate.number}, {size}"
    if loss:
        basis += f", {loss:.0%} of frames lost"
    return RequestCost(downlink_s, packets * uplink_rate.airtime_s, wanted_bytes, packets, basis)
