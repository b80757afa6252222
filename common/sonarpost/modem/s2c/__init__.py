"""Driver of the EvoLogics S2C modems: instant messages and burst data through their AT commands.

`S2cModem` is the driver; `sonarpost.modem.s2c.messages` parses what the modem sends.
"""

from sonarpost.modem.s2c.driver import S2cModem
from sonarpost.modem.s2c.events import UsblPosition
from sonarpost.modem.s2c.rates import CAPABILITIES, RATES

__all__ = ["CAPABILITIES", "RATES", "S2cModem", "UsblPosition"]
