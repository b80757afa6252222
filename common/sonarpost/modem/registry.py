"""Modem drivers by name.

`BUILTINS` names the drivers of this package. Another distribution adds drivers through the entry-point group
`sonarpost.modems`: the entry point loads a `ModemDriver` with the name of the entry point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType
from typing import Final

from sonarpost.errors import ConfigError
from sonarpost.modem.interface import MAX_ADDRESS, MAX_FRAMES, MAX_RATE, Modem, ModemCapabilities

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


BUILTINS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "micromodem": "sonarpost.modem.micromodem.plugin",
        "nano": "sonarpost.modem.nano.plugin",
        "s2c": "sonarpost.modem.s2c.plugin",
        "udp": "sonarpost.modem.udp.plugin",
    }
)
"""Drivers of this package: the module whose `DRIVER` is the entry. A module is imported when its driver is used."""


class ModemRegistry:
    """Drivers by name.

    Args:
        builtins: As `BUILTINS`.
        plugins: Entry points of other distributions.

    Raises:
        ConfigError: An entry point has the name of another driver.
    """

    def __init__(self, builtins: Mapping[str, str] = BUILTINS, plugins: Iterable[EntryPoint] = ()) -> None:
        self._builtins = dict(builtins)
        self._plugins: dict[str, EntryPoint] = {}
        for point in plugins:
            if point.name in self._builtins or point.name in self._plugins:
                raise ConfigError(f"entry point {ENTRY_POINT_GROUP}", "name", point.name, "a name that is not taken")
            self._plugins[point.name] = point

    def names(self) -> tuple[str, ...]:
        """Return the names, sorted."""
        return tuple(sorted({*self._builtins, *self._plugins}))

    def driver(self, name: str) -> ModemDriver:
        """Return a driver.

        Raises:
            ConfigError: No driver has this name, or the entry point of the driver is invalid.
        """
        if name in self._builtins:
            driver: object = import_module(self._builtins[name]).DRIVER
            where = f"driver {name}"
        elif name in self._plugins:
            where = f"entry point {ENTRY_POINT_GROUP}:{name}"
            try:
                driver = self._plugins[name].load()
            except Exception as error:  # foreign code can raise any exception; the message names the entry point
                value = f"{self._plugins[name].value} ({error!r})"
                raise ConfigError(where, "value", value, "an object that imports") from error
        else:
            raise ConfigError("[modem]", "driver", name, "one of " + ", ".join(self.names()))
        if not isinstance(driver, ModemDriver):
            raise ConfigError(where, "value", repr(driver), "a sonarpost.modem.registry.ModemDriver")
        if driver.name != name:
            raise ConfigError(where, "name", driver.name, f"{name!r}, the name in the registry")
        check_capabilities(driver.capabilities, where)
        return driver


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


@cache
def default_registry() -> ModemRegistry:
    """Return the registry with the drivers of this package and of the installed plug-ins.

    Raises:
        ConfigError: Two drivers have the same name.
    """
    return ModemRegistry(plugins=sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda p: (p.name, p.value)))


@cache
def modem_driver(name: str = DEFAULT_DRIVER) -> ModemDriver:
    """Return a driver of the default registry; by default the one that is used without configuration.

    Raises:
        ConfigError: See `ModemRegistry.driver`.
    """
    return default_registry().driver(name)
