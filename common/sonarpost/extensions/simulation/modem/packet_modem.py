"""Common part of the emulated modems whose transmissions are single packets: their outputs and the channel's side.

A subclass reads its host in `_read_input`, queues packets with `_transmit` and describes arrivals in `_on_packet`. One
transmission follows the other; a host that sends faster than the channel waits in a limited queue. Incomplete input is
given up after a pause, so that no bytes of a host make a modem silent.
"""

from abc import ABC, abstractmethod
from collections import deque
from typing import ClassVar, Final

from sonarpost.extensions.simulation.channel.events import (
    AcousticPacket,
    ArrivalEnded,
    ArrivalStarted,
    FrameOutcome,
    PacketOutcome,
)
from sonarpost.extensions.simulation.modem.receiver import HostOutput, PacketReport
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig

MAX_QUEUED: Final = 16
"""Packets that wait for the end of the present transmission; the host's next ones are dropped."""
PROCESSING_S: Final = 0.05
"""Time between two transmissions."""


class PacketModem(ABC):
    """An emulated modem. It reads no clock and owns no port.

    Args:
        settings: Its settings.
    """

    INPUT_PAUSE_S: ClassVar[float]  # incomplete input is given up so long after the last byte of the host

    def __init__(self, settings: EmulatedModemConfig) -> None:
        self.settings = settings
        self._input = bytearray()
        self._pause_ends_s = float("inf")
        self._outputs: deque[HostOutput] = deque()
        self._queue: deque[AcousticPacket] = deque()
        self._ready: list[AcousticPacket] = []
        self._sending: AcousticPacket | None = None
        self._ends_s = 0.0

    @property
    def address(self) -> int:
        """The modem's address."""
        return self.settings.address

    @property
    def transmitting(self) -> bool:
        """Whether a packet is on the air or waits."""
        return self._sending is not None or bool(self._queue)

    def receive(self, data: bytes, now: float) -> None:
        """Process bytes from the host."""
        self._end_pause(now)
        self._input += data
        self._pause_ends_s = now + self.INPUT_PAUSE_S
        self._read_input(now)

    @abstractmethod
    def _read_input(self, now: float) -> None:
        """Process what is complete at the beginning of `_input`, and remove it."""

    def _on_pause(self) -> None:
        """Give up incomplete input; a subclass can answer it."""
        self._input.clear()

    @abstractmethod
    def _on_packet(self, arrival: ArrivalEnded, now: float) -> bytes:
        """Return the bytes for the host about a packet that has arrived, b"" for none."""

    def _on_started(self, packet: AcousticPacket, now: float) -> None:  # noqa: B027 - optional in subclasses
        """Tell the host that the transmission of its packet starts; nothing by default."""

    def _on_sent(self, packet: AcousticPacket, now: float) -> None:  # noqa: B027 - optional in subclasses
        """Tell the host that a packet has been transmitted; nothing by default."""

    def host_disconnected(self) -> None:
        """Drop the incomplete input of a host that has disconnected."""
        self._input.clear()

    def poll(self, now: float) -> None:
        """End a pause of the host and the present transmission, and start the next one, as far as they are due."""
        self._end_pause(now)
        if self._sending is not None and now >= self._ends_s:
            sent, self._sending = self._sending, None
            self._on_sent(sent, now)
        if self._sending is None and self._queue and now >= self._ends_s + PROCESSING_S:
            self._sending = self._queue.popleft()
            self._ends_s = now + self._sending.airtime_s
            self._ready.append(self._sending)
            self._on_started(self._sending, now)

    def next_deadline_s(self) -> float:
        """Return the simulated time at which `poll` has something to do."""
        if self._sending is not None:
            return min(self._ends_s, self._pause_ends_s)
        return min(self._ends_s + PROCESSING_S if self._queue else float("inf"), self._pause_ends_s)

    def arrival_started(self, arrival: ArrivalStarted) -> None:  # noqa: B027 - optional in subclasses
        """Process the start of a packet at this modem; nothing by default."""

    def arrival_ended(self, arrival: ArrivalEnded) -> PacketReport:
        """Process the end of a packet at this modem."""
        if arrival.outcome is not PacketOutcome.ARRIVED:
            return PacketReport(arrival, self.address, arrival.outcome.value)
        data = self._on_packet(arrival, arrival.time_s)
        if not data:
            return PacketReport(arrival, self.address, "nothing for the host")
        report = PacketReport(arrival, self.address, None)
        self._outputs.append(HostOutput(data, report))
        return report

    def packets_to_transmit(self) -> list[AcousticPacket]:
        """Remove and return the packets whose transmission starts now."""
        packets, self._ready = self._ready, []
        return packets

    def take_outputs(self) -> list[HostOutput]:
        """Remove and return the bytes for the host."""
        outputs = list(self._outputs)
        self._outputs.clear()
        return outputs

    def _end_pause(self, now: float) -> None:
        if now >= self._pause_ends_s:
            self._pause_ends_s = float("inf")
            self._on_pause()

    def _transmit(self, packet: AcousticPacket) -> bool:
        """Queue a packet; return False when too many wait."""
        if len(self._queue) >= MAX_QUEUED:
            return False
        self._queue.append(packet)
        return True

    def _write(self, data: bytes) -> None:
        self._outputs.append(HostOutput(data))


def good_frames(arrival: ArrivalEnded) -> list[bytes | None]:
    """Return the frames of a packet at its receiver; None for a lost or damaged one."""
    return [
        frame.received if frame.outcome in (FrameOutcome.DELIVERED, FrameOutcome.EMPTY) else None
        for frame in arrival.frames
    ]
