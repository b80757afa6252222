"""Packets in the acoustic channel and what becomes of them at each receiver."""

from dataclasses import dataclass
from enum import Enum


class PacketKind(Enum):
    """Content of a packet."""

    DATA = "data"
    ACK = "ack"
    PING = "ping"
    PING_REPLY = "ping-reply"
    MINI = "mini"
    MINI_REPLY = "mini-reply"
    CYCLE = "cycle"
    FLEXIBLE = "flexible"
    NAVIGATION = "navigation"


class FrameOutcome(Enum):
    """Outcome of one frame at one receiver."""

    DELIVERED = "delivered"
    LOST = "lost"
    DAMAGED = "damaged"
    EMPTY = "empty"


class PacketOutcome(Enum):
    """Outcome of a whole packet at one receiver."""

    ARRIVED = "arrived"
    LOST = "lost"
    COLLISION = "collision"
    TRANSMITTING = "receiver transmitting"


@dataclass(frozen=True, slots=True)
class AcousticPacket:
    """A packet that a modem transmits.

    Attributes:
        frames: Frames in order; an empty one was announced and not filled.
        ack_requested: Acknowledgement flag of the cycle command.
        ack_frames: Numbers, from 1, of the frames whose data requests acknowledgement.
        ascii_frames: Numbers, from 1, of the frames given as text.
        acked_frames: Numbers, from 1, that an ACK packet acknowledges.
        announced_frames: Frames that a CYCLE packet announces or requests.
    """

    kind: PacketKind
    source: int
    destination: int
    rate: int
    airtime_s: float
    frames: tuple[bytes, ...] = ()
    ack_requested: bool = False
    ack_frames: tuple[int, ...] = ()
    ascii_frames: tuple[int, ...] = ()
    acked_frames: tuple[int, ...] = ()
    mini: int = 0
    announced_frames: int = 0


@dataclass(frozen=True, slots=True)
class TransmittedPacket:
    """A transmitted packet: `number` counts the transmitter's packets from 1; times are simulated seconds."""

    transmitter: int
    number: int
    packet: AcousticPacket
    started_s: float
    ended_s: float


@dataclass(frozen=True, slots=True)
class FrameArrival:
    """One frame at one receiver: the bytes `sent`, and the bytes `received` (empty when lost)."""

    number: int
    outcome: FrameOutcome
    sent: bytes
    received: bytes


@dataclass(frozen=True, slots=True)
class ArrivalStarted:
    """A receiver detects the start of a packet."""

    receiver: int
    time_s: float
    transmission: TransmittedPacket


@dataclass(frozen=True, slots=True)
class ArrivalEnded:
    """A packet has passed a receiver: one such event for each modem except the transmitter, detected or not.

    Attributes:
        time_s: Simulated time at which the packet has passed.
        detected: Whether an `ArrivalStarted` came before.
        delay_s: Travel time.
    """

    receiver: int
    time_s: float
    transmission: TransmittedPacket
    outcome: PacketOutcome
    detected: bool
    frames: tuple[FrameArrival, ...]
    range_m: float
    snr_db: float
    delay_s: float
