"""Medium access of the vessel: modems are half-duplex, so each sent packet can cost a received one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from sonarpost.services.op_modem.config import OpModemConfig

_PACKET_MARGIN_S = 1.0
_WAIT_AFTER_FAILURE_S = 2.0


@dataclass
class TransmitGate:
    """Decides when the vessel may transmit. `now_s` is monotonic time in seconds.

    Attributes:
        config: Configuration of op_modem.
        last_frame_s: Time of the last received frame.
        pending_since_s: Since when a packet is pending, None while none is.
        not_before_s: End of the wait after the modem failed to send.
        polled_s: Time of the last poll.
    """

    config: OpModemConfig
    last_frame_s: float = -math.inf
    pending_since_s: float | None = None
    not_before_s: float = -math.inf
    polled_s: float = -math.inf
    _next_vehicle: int = field(default=0, repr=False)

    def frame_received(self, now_s: float) -> None:
        """Record that a frame was received."""
        self.last_frame_s = now_s

    def failed(self, now_s: float) -> None:
        """Record that the modem failed to send."""
        self.not_before_s = now_s + _WAIT_AFTER_FAILURE_S

    def may_transmit(self, now_s: float, utc_s: float, *, receiving: bool, pending: bool) -> bool:
        """Return whether a packet may be sent now.

        Args:
            now_s: Monotonic time.
            utc_s: UTC in seconds, for TDMA.
            receiving: Whether a packet is being received.
            pending: Whether a packet is pending.
        """
        if not pending:
            self.pending_since_s = None
            return False
        if self.pending_since_s is None:
            self.pending_since_s = now_s
        if receiving or now_s < self.not_before_s:
            return False
        if self.config.mac != "csma":
            return self.is_free(now_s, utc_s, receiving=receiving)
        return self._is_idle(now_s) or now_s - self.pending_since_s >= self.config.max_defer_s

    def is_free(self, now_s: float, utc_s: float, *, receiving: bool) -> bool:
        """Return whether the vessel may transmit now without a wait that is limited by `max_defer_s`.

        Args:
            now_s: Monotonic time.
            utc_s: UTC in seconds, for TDMA.
            receiving: Whether a packet is being received.
        """
        if receiving or now_s < self.not_before_s:
            return False
        if self.config.mac == "tdma":
            packet_s = self.config.rate_info(self.config.downlink_rate).airtime_s
            slots = self.config.slots()
            # The margin covers the start of the modem; a slot that is too short for it is used without.
            wait_s = slots.wait_s(packet_s + _PACKET_MARGIN_S, utc_s)
            return (slots.wait_s(packet_s, utc_s) if wait_s is None else wait_s) == 0.0
        return self.config.mac == "polled" or self._is_idle(now_s)

    def _is_idle(self, now_s: float) -> bool:
        """Return whether no frame was received for `holdoff_s`."""
        return now_s - self.last_frame_s >= self.config.holdoff_s

    def vehicle_to_poll(self, now_s: float, addresses: Sequence[int]) -> int | None:
        """Return the modem address to poll now, None for none."""
        if self.config.mac != "polled" or not addresses or now_s - self.polled_s < self.config.poll_interval_s:
            return None
        self.polled_s = now_s
        address = addresses[self._next_vehicle % len(addresses)]
        self._next_vehicle += 1
        return address
