"""Configuration, stored settings and clock of the emulated modem."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from types import MappingProxyType

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem import RATES
from sonarpost.modem.registry import DEFAULT_DRIVER

FIRMWARE_VERSIONS: Mapping[int, str] = MappingProxyType({1: "0.93.0.09", 2: "2.0.27087"})
"""Version in `CAREV` by generation: four parts for the first, three for the second."""

REVISION_PERIOD_S = 10.0
"""Idle time before and between `CAREV,…,AUV`."""
REBOOT_S = 1.0
"""Time from `CCMSC` to `CAREV,…,INIT`."""
MINI_AIRTIME_S = 0.9
"""Air time of an acknowledgement, a ping or a mini-packet."""
TURNAROUND_S = 0.2
"""Time from the end of a packet to the automatic reply."""
BROADCAST_ADDRESSES = frozenset({0, 15, 127})
"""Destinations that address every modem."""

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.]{0,39}")
_MAX_SETTINGS = 512
_FACTORY = {
    "AGC": 0, "AGN": 250, "ASD": 0, "BBD": 0, "BND": 1, "BR1": 3, "BR2": 3, "BRN": 0, "BSP": 1, "BW0": 5000,
    "CPR": 1, "CRL": 50, "CST": 1, "CTO": 10, "DBG": 0, "DGM": 0, "DOP": 0, "DQF": 0, "DTH": 108, "DTO": 2,
    "DTP": 90, "ECD": 50, "EFB": 10, "EFF": 20, "FC0": 25000, "FMD": 1, "FML": 200, "GPS": 0, "HFC": 0, "IRE": 0,
    "MCM": 1, "MFC": 0, "MFD": 0, "MOD": 0, "MPR": 1, "MSE": 0, "MVM": 1, "NDT": 150, "NPT": 50, "NRL": 25,
    "NRV": 150, "PAD": 2, "PCM": 0, "POW": -100, "PRL": 50, "PTH": 50, "PTO": 14, "REV": 1, "RXA": 1, "RXD": 1,
    "RXP": 1, "SCG": 0, "SGP": 0, "SHF": 0, "SNR": 0, "SNV": 0, "SRC": 0, "TAT": 50, "TOA": 0, "TXD": 0,
    "TXF": 1, "TXP": 1, "XST": 1,
}  # fmt: skip
# The settings that the emulator acts on, with their bounds. Every other name is stored and returned.
_BOUNDS = {
    "SRC": (0, 127), "DTO": (1, 100_000), "CTO": (1, 100_000), "TAT": (0, 60_000), "CST": (0, 1), "XST": (0, 1),
    "RXP": (0, 1), "RXA": (0, 1), "RXD": (0, 1), "TXP": (0, 1), "TXF": (0, 1), "REV": (0, 1), "TOA": (0, 1),
    "DQF": (0, 1),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class EmulatedModemConfig:
    """Configuration of one emulated modem; that of another driver than the Micro-Modem's has only an address.

    Attributes:
        address: Its address; the initial `SRC`.
        generation: 1 or 2: version strings, and whether flexible data is supported.
        statistics_version: Layout of `CACST`: 6, which every known host reads, or 8 of the newest firmware.
        utc_at_zero_s: Reading of the modem's clock at simulated time zero, seconds since 1970 UTC.
        airtimes_s: Air times by rate number, where they differ from the nominal ones.
        data_timeout_s: Initial `DTO`, whole seconds.
        promiscuous: Whether the host receives data addressed to other modems.
        driver: Name of its driver.
    """

    address: int
    generation: int = 2
    statistics_version: int = 6
    utc_at_zero_s: float = 0.0
    airtimes_s: Mapping[int, float] = field(default_factory=lambda: MappingProxyType({}))
    data_timeout_s: int = 2
    promiscuous: bool = True
    driver: str = DEFAULT_DRIVER

    def airtime_s(self, rate: int) -> float:
        """Return the air time of a data packet of `rate`."""
        return self.airtimes_s.get(rate, RATES[rate].airtime_s)


class NvramSettings:
    """Named integers that survive a reboot. Names of three letters are stored in capitals, as hosts write them.

    Args:
        address: Initial `SRC`. A reset restores it, while a real modem returns to 0.
        data_timeout_s: Initial `DTO`.
    """

    def __init__(self, address: int, data_timeout_s: int) -> None:
        self._initial = {**_FACTORY, "SRC": address, "DTO": data_timeout_s}
        for name in ("SRC", "DTO"):
            self._check(name, self._initial[name])
        self._values = dict(self._initial)

    def __getitem__(self, name: str) -> int:
        return self._values[name]

    def on(self, name: str) -> bool:
        """Return whether a switch is on."""
        return self._values[name] != 0

    def items(self) -> list[tuple[str, int]]:
        """Return every name and value in alphabetical order."""
        return sorted(self._values.items())

    def group(self, name: str) -> list[tuple[str, int]]:
        """Return the settings whose dotted names begin with `name.`, in alphabetical order."""
        return [(stored, value) for stored, value in self.items() if stored.startswith(f"{name}.")]

    def stored(self, name: str) -> tuple[str, int]:
        """Return the stored form of a name, and its value.

        Raises:
            SentenceError: No such setting.
        """
        stored = self._canonical(name)
        if stored not in self._values:
            raise SentenceError("CCCFQ", "name", name, "a setting that was stored")
        return stored, self._values[stored]

    def store(self, name: str, value: int) -> None:
        """Store one setting; `ALL` with 0 resets all of them.

        Raises:
            SentenceError: An invalid name, a value out of the setting's bounds, or too many names.
        """
        if not _NAME.fullmatch(name):
            raise SentenceError("CCCFG", "name", name, "letters, digits and dots")
        stored = self._canonical(name)
        if stored == "ALL":
            if value != 0:
                raise SentenceError("CCCFG", "ALL", value, "0")
            self._values = dict(self._initial)
            return
        self._check(stored, value)
        if stored not in self._values and len(self._values) >= _MAX_SETTINGS:
            raise SentenceError("CCCFG", "name", name, f"at most {_MAX_SETTINGS} settings")
        self._values[stored] = value

    @staticmethod
    def _canonical(name: str) -> str:
        return name.upper() if len(name) == 3 else name

    @staticmethod
    def _check(name: str, value: int) -> None:
        low, high = _BOUNDS.get(name, (-(2**31), 2**31 - 1))
        if not low <= value <= high:
            raise SentenceError("CCCFG", name, value, f"{low}..{high}")


class ModemClock:
    """Calendar clock of the modem over simulated seconds, to the microsecond.

    The clock has a pulse at every true second. A host sets it to the next second, shortly after the previous one. The
    clock shows that second at once and runs from the next pulse on.
    """

    def __init__(self, utc_at_zero_s: float) -> None:
        self._true_at_zero_s = utc_at_zero_s
        self._at_zero = datetime.fromtimestamp(utc_at_zero_s, UTC)
        self._held_until_s = -math.inf
        self.was_set = False

    def at(self, now: float) -> datetime:
        """Return the date and time at simulated second `now`."""
        return self._at_zero + timedelta(seconds=max(now, self._held_until_s))

    def set(self, date: datetime, now: float) -> None:
        """Set the clock to `date` (UTC): it holds this value from `now` to the next pulse and then runs.

        Raises:
            SentenceError: A year outside 1970..2199.
        """
        if not 1970 <= date.year <= 2199:
            raise SentenceError("clock", "year", date.year, "1970..2199")
        true_s = self._true_at_zero_s + now
        # One microsecond of tolerance for the rounding of the sum above.
        self._held_until_s = now + max(0.0, math.ceil(true_s - 1e-6) - true_s)
        self._at_zero = date - timedelta(seconds=self._held_until_s)
        self.was_set = True

    @property
    def source(self) -> str:
        """Source of the time as named in `CATMQ` and `CATMG`."""
        return "USER_CMD" if self.was_set else "RTC"

    def status(self, generation: int) -> str:
        """Return the clock status as statistics carry it.

        On a Micro-Modem 2 bits 0-1 are the source of the time (1 own clock, 2 a host's command) and bits 2-4 the source
        of the pulse (1 own clock). On a Micro-Modem 1 it is 1 when a host has set the clock.
        """
        if generation == 1:
            return str(int(self.was_set))
        return f"{(2 if self.was_set else 1) | 1 << 2:02d}"

    def hhmmss(self, now: float) -> str:
        """Return the time of day as most sentences carry it."""
        return self.at(now).strftime("%H%M%S")

    def iso(self, now: float) -> str:
        """Return date and time as `CATMS` and `CATMQ` carry them, for example 2019-12-02T03:02:59Z."""
        return self.at(now).strftime("%Y-%m-%dT%H:%M:%SZ")
