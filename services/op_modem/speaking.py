"""When the vessel speaks: modems are half-duplex, so every packet that is sent may cost one that is not heard."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from sonarpost.modem.micromodem import RATES
from sonarpost.services.op_modem.config import OpModemConfig

_PACKET_MARGIN_S = 1.0
_WAIT_AFTER_FAILURE_S = 2.0


@dataclass
class TransmitGate:
    """Knows when it is the vessel's turn. All times in seconds of one clock, `utc_s` of slots apart.

    Attributes:
        config: The service's.
        heard_s: When something was heard last.
        wanted_since_s: Since when there is something to say, None while there is not.
        not_before_s: No packet before this, because the modem failed to send one.
        polled_s: When a vehicle was polled last.
    """

    config: OpModemConfig
    heard_s: float = -math.inf
    wanted_since_s: float | None = None
    not_before_s: float = -math.inf
    polled_s: float = -math.inf
    _next_vehicle: int = field(default=0, repr=False)

    def heard(self, now_s: float) -> None:
        """Note that something was heard."""
        self.heard_s = now_s

    def failed(self, now_s: float) -> None:
        """Note that the modem did not send."""
        self.not_before_s = now_s + _WAIT_AFTER_FAILURE_S

    def may_speak(self, now_s: float, utc_s: float, *, receiving: bool, wanted: bool) -> bool:
        """Whether a packet may be sent now.

        Args:
            now_s: Monotonic.
            utc_s: For slots.
            receiving: Whether a packet is arriving.
            wanted: Whether there is something to say.
        """
        if not wanted:
            self.wanted_since_s = None
            return False
        if self.wanted_since_s is None:
            self.wanted_since_s = now_s
        if receiving or now_s < self.not_before_s:
            return False
        if self.config.mac == "tdma":
            packet_s = RATES[self.config.downlink_rate].airtime_s
            slots = self.config.slots()
            # The margin for the modem's own start is given up where the slot has no room for it.
            wait_s = slots.wait_s(packet_s + _PACKET_MARGIN_S, utc_s)
            return (slots.wait_s(packet_s, utc_s) if wait_s is None else wait_s) == 0.0
        if self.config.mac == "polled":
            return True
        quiet = now_s - self.heard_s >= self.config.holdoff_s
        return quiet or now_s - self.wanted_since_s >= self.config.max_defer_s

    def vehicle_to_poll(self, now_s: float, addresses: Sequence[int]) -> int | None:
        """Return the vehicle whose turn it is to be asked for a packet, None for none now."""
        if self.config.mac != "polled" or not addresses or now_s - self.polled_s < self.config.poll_interval_s:
            return None
        self.polled_s = now_s
        address = addresses[self._next_vehicle % len(addresses)]
        self._next_vehicle += 1
        return address
