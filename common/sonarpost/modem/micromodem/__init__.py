"""Driver of the WHOI Micro-Modem.

`MicroModem` is the driver, `MicroModemConfig` its configuration, `ModemEvent` the union of the events it returns.
`RATES` holds packet size and air time of every rate. The driver does no input or output and reads no clock.
"""

from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.driver import MicroModem
from sonarpost.modem.micromodem.events import (
    CarrierSenseIgnored,
    CarrierSenseRestored,
    ClockConfirmed,
    FailureReason,
    FlexibleDataReceived,
    FrameAcknowledged,
    FrameDecoded,
    FrameReceived,
    ModemError,
    ModemEvent,
    ModemMessageReceived,
    ModemReady,
    ModemRebooted,
    ModemUnresponsive,
    PacketFailed,
    PacketReceived,
    PacketSent,
    PollReceived,
    RequestDone,
    RequestFailed,
    RestartRequested,
    SentenceRejected,
    SettingUnconfirmed,
    StatisticsReceived,
    TransmissionEnded,
    TransmissionFailing,
    TransmissionRecovered,
    TransmissionStarted,
    UnhandledSentence,
)
from sonarpost.modem.micromodem.rates import RATES, Rate
from sonarpost.modem.micromodem.sentences import (
    MiniPacketAnswered,
    MiniPacketReceived,
    PingAnswered,
    PingReceived,
)
from sonarpost.modem.micromodem.statistics import LinkStatistics, TransmitStatistics

__all__ = [
    "RATES",
    "CarrierSenseIgnored",
    "CarrierSenseRestored",
    "ClockConfirmed",
    "FailureReason",
    "FlexibleDataReceived",
    "FrameAcknowledged",
    "FrameDecoded",
    "FrameReceived",
    "LinkStatistics",
    "MicroModem",
    "MicroModemConfig",
    "MiniPacketAnswered",
    "MiniPacketReceived",
    "ModemError",
    "ModemEvent",
    "ModemMessageReceived",
    "ModemReady",
    "ModemRebooted",
    "ModemUnresponsive",
    "PacketFailed",
    "PacketReceived",
    "PacketSent",
    "PingAnswered",
    "PingReceived",
    "PollReceived",
    "Rate",
    "RequestDone",
    "RequestFailed",
    "RestartRequested",
    "SentenceRejected",
    "SettingUnconfirmed",
    "StatisticsReceived",
    "TransmissionEnded",
    "TransmissionFailing",
    "TransmissionRecovered",
    "TransmissionStarted",
    "TransmitStatistics",
    "UnhandledSentence",
]
