"""Model of the acoustic channel: how many frames arrive, what no scheme can exceed, and which rate carries most.

Frame losses follow a two-state Markov chain (Gilbert, "Capacity of a burst-noise channel", Bell System Technical
Journal 39, 1960): the probability of a loss depends on whether the frame before was lost. `burst` is the mean number of
frames lost in a row; at 1 / (1 - loss) or below, losses are independent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from sonarpost.errors import ConfigError
from sonarpost.link.frames.v1.frame import HEADER_BYTES
from sonarpost.modem.micromodem import RATES, Rate

Values = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LossChannel:
    """Loss model of a channel.

    Attributes:
        loss: Share of frames lost, 0..0.99.
        burst: Mean number of frames lost in a row, 1 or more; losses are independent below 1 / (1 - loss).

    Raises:
        ConfigError: A value out of range.
    """

    loss: float
    burst: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.loss <= 0.99:
            raise ConfigError("acoustic channel", "loss", self.loss, "0..0.99")
        if not 1.0 <= self.burst <= 1e6:
            raise ConfigError("acoustic channel", "burst", self.burst, "1..1000000 frames")

    @property
    def memory(self) -> float:
        """Correlation between the losses of two successive frames, 0..1."""
        return max(0.0, 1.0 - 1.0 / (self.burst * (1.0 - self.loss)))

    def spread(self, depth: int) -> LossChannel:
        """Return the channel of frames that are sent `depth` frames apart."""
        memory = self.memory**depth
        return (
            LossChannel(self.loss, max(1.0, 1.0 / ((1.0 - self.loss) * (1.0 - memory)))) if memory > 0 else self.plain
        )

    @property
    def plain(self) -> LossChannel:
        """The channel with the same loss and independent losses."""
        return LossChannel(self.loss)


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


def erasure_bound_frames(payload_bytes: float, frame_bytes: int, loss: float) -> float:
    """Return the least average number of frames that any scheme must send for a payload.

    The capacity of an erasure channel (Elias, "Coding for two noisy channels", 1955) is 1 - loss. Headers, checksums
    and feedback are not included.
    """
    return payload_bytes / (frame_bytes * (1.0 - loss))


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


def best_rate(measured_loss: Mapping[int, float], rates: Mapping[int, Rate]) -> Rate:
    """Return the rate with the most payload per second, with an ideal erasure code.

    Args:
        measured_loss: Share of frames lost by rate number, of the allowed rates.
        rates: Content and airtime of a packet of each rate.

    Raises:
        ConfigError: No rate, an unknown one, or a loss outside 0..1.
    """
    if not measured_loss:
        raise ConfigError("rate selection", "measured_loss", {}, "at least one rate")
    for number, loss in measured_loss.items():
        if number not in rates or not 0.0 <= loss <= 1.0:
            raise ConfigError("rate selection", f"rate {number}", loss, f"one of {sorted(rates)}, loss 0..1")

    def goodput_bps(number: int) -> float:
        rate = rates[number]
        return 8 * rate.frames * (rate.frame_bytes - HEADER_BYTES) * (1 - measured_loss[number]) / rate.airtime_s

    return rates[max(measured_loss, key=goodput_bps)]


@dataclass(eq=False)
class RateSelector:
    """Selects the rate with the most payload per second, and tests the others from time to time.

    The loss at a rate that was not used recently is unknown. It is assumed to be that of the next slower rate with a
    known loss. So a faster rate is tried once in `memory_s`, and left as soon as its loss is measured.

    Args:
        allowed: Numbers of the allowed rates.
        current: The rate in use.
        memory_s: How long a measurement is valid.
        losses: Loss and time of the measurement, by rate.
        rates: The rates by number.

    Raises:
        ConfigError: An unknown rate, or the current one is not allowed.
    """

    allowed: Sequence[int]
    current: int
    memory_s: float = 1800.0
    losses: dict[int, tuple[float, float]] = field(default_factory=dict)
    rates: Mapping[int, Rate] = field(default_factory=lambda: RATES)

    def __post_init__(self) -> None:
        unknown = [number for number in (*self.allowed, self.current) if number not in self.rates]
        if unknown or self.current not in self.allowed:
            expected = f"some of {sorted(self.rates)}, with the first"
            raise ConfigError("rate selection", "rates", tuple(self.allowed), expected)

    def record_loss(self, loss: float, now: float) -> None:
        """Record the measured loss at the current rate, 0..1."""
        self.losses[self.current] = (min(max(loss, 0.0), 1.0), float(now))

    def select(self, now: float) -> int:
        """Make the best rate the current one and return it."""
        by_speed = sorted(self.allowed, key=lambda number: self.rates[number].throughput_bps)
        known: dict[int, float] = {}
        assumed = 0.0
        for number in by_speed:
            loss, measured_s = self.losses.get(number, (assumed, -1.0))
            if number in self.losses and not 0 <= now - measured_s <= self.memory_s:
                del self.losses[number]
                loss = assumed
            known[number] = loss
            assumed = max(assumed, loss) if number in self.losses else assumed
        if self.current in self.losses:  # a rate on trial stays until its loss is measured
            self.current = best_rate(known, self.rates).number
        return self.current
