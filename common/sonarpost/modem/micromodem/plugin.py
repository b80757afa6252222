"""Entry of the Micro-Modem in the registry of drivers."""

from __future__ import annotations

from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.driver import MicroModem
from sonarpost.modem.micromodem.rates import CAPABILITIES
from sonarpost.modem.registry import ModemDriver, ModemSettings


def _create(settings: ModemSettings, where: str) -> MicroModem:
    config = MicroModemConfig(
        settings.address,
        reply_timeout_s=settings.reply_timeout_s,
        max_carrier_sense_s=settings.max_carrier_sense_s,
    )
    return MicroModem(config, where)


DRIVER = ModemDriver("micromodem", CAPABILITIES, _create, "WHOI Micro-Modem 1 and 2, on a serial line")
