"""Burst data of an emulated S2C modem: connection, acknowledgement and retransmission on the simulated channel.

A modem connects before it sends data to another one: it transmits a request and waits for the confirmation. In the
connection it transmits each burst in one packet and waits for its acknowledgement. A missing answer is followed by a
retransmission after a random back-off, so that two modems that transmit at the same time do not do so again. Real
modems also divide long data into several packets and adapt their bit rate to the connection; this one does not.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from sonarpost.extensions.s2c.rates import ACK_AIRTIME_S, BURST_RATE, burst_airtime_s
from sonarpost.extensions.simulation.channel.events import AcousticPacket, PacketKind
from sonarpost.extensions.simulation.channel.model import RandomDraws

ANSWER_LIMIT_S: Final = 6.0
"""How long a modem waits for an acknowledgement or a confirmation: a travel of 3 km and back, and the air time."""
TRANSMISSIONS: Final = 4
"""How often the request of a connection, and then the data, are transmitted before the burst has failed."""
IDLE_LIMIT_S: Final = 30.0
"""A connection without packets for so long is closed."""
MAX_BURSTS: Final = 16
"""Bursts of commands that a modem stores."""
MAX_RAW_BYTES: Final = 65536
"""Raw data that a modem stores."""
MAX_BACK_OFF_S: Final = 4.0

_MAX_NUMBER: Final = 0xFFFF
_HEADER: Final = struct.Struct(">H?")
"""Sequence number of a burst, and whether its data is raw."""


@dataclass(slots=True)
class _Burst:
    """Data of the host: `sequence` counts all bursts, 1 to 65535, `number` those of commands; that of raw data is 0."""

    sequence: int
    number: int
    source: int
    destination: int
    data: bytes


class BurstLink:
    """Burst data of one modem, in both directions.

    Args:
        transmit: Queues a packet for transmission; returns False if it cannot.
        notify: Sends a notification to the host.
    """

    def __init__(self, transmit: Callable[[AcousticPacket], bool], notify: Callable[[str], None]) -> None:
        self._transmit = transmit
        self._notify = notify
        self._bursts: list[_Burst] = []
        self._sequence = self._number = 0
        self._is_started = False
        self._transmissions = 0
        self._wait_until_s = float("inf")
        self._awaited: tuple[int, ...] = ()
        self._peer: int | None = None
        self._closes_s = 0.0
        self._received: dict[int, int] = {}
        self.dropped_bytes = 0
        """Bytes of raw data that were not delivered."""

    @property
    def number(self) -> int:
        """Number of the last burst of a command."""
        return self._number

    def drop(self) -> None:
        """Drop the stored bursts without a report, and close the connection."""
        self._bursts.clear()
        self._peer = None
        self._end_wait()

    def add(self, source: int, destination: int, data: bytes) -> bool:
        """Store a burst of a command; return False when too many are stored."""
        if sum(burst.number > 0 for burst in self._bursts) >= MAX_BURSTS:
            return False
        self._number = self._number % _MAX_NUMBER + 1
        self._append(self._number, source, destination, data)
        return True

    def add_raw(self, source: int, destination: int, data: bytes) -> None:
        """Store raw data as a burst, or drop it when too much is stored."""
        if sum(len(burst.data) for burst in self._bursts if not burst.number) + len(data) > MAX_RAW_BYTES:
            self._drop_raw(data)
        else:
            self._append(0, source, destination, data)

    def deadline_s(self) -> float:
        """Return when `poll` has something to do; a time in the past means immediately."""
        return self._wait_until_s if self._is_started or not self._bursts else 0.0

    def poll(self, now: float) -> None:
        """Transmit the next packet if it is due."""
        if not self._bursts or (self._is_started and now < self._wait_until_s):
            return
        burst = self._bursts[0]
        if self._peer is not None and now >= self._closes_s:
            self._peer = None
        if self._transmissions >= TRANSMISSIONS:
            self._peer = None
            self._end_burst("FAILED")
            return
        self._is_started = True
        self._transmissions += 1
        source, destination = burst.source, burst.destination
        if self._peer == destination:
            self._awaited = (burst.sequence,)
            frames = (_HEADER.pack(burst.sequence, burst.number == 0) + burst.data,)
            airtime_s = burst_airtime_s(len(burst.data))
            packet = AcousticPacket(PacketKind.DATA, source, destination, BURST_RATE, airtime_s, frames)
        else:
            self._awaited = ()  # the confirmation of a connection is an acknowledgement without numbers
            packet = AcousticPacket(PacketKind.CYCLE, source, destination, BURST_RATE, ACK_AIRTIME_S)
        self._wait_until_s = float("inf") if self._transmit(packet) else now + ANSWER_LIMIT_S

    def on_sent(self, packet: AcousticPacket, now: float) -> None:
        """Start the wait for an answer when a request or data has been transmitted."""
        if packet.kind is not PacketKind.ACK and self._is_started:
            draws = RandomDraws(0, packet.source, self._bursts[0].sequence, self._transmissions)
            self._wait_until_s = now + ANSWER_LIMIT_S + MAX_BACK_OFF_S * draws.uniform("back-off")

    def on_packet(self, packet: AcousticPacket, frame: bytes | None, now: float) -> tuple[bytes, bool] | None:
        """Process a packet to this modem.

        Args:
            packet: The packet.
            frame: Its frame as received; None if it has none.
            now: Simulated time.

        Returns:
            Data for the host, and whether it is raw; None for none or if it has received the same burst before.
        """
        self._closes_s = now + IDLE_LIMIT_S
        is_expected = self._is_started and self._bursts[0].destination == packet.source
        if is_expected or not self._is_started:
            self._peer = packet.source
        if packet.kind is PacketKind.ACK:
            if is_expected and packet.acked_frames == self._awaited:
                if self._awaited:
                    self._end_burst("DELIVERED")
                else:
                    self._end_wait()
            return None
        sequence, is_raw = (0, False) if frame is None else _HEADER.unpack_from(frame)
        acked = () if frame is None else (sequence,)
        source, destination = packet.destination, packet.source
        self._transmit(
            AcousticPacket(PacketKind.ACK, source, destination, BURST_RATE, ACK_AIRTIME_S, acked_frames=acked)
        )
        is_new = self._received.get(packet.source) != sequence
        self._received[packet.source] = sequence  # 0 for a request: the bursts of a new connection are new
        return (frame[_HEADER.size :], is_raw) if frame is not None and is_new else None

    def _append(self, number: int, source: int, destination: int, data: bytes) -> None:
        self._sequence = self._sequence % _MAX_NUMBER + 1
        self._bursts.append(_Burst(self._sequence, number, source, destination, data))

    def _end_burst(self, result: str) -> None:
        burst = self._bursts.pop(0)
        self._end_wait()
        if burst.number:
            self._notify(f"{result},{burst.number},{burst.destination}")
        elif result == "FAILED":
            self._drop_raw(burst.data)

    def _drop_raw(self, data: bytes) -> None:
        self.dropped_bytes += len(data)
        self._notify(f"DROPCNT,{self.dropped_bytes}")

    def _end_wait(self) -> None:
        self._is_started = False
        self._transmissions = 0
        self._wait_until_s = float("inf")
