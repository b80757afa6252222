"""What travels through the simulated water, what becomes of it, and how the water is set."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class PacketKind(Enum):
    """What a packet carries."""

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
    """What became of one frame at one receiver."""

    DELIVERED = "delivered"
    LOST = "lost"
    DAMAGED = "damaged"
    EMPTY = "empty"


class PacketOutcome(Enum):
    """What became of a packet as a whole at one receiver."""

    ARRIVED = "arrived"
    LOST = "lost"
    COLLISION = "collision"
    TRANSMITTING = "receiver transmitting"


@dataclass(frozen=True, slots=True)
class AcousticPacket:
    """What a modem puts into the water.

    Attributes:
        kind: What it carries.
        source: Address it claims to come from.
        destination: Address it is meant for.
        rate: Rate number, 0..6.
        airtime_s: How long it occupies the water.
        frames: Frames in order; an empty one was announced and not filled.
        ack_requested: What the cycle command said of acknowledgement.
        ack_frames: Numbers, from 1, of the frames whose data came with a request for acknowledgement.
        ascii_frames: Numbers, from 1, of the frames that were given as text.
        acked_frames: Numbers an ACK packet acknowledges, from 1.
        mini: The 13 bits of a user mini-packet.
        announced_frames: Frames that a CYCLE packet announces, or asks for.
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
class Transmission:
    """A packet on its way: `number` counts the transmitter's packets from 1; times are simulated seconds."""

    transmitter: int
    number: int
    packet: AcousticPacket
    started_s: float
    ended_s: float


@dataclass(frozen=True, slots=True)
class FrameArrival:
    """One frame at one receiver: `sent` left the transmitter, `received` is what the receiver takes for it."""

    number: int
    fate: FrameOutcome
    sent: bytes
    received: bytes


@dataclass(frozen=True, slots=True)
class ArrivalStarted:
    """A receiver detects the beginning of a packet."""

    receiver: int
    at_s: float
    transmission: Transmission


@dataclass(frozen=True, slots=True)
class ArrivalEnded:
    """The last of a packet has passed a receiver; one such event for each other modem, heard or not.

    Attributes:
        receiver: Number of the modem.
        at_s: Simulated time.
        transmission: The packet.
        outcome: What became of the whole.
        detected: Whether an `ArrivalStarted` came before.
        frames: What became of each frame.
        range_m: Distance from transmitter to receiver.
        snr_db: Signal-to-noise ratio at the receiver.
        delay_s: Travel time.
    """

    receiver: int
    at_s: float
    transmission: Transmission
    outcome: PacketOutcome
    detected: bool
    frames: tuple[FrameArrival, ...]
    range_m: float
    snr_db: float
    delay_s: float
