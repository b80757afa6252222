"""Driver of the WHOI Micro-Modem.

`MicroModem` is the driver, `MicroModemConfig` its configuration; its events are those of `sonarpost.modem.interface`.
`RATES` holds packet size and air time of every rate. The driver does no input or output and reads no clock.
"""

from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.driver import MicroModem
from sonarpost.modem.micromodem.rates import CAPABILITIES, RATES
from sonarpost.modem.micromodem.requests import FailureReason
from sonarpost.modem.micromodem.sentences import LinkStatistics

__all__ = ["CAPABILITIES", "RATES", "FailureReason", "LinkStatistics", "MicroModem", "MicroModemConfig"]
