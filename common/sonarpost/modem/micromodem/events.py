"""What the driver tells: frozen records, in the order in which things happened."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.sentences import ModemMessage
from sonarpost.modem.micromodem.settings import ErrorReport
from sonarpost.modem.micromodem.short_sentences import ReceivedFlexibleData
from sonarpost.modem.micromodem.statistics import LinkStatistics, TransmitStatistics


class FailureReason(StrEnum):
    """Why a packet did not go."""

    NO_ECHO = "no CACYC: the modem did not take the cycle command"
    NO_DATA_REQUEST = "no CADRQ: the modem did not ask for a frame"
    NO_DATA_ECHO = "no CATXD: the modem did not take a frame"
    NO_TRANSMIT_START = "no CATXP: the modem did not start to transmit"
    NO_TRANSMIT_END = "no CATXF: the modem did not end the transmission"
    DATA_TIMEOUT = "the modem went on without the data of a frame"
    FRAME_REFUSED = "the modem takes fewer bytes than the frame has"
    REBOOTED = "the modem restarted in the middle of the cycle"
    PORT_LOST = "the port to the modem went away"
    QUEUE_FULL = "too many packets wait already"
    NO_ANSWER = "the far side did not answer"
    REFUSED = "the modem does not understand the command"
    WAITED_TOO_LONG = "the modem or the water was not free in time"


@dataclass(frozen=True, slots=True)
class ModemReady:
    """The modem has its address and settings, and has confirmed them.

    Attributes:
        address: Its address.
        firmware: Version it has told in a `CAREV`, or None.
    """

    address: int
    firmware: str | None


@dataclass(frozen=True, slots=True)
class ModemUnresponsive:
    """The modem did not answer; said once until the next `ModemReady`. The driver keeps trying.

    Attributes:
        waiting_for: The command that has no right answer.
        attempts: How often it was sent.
        silent_s: Time since the last valid sentence, None when there was none yet.
    """

    waiting_for: str
    attempts: int
    silent_s: float | None


@dataclass(frozen=True, slots=True)
class ModemRebooted:
    """The modem has restarted by itself; it is configured again."""

    firmware: str


@dataclass(frozen=True, slots=True)
class SettingUnconfirmed:
    """A setting the driver can do without was not confirmed; the driver goes on."""

    command: str


@dataclass(frozen=True, slots=True)
class ClockConfirmed:
    """The modem has taken the time it was given."""

    utc: datetime


@dataclass(frozen=True, slots=True)
class ModemError:
    """The modem has reported an error of its own."""

    complaint: ErrorReport


@dataclass(frozen=True, slots=True)
class ModemMessageReceived:
    """A `CAMSG` that is no news of a frame."""

    message: ModemMessage


@dataclass(frozen=True, slots=True)
class SentenceRejected:
    """Bytes that are no valid sentence, or a sentence whose fields are wrong."""

    error: SentenceError


@dataclass(frozen=True, slots=True)
class UnhandledSentence:
    """A valid sentence that the driver has no use for (a setting nobody asked for, ranging, debugging)."""

    sentence: Sentence


@dataclass(frozen=True, slots=True)
class PacketSent:
    """A packet has gone into the water.

    Attributes:
        packet_id: What `send_packet` returned.
        dest: Address meant.
        rate: Rate number.
        frames: The frames, as given.
        acknowledged: Numbers (from 1) of the frames the far side has acknowledged; empty without `ack`.
        started_s: Clock of the driver when the cycle was started.
        finished_s: And when it was over.
        statistics: What the modem told about the transmission, or None.
    """

    packet_id: int
    dest: int
    rate: int
    frames: tuple[bytes, ...]
    acknowledged: tuple[int, ...]
    started_s: float
    finished_s: float
    statistics: TransmitStatistics | None


@dataclass(frozen=True, slots=True)
class PacketFailed:
    """A packet did not go, or it is not known whether it went.

    Attributes:
        packet_id: What `send_packet` returned.
        dest: Address meant.
        rate: Rate number.
        frames: The frames, as given.
        reason: Why.
        maybe_sent: Whether all or part of it may have gone into the water all the same.
    """

    packet_id: int
    dest: int
    rate: int
    frames: tuple[bytes, ...]
    reason: FailureReason
    maybe_sent: bool


@dataclass(frozen=True, slots=True)
class FrameReceived:
    """One good frame. `data` is what the modem gave: a short frame may have been padded on its way.

    Attributes:
        src: Address that sent.
        dest: Address meant (which may be another modem).
        ack: Whether an acknowledgement was asked for.
        frame_number: From 1.
        data: Its bytes.
        received_s: Clock of the driver when it came.
        rate: Rate number where known.
        statistics: Of its packet, None when the modem did not give them.
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
    """A good frame has arrived, of a packet that may not be over: what must not be lost is kept now.

    The same frame comes again as `FrameReceived`, with its packet.
    """

    frame: FrameReceived


@dataclass(frozen=True, slots=True)
class PacketReceived:
    """The end of a packet; its `FrameReceived` events came just before.

    Attributes:
        frames: The good frames.
        bad_frames: How many the modem said were damaged.
        nframes: How many the packet had, None when nobody told.
        src: Address that sent, where known.
        dest: Address meant, where known.
        rate: Rate number, where known.
        statistics: None when the modem did not give them.
        complete: Every announced frame is here and the modem said that the packet is over.
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
    """The far side `src` has acknowledged a frame."""

    src: int
    dest: int
    frame_number: int


@dataclass(frozen=True, slots=True)
class StatisticsReceived:
    """Link quality from something other than a data packet (an acknowledgement, a ping, a cycle start)."""

    statistics: LinkStatistics


@dataclass(frozen=True, slots=True)
class RequestDone:
    """A ping or mini-packet was answered, flexible data has gone, or a polled modem has sent its packet.

    Attributes:
        request_id: What `ping`, `send_mini`, `send_flexible` or `request_packet` returned.
        kind: "ping", "mini-packet", "flexible data" or "poll".
        far: The other modem's address.
    """

    request_id: int
    kind: str
    far: int


@dataclass(frozen=True, slots=True)
class RequestFailed:
    """The same did not come to its end; it may have gone into the water all the same."""

    request_id: int
    kind: str
    far: int
    reason: FailureReason


@dataclass(frozen=True, slots=True)
class PingReceived:
    """Somebody pings `dest`; its modem answers by itself."""

    src: int
    dest: int


@dataclass(frozen=True, slots=True)
class PingAnswered:
    """`src` has answered a ping; `travel_s` is the sound's time one way, None where the modem does not tell it."""

    src: int
    dest: int
    travel_s: float | None


@dataclass(frozen=True, slots=True)
class MiniPacketReceived:
    """A user mini-packet of 13 bits."""

    src: int
    dest: int
    bits: int


@dataclass(frozen=True, slots=True)
class MiniPacketAnswered:
    """`src` has a mini-packet."""

    src: int
    dest: int


@dataclass(frozen=True, slots=True)
class FlexibleDataReceived:
    """A packet of the flexible data protocol.

    Attributes:
        packet: What came, frame by frame.
        received_s: Clock of the driver when it came.
    """

    packet: ReceivedFlexibleData
    received_s: float


@dataclass(frozen=True, slots=True)
class PollReceived:
    """Another modem asks this one for a packet; what it was given is told by `PacketSent` or `PacketFailed`.

    Attributes:
        dest: Where the packet shall go.
        rate: Rate number.
        frames: How many frames at most.
        frame_bytes: How many bytes in each at most.
        ack: Whether acknowledgements shall be asked for.
    """

    dest: int
    rate: int
    frames: int
    frame_bytes: int
    ack: bool


ModemEvent = (
    ModemReady
    | ModemUnresponsive
    | ModemRebooted
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
