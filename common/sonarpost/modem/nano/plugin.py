"""Entry of the nanomodem driver in the registry of drivers."""

from __future__ import annotations

from sonarpost.modem.nano.driver import NanoModem
from sonarpost.modem.nano.rates import CAPABILITIES
from sonarpost.modem.registry import ModemDriver

DRIVER = ModemDriver("nano", CAPABILITIES, NanoModem, "nanomodem v3 (NM3): 64-byte messages and ranging")
