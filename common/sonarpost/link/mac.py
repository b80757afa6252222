"""Medium access: when a station may send, so that several share one water and each can be answered.

Pure: `now` is UTC in seconds, because slots are agreed by the clock. A policy is asked how long to wait before a packet
of a given length and told of what was sent and heard; it has no timers.
"""

from __future__ import annotations

import math
import random
from typing import Final, Protocol

from sonarpost.errors import ConfigError

_WHERE: Final = "medium access"


class MediumAccess(Protocol):
    """A policy of medium access."""

    def wait_s(self, packet_s: float, now: float) -> float | None:
        """Return how long to wait before a packet may be begun; 0 now, None as long as nobody asks for one.

        Args:
            packet_s: Time from the command to the modem to the end of the packet.
            now: UTC in seconds.
        """

    def sent(self, started: float, ended: float) -> None:
        """Note that this station has sent a packet."""

    def heard(self, now: float) -> None:
        """Note that another station is sending."""


class Continuous:
    """Sends at once, but is silent now and then so that the other end gets a word in.

    Modems are half-duplex: a station that always sends hears nothing.

    Args:
        tx_burst_s: How long it sends before it listens; a silence of its own counts as listening.
        rx_window_s: How long it then listens; 0 never.
        holdoff_s: How long after others were last heard it does not begin: what they say may go on.

    Raises:
        ConfigError: A time out of range.
    """

    def __init__(self, tx_burst_s: float = 60.0, rx_window_s: float = 0.0, holdoff_s: float = 0.0) -> None:
        _check("tx_burst_s", tx_burst_s, 0.001, 86400)
        _check("rx_window_s", rx_window_s, 0, 86400)
        _check("holdoff_s", holdoff_s, 0, 86400)
        self._quiet_s = holdoff_s
        self._heard = -math.inf
        self._every_s = tx_burst_s
        self._listen_s = rx_window_s
        self._begun: float | None = None
        self._ended = -math.inf

    def wait_s(self, packet_s: float, now: float) -> float | None:
        """See `Medium.wait_s`."""
        return max(self._listening_s(now), _quiet_for_s(self._quiet_s, self._heard, now))

    def _listening_s(self, now: float) -> float:
        if self._listen_s == 0 or self._begun is None or self._ended > now:
            return 0.0  # the last: a clock that was set back must not silence the vehicle
        if now - self._ended >= self._listen_s:
            self._begun = None
            return 0.0
        if self._ended - self._begun < self._every_s:
            return 0.0
        return self._listen_s - (now - self._ended)

    def sent(self, started: float, ended: float) -> None:
        """See `Medium.sent`."""
        if self._begun is None or started - self._ended >= self._listen_s or started < self._begun:
            self._begun = started
        self._ended = ended

    def heard(self, now: float) -> None:
        """See `Medium.heard`."""
        self._heard = now


class Tdma:
    """Sends in its own slot of a frame of time (TDMA): no two stations at once, however many there are.

    Slots repeat every `tdma_cycle_s` from 1970-01-01 UTC on. The last `guard_s` of a slot are silent: they cover the
    difference between clocks and the travel time of sound.

    Args:
        tdma_cycle_s: Length of the frame.
        slot_start_s: Where in the frame the slot begins.
        slot_s: Length of the slot.
        guard_s: See above.

    Raises:
        ConfigError: A slot that does not lie within the frame, or a guard that leaves nothing of it.
    """

    def __init__(self, tdma_cycle_s: float, slot_start_s: float, slot_s: float, guard_s: float) -> None:
        _check("tdma_cycle_s", tdma_cycle_s, 0.001, 86400)
        _check("slot_start_s", slot_start_s, 0, tdma_cycle_s)
        _check("slot_s", slot_s, 0.001, tdma_cycle_s - slot_start_s)
        _check("guard_s", guard_s, 0, slot_s)
        self._frame_s = tdma_cycle_s
        self._start_s = slot_start_s
        self._usable_s = slot_s - guard_s

    def wait_s(self, packet_s: float, now: float) -> float | None:
        """See `Medium.wait_s`; None where no slot is long enough for the packet."""
        if packet_s > self._usable_s:
            return None
        into = (now - self._start_s) % self._frame_s
        if into + packet_s <= self._usable_s:
            return 0.0
        return self._frame_s - into

    def sent(self, started: float, ended: float) -> None:
        """See `Medium.sent`: the clock alone decides."""

    def heard(self, now: float) -> None:
        """See `Medium.heard`: the clock alone decides."""


class Polled:
    """Sends only when the other end asks for a packet."""

    def wait_s(self, packet_s: float, now: float) -> float | None:
        """See `Medium.wait_s`: never of its own accord."""
        return None

    def sent(self, started: float, ended: float) -> None:
        """See `Medium.sent`."""

    def heard(self, now: float) -> None:
        """See `Medium.heard`."""


class Csma:
    """Waits a random time before each packet and while others are heard (ALOHA with carrier sense).

    Waits are drawn evenly from 0 to twice their mean. For n stations with packets of length T a mean of about n T makes
    the most of the water; far below that, packets meet.

    Args:
        mean_backoff_s: Mean of the waits.
        holdoff_s: How long after others were last heard it does not begin.
        seed: Of the waits; another one for each station.

    Raises:
        ConfigError: A time out of range.
    """

    def __init__(self, mean_backoff_s: float, holdoff_s: float = 0.0, seed: int = 0) -> None:
        _check("mean_backoff_s", mean_backoff_s, 0, 86400)
        _check("holdoff_s", holdoff_s, 0, 86400)
        self._mean_s = mean_backoff_s
        self._quiet_s = holdoff_s
        self._random = random.Random(seed)  # noqa: S311 no secret
        self._not_before: float | None = None
        self._heard = -math.inf

    def wait_s(self, packet_s: float, now: float) -> float | None:
        """See `Medium.wait_s`."""
        most_s = 2 * self._mean_s
        if self._not_before is None or self._not_before - now > most_s:  # the latter: the clock was set back
            self._not_before = now + self._random.uniform(0, most_s)
        return max(0.0, self._not_before - now, _quiet_for_s(self._quiet_s, self._heard, now))

    def sent(self, started: float, ended: float) -> None:
        """See `Medium.sent`."""
        self._not_before = ended + self._random.uniform(0, 2 * self._mean_s)

    def heard(self, now: float) -> None:
        """See `Medium.heard`."""
        self._heard = now


def _quiet_for_s(holdoff_s: float, heard: float, now: float) -> float:
    """Return how much of a silence is left; none where the clock was set back."""
    return max(0.0, holdoff_s - (now - heard)) if heard <= now else 0.0


def _check(name: str, value: float, low: float, high: float) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise ConfigError(_WHERE, name, value, f"{low}..{high}")
