"""Queue of packets and requests of a driver: limited in number and in age."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

from sonarpost.modem.interface import PacketFailed

QUEUED_PACKETS: Final = 8
MAX_DEFER_S: Final = 120.0


@dataclass(frozen=True, slots=True)
class WaitingPacket:
    """A packet that waits for its transmission.

    Attributes:
        number: Its `packet_id`.
        queued_s: When it was queued.
    """

    number: int
    destination: int
    rate: int
    frames: tuple[bytes, ...]
    ack: bool
    queued_s: float

    def failed(self, reason: str, *, maybe_sent: bool = False) -> PacketFailed:
        """Return the event of a packet that was not sent."""
        return PacketFailed(self.number, self.destination, self.rate, self.frames, reason, maybe_sent)


class PacketQueue:
    """Packets in the order of their arrival.

    Args:
        limit: Greatest number of packets.
        max_age_s: Longest wait; a packet that is older has failed.
    """

    def __init__(self, limit: int = QUEUED_PACKETS, max_age_s: float = MAX_DEFER_S) -> None:
        self._limit = limit
        self._max_age_s = max_age_s
        self._packets: deque[WaitingPacket] = deque()

    def __len__(self) -> int:
        return len(self._packets)

    def add(self, packet: WaitingPacket) -> PacketFailed | None:
        """Add a packet; return its failure when the queue is full."""
        if len(self._packets) >= self._limit:
            return packet.failed("the driver's queue is full")
        self._packets.append(packet)
        return None

    def take(self) -> WaitingPacket | None:
        """Remove and return the next packet, None without one."""
        return self._packets.popleft() if self._packets else None

    def expire(self, now: float) -> list[PacketFailed]:
        """Remove the packets that have waited too long; return their failures."""
        failed: list[PacketFailed] = []
        while self._packets and now >= self._packets[0].queued_s + self._max_age_s:
            failed.append(self._packets.popleft().failed("the modem or the channel was busy for too long"))
        return failed

    def deadline_s(self) -> float | None:
        """Return when the next packet has waited too long, None without one."""
        return self._packets[0].queued_s + self._max_age_s if self._packets else None
