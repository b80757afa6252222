"""Entry of the S2C driver in the registry of drivers."""

from __future__ import annotations

from sonarpost.modem.registry import ModemDriver
from sonarpost.modem.s2c.driver import S2cModem
from sonarpost.modem.s2c.rates import CAPABILITIES

DRIVER = ModemDriver("s2c", CAPABILITIES, S2cModem, "EvoLogics S2C: instant messages and burst data")
