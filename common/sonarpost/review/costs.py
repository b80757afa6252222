"""Air time of requests to a vehicle, and when their answers arrive."""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, product
from typing import Final

from scipy.special import bdtrc

from sonarpost.modem.interface import RateInfo

NEW_IMAGE_KINDS: Final = ("expand", "original")
"""Kinds of requests that are answered with an image of its own."""


RETRY_S: Final = 20.0
"""Default of op_modem's `retry_s` and `feedback_interval_s`: wait before a lost packet is repeated."""
_RETRY_WAITS: Final = (1.0, 1.0, 1.0, 2.0, 4.0, 8.0, 8.0, 8.0)
_TURN_S: Final = 2.7
"""Wait of the vessel for a free channel (`holdoff_s`), and the travel time over 1 km."""
_ANSWER_TURN_S: Final = 5.7
"""The same of the vehicle."""
_CODING_S: Final = 2.0
_PRIOR_LOSS: Final = 0.2
_PRIOR_PACKETS: Final = 2
_PRIOR_REQUESTS: Final = 2
_FACTORS: Final = (0.5, 4.0)
_SHARE: Final = 0.9


@dataclass(frozen=True, slots=True)
class RequestCost:
    """Estimated cost of a request.

    Attributes:
        downlink_s: Air time of the request packet.
        uplink_s: Air time of the vehicle's answer; None if unknown.
        bytes_wanted: Size of the answer; None if unknown.
        bytes_total: Length of the stream with the answer; None if unknown.
    """

    downlink_s: float
    uplink_s: float | None = None
    bytes_wanted: int | None = None
    bytes_total: int | None = None

    @property
    def airtime_s(self) -> float | None:
        """Air time of both directions; None if the uplink is unknown."""
        return None if self.uplink_s is None else self.downlink_s + self.uplink_s


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

    `refine` doubles the length of the stream, and `resend` completes the present stream. `expand` and
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
        return RequestCost(downlink_s, 0.0, 0, 0)
    if bytes_total == 0:
        return RequestCost(downlink_s)
    total_bytes = 2 * bytes_total if kind == "refine" else bytes_total
    wanted_bytes = max(0, total_bytes - bytes_received)
    if uplink_rate is None:
        return RequestCost(downlink_s, None, wanted_bytes, total_bytes)
    sent_bytes = math.ceil(wanted_bytes / (1 - min(0.9, loss or 0.0)))
    frames = math.ceil(sent_bytes / (uplink_rate.frame_bytes - overhead_bytes))
    packets = math.ceil(frames / uplink_rate.frames)
    return RequestCost(downlink_s, packets * uplink_rate.airtime_s, wanted_bytes, total_bytes)


@dataclass(frozen=True, slots=True)
class LinkRecord:
    """What is known of the link to a vehicle.

    Attributes:
        loss_up: Fraction of recently lost frames of the vehicle; None if unknown.
        sent: Transmissions of the latest confirmed requests.
        lost: Of these, those that were repeated.
        ratios: Time to the answer over the expected time, of the latest answered requests.
    """

    loss_up: float | None = None
    sent: int = 0
    lost: int = 0
    ratios: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class ExpectedArrival:
    """When an answer is complete, in seconds after the request.

    Attributes:
        median_s: Half of the answers are complete by then.
        most_s: 90 % are.
    """

    median_s: float
    most_s: float


@dataclass(frozen=True, slots=True)
class RequestEstimate:
    """Cost of a request, when its answer arrives, and on what both rest.

    Attributes:
        cost: The cost.
        arrival: When the answer is complete; None if unknown, or if it depends on the track of the vehicle.
        link: The measurements.
    """

    cost: RequestCost
    arrival: ExpectedArrival | None
    link: LinkRecord


@lru_cache(maxsize=256)
def expected_arrival(cost: RequestCost, rate: RateInfo, overhead_bytes: int, link: LinkRecord) -> ExpectedArrival:
    """Estimate the time from a request to its complete answer.

    The time is

        g (T + W(n) + A + r (T + A') + m R)

    with T: turn and air time of a packet of the vessel; n: lost copies of the request, P(n) = d^n (1 - d); W(n): the
    waits before their repetitions, R (1 + 1 + 1 + 2 + 4 + ...), with R = `RETRY_S`; A: turn of the vehicle, coding and
    the packets of the answer; A': turn and one packet; r: repetitions of a part of the answer, P(r) = (1 - c)^r c with
    c = P(at least k of the F frames of the answer arrive) at the loss u of the vehicle's frames, and k carry all bytes;
    m: lost feedback of these repetitions, negative binomial with d. The loss of the vessel's packets is
    d = (lost + 2 u) / (sent + 2). g = exp(sum(log ratio) / (n + 2)) of n past requests, 0.5 to 4. Without a measurement
    u = 0.2, the default of `expected_loss`. Other traffic of the vehicle is contained in g only.

    Args:
        cost: Cost of the request, with a known answer.
        rate: Rate of the vehicle.
        overhead_bytes: Header bytes in each frame.
        link: Measurements.
    """
    assert cost.bytes_wanted is not None
    loss = min(0.9, _PRIOR_LOSS if link.loss_up is None else link.loss_up)
    down = min(0.9, (link.lost + _PRIOR_PACKETS * loss) / (link.sent + _PRIOR_PACKETS))
    needed = 1 + math.ceil(
        cost.bytes_wanted / (rate.frame_bytes - overhead_bytes)
    )  # one more for confirmation, preview
    packets = math.ceil(needed / (1 - loss) / rate.frames)
    frames = packets * rate.frames
    complete = float(bdtrc(needed - 1, frames, 1 - loss))
    turn_s = _TURN_S + cost.downlink_s
    round_s = turn_s + _ANSWER_TURN_S + rate.airtime_s
    first_s = turn_s + _ANSWER_TURN_S + _CODING_S + packets * rate.airtime_s
    outcomes: list[tuple[float, float]] = []
    for tries, rounds in product(range(len(_RETRY_WAITS)), repeat=2):
        share = down**tries * (1 - down) * (1 - complete) ** rounds * complete
        for lost in range(len(_RETRY_WAITS) if rounds else 1):
            chance = math.comb(rounds + lost - 1, lost) * down**lost * (1 - down) ** rounds if rounds else 1.0
            wait_s = RETRY_S * (sum(_RETRY_WAITS[:tries]) + lost)
            outcomes.append((first_s + wait_s + rounds * round_s, share * chance))
    outcomes.sort()
    reached = list(accumulate(chance for _, chance in outcomes))
    median_s, most_s = (outcomes[bisect_left(reached, share * reached[-1])][0] for share in (0.5, _SHARE))
    factor = math.exp(sum(map(math.log, link.ratios)) / (len(link.ratios) + _PRIOR_REQUESTS))
    factor = min(max(factor, _FACTORS[0]), _FACTORS[1])
    return ExpectedArrival(factor * median_s, factor * most_s)
