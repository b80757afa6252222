"""Entry of the UDP driver in the registry of drivers."""

from __future__ import annotations

from sonarpost.modem.registry import ModemDriver
from sonarpost.modem.udp.driver import UdpModem
from sonarpost.modem.udp.rates import CAPABILITIES

DRIVER = ModemDriver("udp", CAPABILITIES, UdpModem, "UDP multicast: for tests, and for radio above water")
