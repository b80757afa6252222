"""Model of the acoustic channel: how many frames arrive, and which rate carries most.

Frame losses follow a two-state Markov chain (Gilbert, "Capacity of a burst-noise channel", Bell System Technical
Journal 39, 1960): the probability of a loss depends on whether the frame before was lost. `burst` is the mean number of
frames lost in a row; at 1 / (1 - loss) or below, losses are independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Final

import numpy as np
import numpy.typing as npt

from sonarpost.errors import ConfigError
from sonarpost.link.frames.v1.frame import HEADER_BYTES
from sonarpost.link.state import Bounds, check_bounds
from sonarpost.modem.interface import RateInfo

Values = npt.NDArray[np.float64]

_LOSS_MEMORY_S: Final = 1800.0
"""How long a measured loss is valid."""


@dataclass(frozen=True, slots=True)
class LossChannel:
    """Loss model of a channel.

    Attributes:
        loss: Share of frames lost, 0..0.99.
        burst: Mean number of frames lost in a row, 1 or more; losses are independent below 1 / (1 - loss).

    Raises:
        ConfigError: A value out of range.
    """

    loss: Annotated[float, Bounds(0, 0.99)]
    burst: Annotated[float, Bounds(1, 1e6)] = 1.0

    def __post_init__(self) -> None:
        check_bounds(self, "acoustic channel", ConfigError)

    @property
    def memory(self) -> float:
        """Correlation between the losses of two successive frames, 0..1."""
        return max(0.0, 1.0 - 1.0 / (self.burst * (1.0 - self.loss)))

    def spread(self, depth: int) -> LossChannel:
        """Return the channel of frames that are sent `depth` frames apart."""
        memory = self.memory**depth
        if memory == 0.0:
            return LossChannel(self.loss)
        return LossChannel(self.loss, max(1.0, 1.0 / ((1.0 - self.loss) * (1.0 - memory))))


def received_distribution(frames: int, channel: LossChannel) -> Values:
    """Return shape (frames + 1,): the probability that 0, 1, ... of successive frames arrive."""
    loss, memory = channel.loss, channel.memory
    stay_lost, become_lost = loss + (1 - loss) * memory, loss - loss * memory
    lost, good = np.zeros(frames + 2), np.zeros(frames + 2)
    lost[0], good[1] = loss, 1 - loss  # after the first frame
    if frames == 0:
        return np.ones(1)
    for _ in range(frames - 1):
        next_lost = lost * stay_lost + good * become_lost
        arriving = lost * (1 - stay_lost) + good * (1 - become_lost)
        lost, good = next_lost, np.concatenate([[0.0], arriving[:-1]])
    return (lost + good)[: frames + 1]


def unseen_share(source_frames: int, sent_frames: int, channel: LossChannel) -> float:
    """Return the share of source symbols that stay unknown if `sent_frames` of a systematic block are sent.

    With fewer than k received symbols, the received source symbols are still known: if r of n arrive, each of them
    arrives with probability r / n.
    """
    arrived = received_distribution(sent_frames, channel)
    counts = np.arange(sent_frames + 1)
    short = counts < source_frames
    return float((arrived * short * (1 - counts / max(sent_frames, 1))).sum())


def frames_for(source_frames: int, channel: LossChannel, unseen: float, limit: int) -> int:
    """Return the fewest frames of a systematic block that leave a share of at most `unseen` unknown, up to `limit`."""
    low, high = source_frames, max(limit, source_frames)
    while low < high:
        middle = (low + high) // 2
        if unseen_share(source_frames, middle, channel) <= unseen:
            high = middle
        else:
            low = middle + 1
    return low


@dataclass(eq=False)
class RateSelector:
    """Selects the rate with the most payload per second, and tests the others from time to time.

    The loss at a rate that was not used recently is unknown. It is assumed to be that of the next slower rate with a
    known loss. So a faster rate is tried every half hour, and left as soon as its loss is measured.

    Args:
        allowed: The allowed rates.
        current: The rate in use.
        losses: Loss and time of the measurement, by rate.

    Raises:
        ConfigError: The current rate is not allowed.
    """

    allowed: Sequence[RateInfo]
    current: int
    losses: dict[int, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        numbers = tuple(rate.number for rate in self.allowed)
        if self.current not in numbers:
            raise ConfigError("rate selection", "rates", numbers, f"rates with the first, {self.current}")

    def record_loss(self, loss: float, now: float) -> None:
        """Record the measured loss at the current rate, 0..1."""
        self.losses[self.current] = (min(max(loss, 0.0), 1.0), float(now))

    def select(self, now: float) -> int:
        """Make the best rate, with an ideal erasure code, the current one and return it."""
        self.losses = {n: (loss, at) for n, (loss, at) in self.losses.items() if 0 <= now - at <= _LOSS_MEMORY_S}
        if self.current not in self.losses:
            return self.current  # a rate on trial stays until its loss is measured
        goodput_bps: dict[int, float] = {}
        assumed = 0.0
        for rate in sorted(self.allowed, key=lambda rate: rate.throughput_bps):
            loss = self.losses[rate.number][0] if rate.number in self.losses else assumed
            assumed = max(assumed, loss)
            payload_bytes = rate.frames * (rate.frame_bytes - HEADER_BYTES)
            goodput_bps[rate.number] = 8 * payload_bytes * (1 - loss) / rate.airtime_s
        self.current = max(goodput_bps, key=lambda number: goodput_bps[number])
        return self.current
