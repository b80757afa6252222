"""What a request to a vehicle costs in air time, told before it is sent."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sonarpost.modem.micromodem import RATES


@dataclass(frozen=True, slots=True)
class RequestCost:
    """What a request costs.

    Attributes:
        downlink_s: Air time of the request itself; None where the vessel's rate is not known.
        uplink_s: Air time of what it leads to; None where that cannot be told.
        bytes_wanted: That come up; None where that cannot be told.
        packets: That these take.
        basis: What was assumed, for people.
    """

    downlink_s: float
    uplink_s: float | None
    bytes_wanted: int | None
    packets: int | None
    basis: str

    @property
    def airtime_s(self) -> float | None:
        """Both ways together; None where the way up cannot be told."""
        return None if self.uplink_s is None else self.downlink_s + self.uplink_s


def packets_for(payload_bytes: int, rate: int, overhead_bytes: int) -> int:
    """Return how many packets of a Micro-Modem rate some bytes take, with `overhead_bytes` of header in every frame."""
    frame = RATES[rate].frame_bytes - overhead_bytes
    return math.ceil(math.ceil(payload_bytes / frame) / RATES[rate].frames)


def airtime_of_frames(frames: int, rate: int) -> float:
    """Return the air time in seconds of packets that bring this many frames at a rate."""
    return math.ceil(frames / RATES[rate].frames) * RATES[rate].airtime_s


def request_cost(
    kind: str,
    *,
    downlink_rate: int,
    uplink_rate: int | None,
    bytes_received: int,
    bytes_total: int,
    loss: float | None,
    overhead_bytes: int,
) -> RequestCost:
    """Return what a `refine`, `resend`, `revisit` or `wider` costs.

    To refine gives a stream of twice the length, to resend what is lacking of the stream there is; more seabed around a
    contact is a new picture, of which nothing is here. A revisit costs the request alone: what the vehicle then sees is
    a contact of its own. Frames that will be lost are sent again, so the
    way up is longer by 1 / (1 - loss).

    Args:
        kind: The request.
        downlink_rate: Micro-Modem rate of the vessel.
        uplink_rate: Of the vehicle, as heard last; None where it is not known.
        bytes_received: Of the picture's stream; 0 for a wider one.
        bytes_total: Of the stream as far as it was announced; for a wider one, of the new stream.
        loss: Share of frames lost lately; None where it is not known.
        overhead_bytes: Of header in a frame.
    """
    downlink_s = RATES[downlink_rate].airtime_s
    if kind == "revisit":
        return RequestCost(
            downlink_s, 0.0, 0, 0, f"one packet down at rate {downlink_rate}; a new look is a new contact"
        )
    if uplink_rate is None:
        return RequestCost(downlink_s, None, None, None, "the vehicle's rate is not known: nothing was heard from it")
    if bytes_total == 0:
        return RequestCost(downlink_s, None, None, None, "the length of the picture's stream is not known")
    whole = 2 * bytes_total if kind == "refine" else bytes_total
    wanted = max(0, whole - bytes_received)
    share = min(0.9, loss or 0.0)
    sent = math.ceil(wanted / (1 - share))
    packets = packets_for(sent, uplink_rate, overhead_bytes)
    lacking = f"a new picture of {whole} bytes" if kind == "wider" else f"{wanted} of {whole} bytes lacking"
    basis = f"rate {uplink_rate} as heard last, {lacking}"
    if share:
        basis += f", {share:.0%} of frames lost"
    return RequestCost(downlink_s, packets * RATES[uplink_rate].airtime_s, wanted, packets, basis)
