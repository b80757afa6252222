"""The emulated modem's stored settings and its clock."""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime, timedelta

from sonarpost.errors import SentenceError

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.]{0,39}")
_MOST_SETTINGS = 512
_FACTORY = {
    "AGC": 0, "AGN": 250, "ASD": 0, "BBD": 0, "BND": 1, "BR1": 3, "BR2": 3, "BRN": 0, "BSP": 1, "BW0": 5000,
    "CPR": 1, "CRL": 50, "CST": 1, "CTO": 10, "DBG": 0, "DGM": 0, "DOP": 0, "DQF": 0, "DTH": 108, "DTO": 2,
    "DTP": 90, "ECD": 50, "EFB": 10, "EFF": 20, "FC0": 25000, "FMD": 1, "FML": 200, "GPS": 0, "HFC": 0, "IRE": 0,
    "MCM": 1, "MFC": 0, "MFD": 0, "MOD": 0, "MPR": 1, "MSE": 0, "MVM": 1, "NDT": 150, "NPT": 50, "NRL": 25,
    "NRV": 150, "PAD": 2, "PCM": 0, "POW": -100, "PRL": 50, "PTH": 50, "PTO": 14, "REV": 1, "RXA": 1, "RXD": 1,
    "RXP": 1, "SCG": 0, "SGP": 0, "SHF": 0, "SNR": 0, "SNV": 0, "SRC": 0, "TAT": 50, "TOA": 0, "TXD": 0,
    "TXF": 1, "TXP": 1, "XST": 1,
}  # fmt: skip
# What the emulator acts on, with the values it accepts; every other name is stored and given back.
_BOUNDS = {
    "SRC": (0, 127), "DTO": (1, 100_000), "CTO": (1, 100_000), "TAT": (0, 60_000), "CST": (0, 1), "XST": (0, 1),
    "RXP": (0, 1), "RXA": (0, 1), "RXD": (0, 1), "TXP": (0, 1), "TXF": (0, 1), "REV": (0, 1), "TOA": (0, 1),
    "DQF": (0, 1),
}  # fmt: skip


class ModemSettings:
    """Named integers that survive a reboot; three-letter names are kept in capitals, as hosts write them.

    Args:
        address: Initial `SRC`. A reset returns to it (a real modem returns to 0 and has to be told again).
        data_timeout_s: Initial `DTO`.
    """

    def __init__(self, address: int, data_timeout_s: int = 2) -> None:
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
        """Return the settings with dotted names that begin with `name.`, in alphabetical order."""
        return [(stored, value) for stored, value in self.items() if stored.startswith(f"{name}.")]

    def query(self, name: str) -> tuple[str, int]:
        """Return one name, as stored, and its value.

        Raises:
            SentenceError: No such setting.
        """
        known = self._canonical(name)
        if known not in self._values:
            raise SentenceError("CCCFQ", "name", name, "a setting that was stored")
        return known, self._values[known]

    def store(self, name: str, value: int) -> None:
        """Store one setting; `ALL` with 0 resets them all.

        Raises:
            SentenceError: A name no modem has, a value out of the setting's bounds, or too many names.
        """
        if not _NAME.fullmatch(name):
            raise SentenceError("CCCFG", "name", name, "letters, digits and dots")
        known = self._canonical(name)
        if known == "ALL":
            if value != 0:
                raise SentenceError("CCCFG", "ALL", value, "0")
            self._values = dict(self._initial)
            return
        self._check(known, value)
        if known not in self._values and len(self._values) >= _MOST_SETTINGS:
            raise SentenceError("CCCFG", "name", name, f"at most {_MOST_SETTINGS} settings")
        self._values[known] = value

    @staticmethod
    def _canonical(name: str) -> str:
        return name.upper() if len(name) == 3 else name

    @staticmethod
    def _check(name: str, value: int) -> None:
        low, high = _BOUNDS.get(name, (-(2**31), 2**31 - 1))
        if not low <= value <= high:
            raise SentenceError("CCCFG", name, value, f"{low}..{high}")


class ModemClock:
    """The modem's calendar clock over simulated seconds, to the microsecond.

    The clock has a pulse at every true second. A host that sets it names the second to come, shortly after the one
    before: the clock shows that second at once and runs from the next pulse on.

    Args:
        utc_at_zero_s: Seconds since 1970 (UTC), on the true clock, when simulated time is zero.
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
        """Make the clock read `date` (UTC) from `now` to the next pulse, and run from there.

        Raises:
            SentenceError: A year that leaves no room to count on.
        """
        if not 1970 <= date.year <= 2199:
            raise SentenceError("clock", "year", date.year, "1970..2199")
        true_s = self._true_at_zero_s + now
        # A microsecond of grace: on the pulse is on the pulse, whatever the sum above was rounded to.
        self._held_until_s = now + max(0.0, math.ceil(true_s - 1e-6) - true_s)
        self._at_zero = date - timedelta(seconds=self._held_until_s)
        self.was_set = True

    @property
    def source(self) -> str:
        """Where the time comes from, as `CATMQ` and `CATMG` name it."""
        return "USER_CMD" if self.was_set else "RTC"

    def status(self, generation: int) -> str:
        """Return the clock's status as statistics carry it.

        On a Micro-Modem 2 bits 0-1 are the source of the time (1 own clock, 2 a host's command) and bits 2-4 that of
        the pulse (1 own clock); on a 1, whether a host has set it.
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
