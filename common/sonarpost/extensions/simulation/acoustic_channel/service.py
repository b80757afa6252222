"""Runs a `ChannelEmulator` beside the other services.

The emulator, `sonarpost.extensions.simulation.channel.emulator.ChannelEmulator`, needs neither this process nor Zenoh.
"""

import logging
from collections.abc import Mapping

from typing_extensions import override

from sonarpost.config import PlatformConfig
from sonarpost.extensions.simulation.acoustic_channel.config import AcousticChannelConfig
from sonarpost.extensions.simulation.channel.emulator import ChannelEmulator
from sonarpost.logs import kv
from sonarpost.messages import Record
from sonarpost.runtime.service import Service, UnitOfWork

log = logging.getLogger(__name__)

WATCH_S = 0.2


class AcousticChannelService(Service[AcousticChannelConfig]):
    """Provides emulated Micro-Modems on pseudo-terminals or TCP ports.

    The ports are open from the start of the process, also without a router, which the modems do not need.
    """

    NAME = "acoustic_channel"

    def __init__(self, platform: PlatformConfig, config: AcousticChannelConfig) -> None:
        super().__init__(platform, config)
        try:
            self._emulator = ChannelEmulator(config)
            self._emulator.start()
        except BaseException:
            self.store.close()
            raise
        for device in self._emulator.devices():
            log.info("Modem ready", extra=kv(modem=device.modem, address=device.address, device=device.device))

    @override
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Reject any record: this service consumes none."""
        raise NotImplementedError(f"acoustic_channel consumes no records, got one on {key}")

    @override
    def on_start(self) -> None:
        """Watch the emulator: the service fails when the emulator fails."""
        self.start_thread(self._watch, "watch")

    @override
    def gauges(self) -> Mapping[str, float]:
        """Return the counts of packets and frames, and the number of connected hosts."""
        totals = self._emulator.totals()
        return {
            "modems_connected": float(self._emulator.connected()),
            "packets_transmitted": float(totals.transmitted),
            "packets_heard": float(totals.reported),
            "packets_not_heard": float(sum(totals.unreported.values())),
            **{f"frames_{outcome}": float(count) for outcome, count in totals.frames.items()},
        }

    @override
    def stop(self) -> None:
        """Stop the service, then the emulator, which writes its totals."""
        super().stop()
        self._emulator.stop()

    def _watch(self) -> None:
        while not self.stopping.wait(WATCH_S):
            if self._emulator.failure is not None:
                raise self._emulator.failure
