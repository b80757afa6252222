"""Modem drivers by name: see `sonarpost.registry`. The group of entry points is `sonarpost.modems`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint
from typing import Final

from sonarpost.errors import ConfigError
from sonarpost.modem.interface import MAX_ADDRESS, MAX_FRAMES, MAX_RATE, Modem, ModemCapabilities
from sonarpost.registry import Registry, installed_points

ENTRY_POINT_GROUP: Final = "sonarpost.modems"
DEFAULT_DRIVER: Final = "micromodem"


@dataclass(frozen=True, slots=True)
class ModemSettings:
    """Settings that every driver gets.

    Attributes:
        address: Address that the modem gets.
        reply_timeout_s: Time to wait for the modem's reply before a command is sent again.
        max_carrier_sense_s: Longest time for which a busy channel delays a packet.
        stream: Whether the port is a stream, whose parts a driver of datagrams joins. Otherwise one call of `receive`
            is one datagram.
    """

    address: int
    reply_timeout_s: float = 5.0
    max_carrier_sense_s: float = 30.0
    stream: bool = False


@dataclass(frozen=True, slots=True)
class ModemDriver:
    """Entry of the registry.

    Attributes:
        name: Name in configuration files.
        capabilities: Capabilities of the modem.
        create: Creates a driver from its settings and the name of its port in errors. Raises ConfigError for settings
            that the modem does not have.
        summary: One line for people.
    """

    name: str
    capabilities: ModemCapabilities
    create: Callable[[ModemSettings, str], Modem]
    summary: str = ""


_CORE: Final = ("micromodem", "udp")
"""Drivers of the core. A module is imported when its driver is used."""


def check_capabilities(capabilities: ModemCapabilities, where: str) -> None:
    """Check that records and the link can carry the rates and addresses of a driver.

    Raises:
        ConfigError: A value out of range, or a default rate that does not exist.
    """
    for number, rate in capabilities.rates.items():
        if not 0 <= number == rate.number <= MAX_RATE:
            raise ConfigError(where, f"rates[{number}].number", rate.number, f"the key, 0..{MAX_RATE}")
        if not 1 <= rate.frames <= MAX_FRAMES:
            raise ConfigError(where, f"rates[{number}].frames", rate.frames, f"1..{MAX_FRAMES}")
        if not (rate.frame_bytes > 0 and rate.airtime_s > 0):
            raise ConfigError(where, f"rates[{number}]", rate, "a positive frame_bytes and airtime_s")
    for name, value in (("uplink_rate", capabilities.uplink_rate), ("downlink_rate", capabilities.downlink_rate)):
        if value not in capabilities.rates:
            raise ConfigError(where, name, value, f"one of {sorted(capabilities.rates)}")
    if not 0 <= capabilities.min_address <= capabilities.max_address <= MAX_ADDRESS:
        addresses = f"{capabilities.min_address}..{capabilities.max_address}"
        raise ConfigError(where, "addresses", addresses, f"within 0..{MAX_ADDRESS}")


def drivers(points: Iterable[EntryPoint]) -> Registry[ModemDriver]:
    """Return a registry of drivers; those of the core have priority."""
    return Registry(
        ENTRY_POINT_GROUP,
        "a sonarpost.modem.registry.ModemDriver with the name of the entry point",
        lambda found, name: isinstance(found, ModemDriver) and found.name == name,
        {},
        (*(EntryPoint(name, f"sonarpost.modem.{name}.driver:DRIVER", "") for name in _CORE), *points),
    )


@cache
def default_registry() -> Registry[ModemDriver]:
    """Return the drivers of this package and of the installed plug-ins."""
    return drivers(installed_points(ENTRY_POINT_GROUP))


def modem_driver(name: str = DEFAULT_DRIVER) -> ModemDriver:
    """Return a driver of the default registry; by default the one that is used without configuration.

    Raises:
        ConfigError: There is no such driver, or it cannot be imported, or its capabilities are invalid.
    """
    registry = default_registry()
    if name not in registry.names():
        raise ConfigError("[modem]", "driver", name, "one of " + ", ".join(registry.names()))
    driver = registry.get(name)
    check_capabilities(driver.capabilities, f"driver {name}")
    return driver
