"""Emulated modems by the name of their driver."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final, Protocol

from sonarpost.extensions.simulation.channel.events import AcousticPacket, ArrivalEnded, ArrivalStarted
from sonarpost.extensions.simulation.modem.emulator import EmulatedMicroModem
from sonarpost.extensions.simulation.modem.nanomodem import EmulatedNanomodem
from sonarpost.extensions.simulation.modem.packet_modem import PacketModem, PacketModemSettings
from sonarpost.extensions.simulation.modem.receiver import HostOutput, PacketReport
from sonarpost.extensions.simulation.modem.s2c import EmulatedS2c
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig
from sonarpost.extensions.simulation.modem.transmitter import TravelTimes
from sonarpost.extensions.simulation.modem.udp_relay import UdpRelay

DEFAULT_MODEM: Final = "micromodem"

PACKET_MODEMS: Final[Mapping[str, Callable[[PacketModemSettings], PacketModem]]] = MappingProxyType(
    {"nano": EmulatedNanomodem, "s2c": EmulatedS2c, "udp": UdpRelay}
)
"""Emulated modems that are a `PacketModem`."""
EMULATED: Final = (DEFAULT_MODEM, *PACKET_MODEMS)
"""Names of the drivers that have an emulated modem."""

EmulatorSettings = EmulatedModemConfig | PacketModemSettings


class EmulatedModem(Protocol):
    """What the channel simulator needs of a modem; see `EmulatedMicroModem`."""

    @property
    def address(self) -> int:
        """The modem's address."""

    def receive(self, data: bytes, now: float) -> None:
        """Process bytes from the host."""

    def poll(self, now: float) -> None:
        """Do what is due at `now`."""

    def next_deadline_s(self) -> float:
        """Return the simulated time at which `poll` has something to do."""

    def arrival_started(self, arrival: ArrivalStarted) -> None:
        """Process the start of a packet at this modem."""

    def arrival_ended(self, arrival: ArrivalEnded) -> PacketReport:
        """Process the end of a packet at this modem."""

    def packets_to_transmit(self) -> list[AcousticPacket]:
        """Remove and return the packets whose transmission starts now."""

    def take_outputs(self) -> list[HostOutput]:
        """Remove and return the bytes for the host."""

    def host_disconnected(self) -> None:
        """Drop the unfinished input of a host that has disconnected."""


def create_modem(settings: EmulatorSettings, travel_times: TravelTimes) -> EmulatedModem:
    """Return the modem of its settings, switched on at time zero."""
    if isinstance(settings, EmulatedModemConfig):
        return EmulatedMicroModem(settings, travel_times=travel_times)
    return PACKET_MODEMS[settings.driver](settings)


def settings_for(driver: str, *, address: int, **micromodem: object) -> EmulatorSettings:
    """Return the settings of a modem; those of the Micro-Modem alone are ignored for others."""
    if driver == DEFAULT_MODEM:
        return EmulatedModemConfig(address, **micromodem)  # type: ignore[arg-type]
    return PacketModemSettings(driver, address)
