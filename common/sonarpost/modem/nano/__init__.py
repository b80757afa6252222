"""Driver of the nanomodem v3 (NM3) of Newcastle University and of modems with its command set.

`NanoModem` is the driver; `sonarpost.modem.nano.messages` has the messages between host and modem.
"""

from sonarpost.modem.nano.driver import NanoModem
from sonarpost.modem.nano.rates import CAPABILITIES, RATES

__all__ = ["CAPABILITIES", "RATES", "NanoModem"]
