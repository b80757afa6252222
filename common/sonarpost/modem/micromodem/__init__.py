"""Driver of the WHOI Micro-Modem.

`MicroModem` is the driver, `MicroModemConfig` its configuration; its events are those of `sonarpost.modem.interface`
and those below. `RATES` holds packet size and air time of every rate. The driver does no input or output and reads no
clock.
"""

from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.driver import MicroModem
from sonarpost.modem.micromodem.events import (
    FailureReason,
    FrameAcknowledged,
    MicroModemError,
    MicroModemPacketSent,
    ModemMessageReceived,
    StatisticsReceived,
    UnhandledSentence,
)
from sonarpost.modem.micromodem.rates import CAPABILITIES, RATES
from sonarpost.modem.micromodem.sentences import (
    MiniPacketAnswered,
    MiniPacketReceived,
    PingAnswered,
    PingReceived,
)
from sonarpost.modem.micromodem.statistics import LinkStatistics, TransmitStatistics

__all__ = [
    "CAPABILITIES",
    "RATES",
    "FailureReason",
    "FrameAcknowledged",
    "LinkStatistics",
    "MicroModem",
    "MicroModemConfig",
    "MicroModemError",
    "MicroModemPacketSent",
    "MiniPacketAnswered",
    "MiniPacketReceived",
    "ModemMessageReceived",
    "PingAnswered",
    "PingReceived",
    "StatisticsReceived",
    "TransmitStatistics",
    "UnhandledSentence",
]
