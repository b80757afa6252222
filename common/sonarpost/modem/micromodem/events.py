"""The driver's own events, beside those of `sonarpost.modem.interface`, and why a packet or request failed."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from sonarpost.modem.interface import ModemError, ModemEvent, PacketSent
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.sentences import ErrorReport, ModemMessage
from sonarpost.modem.micromodem.statistics import LinkStatistics, TransmitStatistics


class FailureReason(StrEnum):
    """Why a packet or request failed."""

    NO_ECHO = "no echo of the command (CACYC)"
    NO_DATA_REQUEST = "no data request for a frame (CADRQ)"
    NO_DATA_ECHO = "no confirmation of a frame's data (CATXD)"
    NO_TRANSMIT_START = "no start of the transmission (CATXP)"
    NO_TRANSMIT_END = "no end of the transmission (CATXF)"
    DATA_TIMEOUT = "the modem continued without the data of a frame"
    FRAME_REFUSED = "the modem accepts fewer bytes than the frame has"
    REBOOTED = "the modem restarted during the exchange"
    PORT_LOST = "the port to the modem was lost"
    QUEUE_FULL = "the driver's queue is full"
    NO_ANSWER = "no answer from the far modem"
    REFUSED = "the modem rejected the command"
    DEFERRED_TOO_LONG = "the modem or the channel was busy for too long"


@dataclass(frozen=True, slots=True)
class ModemMessageReceived(ModemEvent):
    """A `CAMSG` other than BAD_CRC."""

    message: ModemMessage


@dataclass(frozen=True, slots=True)
class UnhandledSentence(ModemEvent):
    """A valid sentence that the driver does not use (an unrequested setting, ranging, debugging)."""

    sentence: Sentence


@dataclass(frozen=True, slots=True)
class FrameAcknowledged(ModemEvent):
    """The far modem `src` has acknowledged a frame."""

    src: int
    dest: int
    frame_number: int


@dataclass(frozen=True, slots=True)
class StatisticsReceived(ModemEvent):
    """Link quality of an acknowledgement, a ping, a mini-packet or the header of a rate 0 packet."""

    statistics: LinkStatistics


@dataclass(frozen=True, slots=True)
class MicroModemError(ModemError):
    """The modem has reported an error (`CAERR`)."""

    report: ErrorReport


@dataclass(frozen=True, slots=True)
class MicroModemPacketSent(PacketSent):
    """A packet was transmitted.

    Attributes:
        statistics: Statistics of the transmission (`CAXST`), or None.
    """

    statistics: TransmitStatistics | None = None
