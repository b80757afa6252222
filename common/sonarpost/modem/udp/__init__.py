"""Driver without a modem: packets as UDP multicast datagrams, for tests and for radio above water.

`UdpModem` is the driver; `sonarpost.modem.udp.datagram` has the format of the datagrams.
"""

from sonarpost.modem.udp.driver import UdpModem
from sonarpost.modem.udp.rates import CAPABILITIES, RATES

__all__ = ["CAPABILITIES", "RATES", "UdpModem"]
