"""Runs the emulated modems and their water beside the other services.

The channel itself, `sonarpost.simulation.channel.emulator.AcousticChannel`, needs neither this process nor Zenoh.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping

from sonarpost.config import PlatformConfig
from sonarpost.logs import kv
from sonarpost.messages import Record
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.services.acoustic_channel.config import AcousticChannelConfig
from sonarpost.simulation.channel.emulator import ChannelEmulator

__all__ = ["AcousticChannelService", "ChannelEmulator"]

log = logging.getLogger(__name__)

WATCH_S = 0.2


class AcousticChannelService(Service[AcousticChannelConfig]):
    """Offers emulated Micro-Modems in one simulated water on pseudo-terminals or TCP ports.

    The ports are open from the moment the process starts, whether or not a router is there: modems need none.
    """

    NAME = "acoustic_channel"

    def __init__(self, platform: PlatformConfig, config: AcousticChannelConfig) -> None:
        super().__init__(platform, config)
        self._channel = ChannelEmulator(config.channel())
        try:
            self._channel.start()
        except BaseException:
            self.store.close()
            raise
        for device in self._channel.devices():
            log.info("Modem ready", extra=kv(modem=device.modem, address=device.address, device=device.device))

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Never called, as this service consumes no records."""
        raise NotImplementedError(f"acoustic_channel consumes no records, and got one on {key}")

    def on_start(self) -> None:
        """Watch the channel: when it fails, so does the service."""
        self.start_thread(self._watch, "watch")

    def gauges(self) -> Mapping[str, float]:
        """Return what the water did so far, and how many modems have a host."""
        totals = self._channel.totals()
        return {
            "modems_connected": float(self._channel.connected()),
            "packets_transmitted": float(totals.transmitted),
            "packets_heard": float(totals.heard),
            "packets_not_heard": float(sum(totals.not_heard.values())),
            **{f"frames_{fate}": float(count) for fate, count in totals.frames.items()},
        }

    def stop(self) -> None:
        """Stop the channel, which writes its totals, then the service."""
        super().stop()
        self._channel.stop()

    def _watch(self) -> None:
        while not self.stopping.wait(WATCH_S):
            if self._channel.failure is not None:
                raise self._channel.failure
