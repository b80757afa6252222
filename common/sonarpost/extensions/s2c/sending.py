"""The message in progress of the S2C driver: its command, the limit of its duration and its result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from sonarpost.extensions.s2c.messages import DeliveryReport
from sonarpost.extensions.s2c.rates import BURST_FRAME_BYTES, BURST_RATE, RATES
from sonarpost.modem.interface import PacketSent
from sonarpost.modem.packet_queue import WaitingPacket

PING_DATA: Final = b"\0"
"""Data of a ping and of an empty frame. The driver does not report such a message as a frame."""
BURST_REPLY_TIMEOUTS: Final = 12
"""How long accepted burst data may take, in reply timeouts: the modem connects and repeats by itself."""


@dataclass(slots=True)
class Sending:
    """An instant message or burst data in progress.

    Attributes:
        accepted: Whether the modem has accepted it.
        ended: Whether it has been transmitted.
        deadline_s: When its end is given up, or when it is sent again after a refusal.
        refused: Whether it waits to be sent again.
    """

    packet: WaitingPacket
    is_ping: bool
    started_s: float
    deadline_s: float = 0.0
    attempts: int = 0
    accepted: bool = False
    ended: bool = False
    delivered: bool = False
    refused: bool = False

    @property
    def is_burst(self) -> bool:
        """Whether it is burst data."""
        return self.packet.rate == BURST_RATE

    def command(self) -> bytes:
        """Return the command that sends it."""
        packet = self.packet
        # The receiver divides burst data into frames by their length, so all but the last one are filled with zeros.
        data = b"".join(frame.ljust(BURST_FRAME_BYTES, b"\0") for frame in packet.frames[:-1]) + packet.frames[-1]
        data = data or PING_DATA
        if self.is_burst:
            return b"AT*SEND,%d,%d,%b" % (len(data), packet.destination, data)
        flag = b"ack" if packet.ack else b"noack"
        return b"AT*SENDIM,%d,%d,%b,%b" % (len(data), packet.destination, flag, data)

    def limit_s(self, reply_timeout_s: float) -> float:
        """Return how long its end may take after the modem has accepted it, repetitions by the modem included."""
        if self.is_burst:
            return BURST_REPLY_TIMEOUTS * reply_timeout_s
        return 4 * RATES[self.packet.rate].airtime_s + (2 * reply_timeout_s if self.packet.ack else 3.0)

    def expects(self, report: DeliveryReport) -> bool:
        """Return whether a report can be the one of this message."""
        is_same = report.address == self.packet.destination and report.kind == ("" if self.is_burst else "IM")
        return self.accepted and is_same and not self.delivered

    def sent(self, now: float, *, delivered: bool) -> PacketSent:
        """Return its result: it was transmitted, as far as known."""
        acknowledged = range(1, len(self.packet.frames) + 1) if delivered and self.packet.ack else ()
        return self.packet.sent(acknowledged, self.started_s, now, end_reported=self.ended)
