"""Carrier sense: whether the driver may start a transmission, and the upper limit of the wait for a free channel."""

from __future__ import annotations

from sonarpost.modem.interface import CarrierSenseIgnored, CarrierSenseRestored, ModemEvent
from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.sentences import TransmitMark


class CarrierSense:
    """Follows how long the channel has been busy without a pause.

    The channel is busy during a reception, and during a transmission that this driver did not start. A modem that
    reports receptions without an end must not stop the driver: after `max_carrier_sense_s` without a pause the driver
    transmits. It defers again after the next pause.
    """

    def __init__(self, config: MicroModemConfig) -> None:
        self._config = config
        self._transmitting_until_s: float | None = None
        self._busy_since_s: float | None = None
        self._ignored = False

    @property
    def channel_free(self) -> bool:
        """Whether the driver may start a transmission."""
        return self._busy_since_s is None or self._ignored

    @property
    def deadline_s(self) -> float | None:
        """When `update` has something to do, or None."""
        limit_s = None
        if self._busy_since_s is not None and not self._ignored:
            limit_s = self._busy_since_s + self._config.max_carrier_sense_s
        return min((time_s for time_s in (self._transmitting_until_s, limit_s) if time_s is not None), default=None)

    def on_transmission(self, mark: TransmitMark, now: float) -> None:
        """Process the start or the end of a transmission that this driver did not start."""
        self._transmitting_until_s = None if mark.ends else now + self._config.on_air_limit_s(None)

    def update(self, now: float, *, receiving: bool) -> list[ModemEvent]:
        """Compare the state of the channel with the limit; call after every change and at `deadline_s`.

        Args:
            now: Time on the driver's clock.
            receiving: Whether a packet is being received.
        """
        if self._transmitting_until_s is not None and now >= self._transmitting_until_s:
            self._transmitting_until_s = None
        if not receiving and self._transmitting_until_s is None:
            return self.reset(now)
        if self._busy_since_s is None:
            self._busy_since_s = now
        # Compared as in `deadline_s`, so that the call at that time has an effect.
        if self._ignored or now < self._busy_since_s + self._config.max_carrier_sense_s:
            return []
        self._ignored = True
        return [CarrierSenseIgnored(now - self._busy_since_s)]

    def reset(self, now: float) -> list[ModemEvent]:
        """Record that the channel is free."""
        since_s, was_ignored = self._busy_since_s, self._ignored
        self._transmitting_until_s = self._busy_since_s = None
        self._ignored = False
        return [CarrierSenseRestored(now - since_s)] if since_s is not None and was_ignored else []
