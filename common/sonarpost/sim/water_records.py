"""What travels through the simulated water, what becomes of it, and how the water is set."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from sonarpost.sim.water_chance import TailDamage


class PacketKind(Enum):
    """What a packet carries."""

    DATA = "data"
    ACK = "ack"
    PING = "ping"
    PING_REPLY = "ping-reply"
    MINI = "mini"
    MINI_REPLY = "mini-reply"


class Fate(Enum):
    """What became of one frame at one receiver."""

    DELIVERED = "delivered"
    LOST = "lost"
    DAMAGED = "damaged"
    EMPTY = "empty"


class Outcome(Enum):
    """What became of a packet as a whole at one receiver."""

    ARRIVED = "arrived"
    LOST = "lost"
    COLLISION = "collision"
    TRANSMITTING = "receiver transmitting"


@dataclass(frozen=True, slots=True)
class Packet:
    """What a modem puts into the water.

    Attributes:
        kind: What it carries.
        source: Address it claims to come from.
        destination: Address it is meant for.
        rate: Rate number, 0..6.
        airtime_s: How long it occupies the water.
        frames: Frames in order; an empty one was announced and not filled.
        ack_requested: Whether the sender asks for acknowledgement.
        acked_frames: Numbers an ACK packet acknowledges, from 1.
        mini: The 13 bits of a user mini-packet.
    """

    kind: PacketKind
    source: int
    destination: int
    rate: int
    airtime_s: float
    frames: tuple[bytes, ...] = ()
    ack_requested: bool = False
    acked_frames: tuple[int, ...] = ()
    mini: int = 0


@dataclass(frozen=True, slots=True)
class Transmission:
    """A packet on its way: `number` counts the transmitter's packets from 1; times are simulated seconds."""

    transmitter: int
    number: int
    packet: Packet
    started_s: float
    ended_s: float


@dataclass(frozen=True, slots=True)
class FrameArrival:
    """One frame at one receiver: `sent` left the transmitter, `received` is what the receiver takes for it."""

    number: int
    fate: Fate
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
    outcome: Outcome
    detected: bool
    frames: tuple[FrameArrival, ...]
    range_m: float
    snr_db: float
    delay_s: float


@dataclass(frozen=True, slots=True)
class WaterConfig:
    """What the water does to packets.

    Attributes:
        seed: Seed of every draw.
        sound_speed_m_per_s: Above zero.
        frame_loss: Chance, 0..1, that a non-empty frame is lost on its own.
        packet_loss: Chance, 0..1, that a packet is not detected at all.
        tail_damage: Chance, 0..1, that the tail of the last non-empty frame is damaged and delivered.
        tail_damage_kind: What stands in a damaged tail.
        tail_fraction: Longest damaged tail as a part of its frame, above 0 and at most 1.
        snr_at_1m_db: Signal-to-noise ratio one metre from a transmitter. The default gives 20 dB at 100 m.
        range_loss: Whether frames are also lost by their signal-to-noise ratio. With `snr_at_1m_db` of 37, rate 1
            fails beyond some 130 m, as in the paper's sea trial.

    Raises:
        ValueError: A value outside its bounds.
    """

    seed: int = 0
    sound_speed_m_per_s: float = 1500.0
    frame_loss: float = 0.0
    packet_loss: float = 0.0
    tail_damage: float = 0.0
    tail_damage_kind: TailDamage = TailDamage.EITHER
    tail_fraction: float = 0.5
    snr_at_1m_db: float = 60.0
    range_loss: bool = False

    def __post_init__(self) -> None:
        for name in ("frame_loss", "packet_loss", "tail_damage"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name}: got {getattr(self, name)!r}, expected 0..1")
        if not 0.0 < self.tail_fraction <= 1.0:
            raise ValueError(f"tail_fraction: got {self.tail_fraction!r}, expected above 0 and at most 1")
        if not 0.0 < self.sound_speed_m_per_s < float("inf"):
            raise ValueError(f"sound_speed_m_per_s: got {self.sound_speed_m_per_s!r}, expected above 0")
