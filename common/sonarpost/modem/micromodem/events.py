"""Events of the driver: frozen records, returned in order of time.

`src` and `dest` are modem addresses, `peer` is the address of the other modem, and `rate` is a rate number; None where
unknown. `packet_id` and `request_id` are the numbers returned when the packet or request was queued. Times (`_s`) are
seconds on the driver's clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.sentences import (
    ErrorReport,
    MiniPacketAnswered,
    MiniPacketReceived,
    ModemMessage,
    PingAnswered,
    PingReceived,
    ReceivedFlexibleData,
)
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
class ModemReady:
    """The modem has confirmed its address and settings.

    Attributes:
        firmware: Version from its last `CAREV`, or None.
    """

    address: int
    firmware: str | None


@dataclass(frozen=True, slots=True)
class ModemUnresponsive:
    """The modem does not answer. Reported once until the next `ModemReady`; the driver keeps trying.

    Attributes:
        waiting_for: The command without a correct answer.
        attempts: How often it was sent.
        silent_s: Time since the last valid sentence, None when there was none yet.
    """

    waiting_for: str
    attempts: int
    silent_s: float | None


@dataclass(frozen=True, slots=True)
class ModemRebooted:
    """The modem has restarted; the driver configures it again."""

    firmware: str


@dataclass(frozen=True, slots=True)
class TransmissionStarted:
    """The modem has begun to transmit: a packet, a request or an automatic reply.

    Attributes:
        airtime_s: Nominal duration.
    """

    airtime_s: float


@dataclass(frozen=True, slots=True)
class TransmissionEnded:
    """The modem has ended a transmission. The report of its start may have been lost.

    Attributes:
        airtime_s: Nominal duration.
    """

    airtime_s: float


@dataclass(frozen=True, slots=True)
class TransmissionFailing:
    """The modem answers, but several packets in a row have failed. Reported once until `TransmissionRecovered`.

    Attributes:
        failures: Number of failed packets and polls in a row.
        reason: Why the last one failed.
    """

    failures: int
    reason: FailureReason


@dataclass(frozen=True, slots=True)
class TransmissionRecovered:
    """The modem transmits again.

    Attributes:
        failures: Number of packets and polls that failed before.
        failing_s: Time since the first of them.
    """

    failures: int
    failing_s: float


@dataclass(frozen=True, slots=True)
class RestartRequested:
    """The driver has sent the command to restart (`CCMSC`), because the modem does not transmit."""


@dataclass(frozen=True, slots=True)
class CarrierSenseIgnored:
    """The modem has reported a busy channel for too long; the driver transmits in spite of it.

    Attributes:
        busy_s: How long the channel has been busy without a pause.
    """

    busy_s: float


@dataclass(frozen=True, slots=True)
class CarrierSenseRestored:
    """The modem reports a free channel again, and the driver defers to receptions.

    Attributes:
        busy_s: How long the channel was busy without a pause.
    """

    busy_s: float


@dataclass(frozen=True, slots=True)
class SettingUnconfirmed:
    """The modem did not confirm an optional setting or the clock; the driver continues without."""

    command: str


@dataclass(frozen=True, slots=True)
class ClockConfirmed:
    """The modem has confirmed the time that was set."""

    utc: datetime


@dataclass(frozen=True, slots=True)
class ModemError:
    """The modem has reported an error (`CAERR`)."""

    report: ErrorReport


@dataclass(frozen=True, slots=True)
class ModemMessageReceived:
    """A `CAMSG` other than BAD_CRC."""

    message: ModemMessage


@dataclass(frozen=True, slots=True)
class SentenceRejected:
    """Bytes that are not a valid sentence, or a sentence with a wrong field."""

    error: SentenceError


@dataclass(frozen=True, slots=True)
class UnhandledSentence:
    """A valid sentence that the driver does not use (an unrequested setting, ranging, debugging)."""

    sentence: Sentence


@dataclass(frozen=True, slots=True)
class PacketSent:
    """A packet was transmitted.

    Attributes:
        acknowledged: Numbers (from 1) of the frames that the far modem has acknowledged; empty without `ack`.
        started_s: Start of the cycle.
        finished_s: End of the cycle.
        statistics: Statistics of the transmission, or None.
        end_reported: Whether the modem has reported the end of the transmission. If not, it has accepted the data, the
            air time has passed, and the modem answers.
    """

    packet_id: int
    dest: int
    rate: int
    frames: tuple[bytes, ...]
    acknowledged: tuple[int, ...]
    started_s: float
    finished_s: float
    statistics: TransmitStatistics | None
    end_reported: bool = True


@dataclass(frozen=True, slots=True)
class PacketFailed:
    """A packet was not transmitted, or the driver cannot determine whether it was.

    Attributes:
        maybe_sent: Whether all or part of it may have been transmitted.
    """

    packet_id: int
    dest: int
    rate: int
    frames: tuple[bytes, ...]
    reason: FailureReason
    maybe_sent: bool


@dataclass(frozen=True, slots=True)
class FrameReceived:
    """One good frame. A modem may have padded the data of a short frame.

    Attributes:
        dest: Destination address, possibly of another modem.
        frame_number: From 1.
        received_s: Time of reception.
        statistics: Statistics of its packet, None when the modem did not report them.
    """

    src: int
    dest: int
    ack: bool
    frame_number: int
    data: bytes
    received_s: float
    rate: int | None
    statistics: LinkStatistics | None


@dataclass(frozen=True, slots=True)
class FrameDecoded:
    """A good frame of a packet that may not be complete yet, so that it can be stored at once.

    The same frame follows as `FrameReceived` at the end of its packet.
    """

    frame: FrameReceived


@dataclass(frozen=True, slots=True)
class PacketReceived:
    """The end of a received packet; its `FrameReceived` events come just before.

    Attributes:
        bad_frames: Number of frames that the modem reported as damaged.
        nframes: Number of frames in the packet, None when unknown.
        statistics: None when the modem did not report them.
        complete: Whether all announced frames were received and the modem reported the end of the packet.
    """

    frames: tuple[FrameReceived, ...]
    bad_frames: int
    nframes: int | None
    src: int | None
    dest: int | None
    rate: int | None
    statistics: LinkStatistics | None
    complete: bool


@dataclass(frozen=True, slots=True)
class FrameAcknowledged:
    """The far modem `src` has acknowledged a frame."""

    src: int
    dest: int
    frame_number: int


@dataclass(frozen=True, slots=True)
class StatisticsReceived:
    """Link quality of an acknowledgement, a ping, a mini-packet or the header of a rate 0 packet."""

    statistics: LinkStatistics


@dataclass(frozen=True, slots=True)
class RequestDone:
    """A ping or mini-packet was answered, flexible data was transmitted, or a polled modem has sent its packet.

    Attributes:
        kind: "ping", "mini-packet", "flexible data" or "poll".
    """

    request_id: int
    kind: str
    peer: int


@dataclass(frozen=True, slots=True)
class RequestFailed:
    """A request failed; it may have been transmitted."""

    request_id: int
    kind: str
    peer: int
    reason: FailureReason


@dataclass(frozen=True, slots=True)
class FlexibleDataReceived:
    """A packet of the flexible data protocol."""

    packet: ReceivedFlexibleData
    received_s: float


@dataclass(frozen=True, slots=True)
class PollReceived:
    """Another modem requests a packet of at most `frames` frames; `PacketSent` or `PacketFailed` reports the result."""

    dest: int
    rate: int
    frames: int
    frame_bytes: int
    ack: bool


ModemEvent = (
    ModemReady
    | ModemUnresponsive
    | ModemRebooted
    | TransmissionStarted
    | TransmissionEnded
    | TransmissionFailing
    | TransmissionRecovered
    | RestartRequested
    | CarrierSenseIgnored
    | CarrierSenseRestored
    | SettingUnconfirmed
    | ClockConfirmed
    | ModemError
    | ModemMessageReceived
    | SentenceRejected
    | UnhandledSentence
    | PacketSent
    | PacketFailed
    | FrameReceived
    | FrameDecoded
    | PacketReceived
    | FrameAcknowledged
    | StatisticsReceived
    | RequestDone
    | RequestFailed
    | PingReceived
    | PingAnswered
    | MiniPacketReceived
    | MiniPacketAnswered
    | FlexibleDataReceived
    | PollReceived
)
