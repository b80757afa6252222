"""Emulated modems by the name of their driver. The group of entry points is `sonarpost.emulated_modems`."""

from __future__ import annotations

from functools import cache
from typing import Final, Protocol

from sonarpost.extensions.simulation.channel.events import AcousticPacket, ArrivalEnded, ArrivalStarted
from sonarpost.extensions.simulation.modem.emulator import EmulatedMicroModem
from sonarpost.extensions.simulation.modem.packet_modem import PacketModem, PacketModemSettings
from sonarpost.extensions.simulation.modem.receiver import HostOutput, PacketReport
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig
from sonarpost.extensions.simulation.modem.transmitter import TravelTimes
from sonarpost.extensions.simulation.modem.udp_relay import UdpRelay
from sonarpost.registry import Registry

DEFAULT_MODEM: Final = "micromodem"

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


@cache
def packet_modems() -> Registry[type[PacketModem]]:
    """Return the emulated modems that are a `PacketModem`, by the name of their driver; see `sonarpost.registry`."""
    expected = "a subclass of sonarpost.extensions.simulation.modem.packet_modem.PacketModem"

    def is_valid(found: object, _: str) -> bool:
        return isinstance(found, type) and issubclass(found, PacketModem)

    return Registry("sonarpost.emulated_modems", expected, is_valid, {"udp": UdpRelay})


def emulated_drivers() -> tuple[str, ...]:
    """Return the names of the drivers that have an emulated modem."""
    return (DEFAULT_MODEM, *packet_modems().names())


def create_modem(settings: EmulatorSettings, travel_times: TravelTimes) -> EmulatedModem:
    """Return the modem of its settings, switched on at time zero."""
    if isinstance(settings, EmulatedModemConfig):
        return EmulatedMicroModem(settings, travel_times=travel_times)
    return packet_modems().get(settings.driver)(settings)


def settings_for(driver: str, *, address: int, **micromodem: object) -> EmulatorSettings:
    """Return the settings of a modem; those of the Micro-Modem alone are ignored for others."""
    if driver == DEFAULT_MODEM:
        return EmulatedModemConfig(address, **micromodem)  # type: ignore[arg-type]
    return PacketModemSettings(driver, address)
