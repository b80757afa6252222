"""Medium access control: when a station may send, so that several stations share one channel.

`now` is UTC in seconds, because slots follow the clock. A policy has no timers.
"""

from __future__ import annotations

import math
import random
from abc import ABC, abstractmethod
from typing import Final

from typing_extensions import override

from sonarpost.errors import ConfigError

_WHERE: Final = "medium access"


class MediumAccess(ABC):
    """A policy of medium access.

    Args:
        holdoff_s: Time after a transmission of another station without a packet of this one: the other may continue.

    Raises:
        ConfigError: A time out of range (also in the derived classes).
    """

    def __init__(self, holdoff_s: float = 0.0) -> None:
        _check("holdoff_s", holdoff_s, 0, 86400)
        self._holdoff_s = holdoff_s
        self._busy_s = self._ended_s = -math.inf

    @abstractmethod
    def wait_s(self, packet_s: float, now: float) -> float | None:
        """Return how long to wait before the next packet; None if it may only follow a request of another station.

        Args:
            packet_s: Time from the command to the modem to the end of the packet.
            now: UTC in seconds.
        """

    def sent(self, started_s: float, ended_s: float) -> None:
        """Record that this station has sent a packet."""
        self._ended_s = ended_s

    def channel_busy(self, now: float) -> None:
        """Record that another station is sending."""
        self._busy_s = now

    def _holdoff_left_s(self, now: float) -> float:
        """Return the rest of the holdoff, 0 if the clock was set back."""
        return max(0.0, self._holdoff_s - (now - self._busy_s)) if self._busy_s <= now else 0.0


class Continuous(MediumAccess):
    """Sends at once, with pauses to leave receive windows for the other station.

    Modems are half-duplex: a station that always sends receives nothing.

    Args:
        tx_burst_s: How long it sends before a pause; a silence of this station counts as a pause.
        rx_window_s: Length of a pause; 0 for none.
        holdoff_s: See `MediumAccess`.
    """

    def __init__(self, tx_burst_s: float = 60.0, rx_window_s: float = 0.0, holdoff_s: float = 0.0) -> None:
        super().__init__(holdoff_s)
        _check("tx_burst_s", tx_burst_s, 0.001, 86400)
        _check("rx_window_s", rx_window_s, 0, 86400)
        self._tx_burst_s = tx_burst_s
        self._rx_window_s = rx_window_s
        self._burst_start_s: float | None = None

    @override
    def wait_s(self, packet_s: float, now: float) -> float | None:
        """Return the rest of the pause or of the holdoff."""
        return max(self._pause_left_s(now), self._holdoff_left_s(now))

    def _pause_left_s(self, now: float) -> float:
        if self._rx_window_s == 0 or self._burst_start_s is None or self._ended_s > now:
            return 0.0  # the last condition: a clock that was set back must not silence the vehicle
        if now - self._ended_s >= self._rx_window_s:
            self._burst_start_s = None
            return 0.0
        if self._ended_s - self._burst_start_s < self._tx_burst_s:
            return 0.0
        return self._rx_window_s - (now - self._ended_s)

    @override
    def sent(self, started_s: float, ended_s: float) -> None:
        """Record a packet, which may start a new burst."""
        start_s = self._burst_start_s
        if start_s is None or started_s - self._ended_s >= self._rx_window_s or started_s < start_s:
            self._burst_start_s = started_s
        super().sent(started_s, ended_s)


class Tdma(MediumAccess):
    """Sends in its own slot of a cycle (time-division multiple access), so that stations never collide.

    Cycles repeat from 1970-01-01 UTC on. The time between the slots of two stations covers the difference between their
    clocks and the acoustic travel time.

    Args:
        tdma_cycle_s: Length of the cycle.
        start_s: Start of the slot in the cycle.
        end_s: End of the slot in the cycle.
    """

    def __init__(self, tdma_cycle_s: float, start_s: float, end_s: float) -> None:
        super().__init__()
        _check("tdma_cycle_s", tdma_cycle_s, 0.001, 86400)
        _check("tdma_slot_s", end_s, 0.001, tdma_cycle_s)
        _check("tdma_slot_s", start_s, 0, end_s)
        self._cycle_s = tdma_cycle_s
        self._start_s = start_s
        self._slot_s = end_s - start_s

    @override
    def wait_s(self, packet_s: float, now: float) -> float | None:
        """Return the time to a slot with room for the packet, None if no slot is long enough."""
        if packet_s > self._slot_s:
            return None
        elapsed_s = (now - self._start_s) % self._cycle_s
        return 0.0 if elapsed_s + packet_s <= self._slot_s else self._cycle_s - elapsed_s


class Polled(MediumAccess):
    """Sends only when the other station requests a packet."""

    @override
    def wait_s(self, packet_s: float, now: float) -> float | None:
        return None


class Csma(MediumAccess):
    """Waits a random time before each packet, and while others send (ALOHA with carrier sense).

    Waits are distributed evenly from 0 to twice their mean. For n stations with packets of length T, a mean of about
    n T gives the greatest throughput; far below that, packets collide.

    Args:
        mean_backoff_s: Mean of the waits.
        holdoff_s: See `MediumAccess`.
        seed: Seed of the waits, different for each station.
    """

    def __init__(self, mean_backoff_s: float, holdoff_s: float = 0.0, seed: int = 0) -> None:
        super().__init__(holdoff_s)
        _check("mean_backoff_s", mean_backoff_s, 0, 86400)
        self._max_s = 2 * mean_backoff_s
        self._random = random.Random(seed)  # noqa: S311 not for cryptography
        self._not_before_s: float | None = None

    @override
    def wait_s(self, packet_s: float, now: float) -> float | None:
        """Return the rest of the random wait or of the holdoff."""
        if self._not_before_s is None or self._not_before_s - now > self._max_s:  # the latter: the clock was set back
            self._not_before_s = now + self._random.uniform(0, self._max_s)
        return max(0.0, self._not_before_s - now, self._holdoff_left_s(now))

    @override
    def sent(self, started_s: float, ended_s: float) -> None:
        """Record a packet and draw the next wait."""
        self._not_before_s = ended_s + self._random.uniform(0, self._max_s)


def _check(name: str, value: float, low: float, high: float) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise ConfigError(_WHERE, name, value, f"{low}..{high}")
