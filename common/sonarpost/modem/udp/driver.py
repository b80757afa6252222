"""Driver that exchanges packets as datagrams with other stations; there is no modem between them.

A packet is one datagram. After it the driver waits for the packet's air time, so that the rates are those of
`sonarpost.modem.udp.rates`. A station answers a datagram that requests it with one acknowledgement.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from typing_extensions import override

from sonarpost.errors import SentenceError
from sonarpost.modem.interface import (
    FrameReceived,
    ModemReady,
    PacketReceived,
    TransmissionEnded,
    TransmissionStarted,
)
from sonarpost.modem.packet_queue import QueueingModem, WaitingPacket
from sonarpost.modem.registry import ModemDriver, ModemSettings
from sonarpost.modem.udp.datagram import Datagram, DatagramAssembler, DatagramKind, parse
from sonarpost.modem.udp.rates import CAPABILITIES, RATES

REMEMBERED_PACKETS: Final = 256
"""Received datagrams that are kept to recognise a repeated one."""
PAUSE_S: Final = 2.0
"""After such a pause an incomplete datagram of a stream is dropped."""


@dataclass(slots=True)
class _Sending:
    """The packet in progress: on the air until `ends_s`, then waiting for its acknowledgement until `ack_s`."""

    packet: WaitingPacket
    number: int
    started_s: float
    ends_s: float
    ack_s: float
    acknowledged: set[int] = field(default_factory=set)
    on_air: bool = True


class UdpModem(QueueingModem[_Sending, Datagram]):
    """One station.

    Args:
        settings: Address, and the wait for an acknowledgement as `reply_timeout_s`.
        where: Names the port in errors.

    Raises:
        ConfigError: An address outside 0..254.
    """

    def __init__(self, settings: ModemSettings, where: str = "modem port") -> None:
        super().__init__(CAPABILITIES, settings, where, DatagramAssembler(), PAUSE_S)
        self._seen: dict[Datagram, None] = {}

    @property
    @override
    def ready(self) -> bool:
        """Whether the port is open."""
        return self._is_open

    @override
    def _begin(self, now: float) -> None:
        self._events.append(ModemReady(self._settings.address, None))

    @override
    def _end(self) -> None:
        if self._sending is not None:
            self._events.append(self._sending.packet.failed("the port was lost", maybe_sent=True))
        self._sending = None

    @override
    def _divided(self, data: bytes) -> Sequence[Datagram | SentenceError]:
        if self._settings.stream:
            return self._assembler.feed(data)
        # Every station of the network can send: a datagram neither completes nor damages another one.
        try:
            return [parse(data)]
        except SentenceError as error:
            return [error]

    @override
    def _deadlines_s(self) -> Iterable[float | None]:
        if self._sending is not None:
            yield self._sending.ends_s if self._sending.on_air else self._sending.ack_s

    @override
    def _advance(self, now: float) -> None:
        super()._advance(now)
        if self._sending is not None:
            self._advance_packet(self._sending, now)
        if self._is_open and self._sending is None and (packet := self._queue.take()) is not None:
            self._start(packet, now)

    def _start(self, packet: WaitingPacket, now: float) -> None:
        rate = RATES[packet.rate]
        number = packet.number & 0xFFFF
        kind = DatagramKind.DATA_WITH_ACK if packet.ack else DatagramKind.DATA
        frames = packet.frames
        self._send(Datagram(kind, self._settings.address, packet.destination, packet.rate, number, frames))
        ends_s = now + rate.airtime_s
        ack_s = ends_s + (self._settings.reply_timeout_s if packet.ack else 0.0)
        self._sending = _Sending(packet, number, now, ends_s, ack_s)
        self._events.append(TransmissionStarted(rate.airtime_s))

    def _advance_packet(self, sending: _Sending, now: float) -> None:
        if sending.on_air and now >= sending.ends_s:
            sending.on_air = False
            self._events.append(TransmissionEnded(RATES[sending.packet.rate].airtime_s))
        complete = len(sending.acknowledged) == len(sending.packet.frames)
        if not sending.on_air and (complete or now >= sending.ack_s):
            self._events.append(sending.packet.sent(sorted(sending.acknowledged), sending.started_s, now))
            self._sending = None

    @override
    def _on_message(self, message: Datagram, now: float) -> None:
        if message.source != self._settings.address:  # a multicast socket also receives its own datagrams
            self._on_datagram(message, now)

    def _on_datagram(self, datagram: Datagram, now: float) -> None:
        numbers = [number for number, frame in enumerate(datagram.frames, start=1) if frame is not None]
        if datagram.kind is DatagramKind.ACK:
            sending = self._sending
            if sending is not None and datagram.destination == self._settings.address:
                expected = (sending.packet.destination, sending.number)
                if sending.packet.ack and (datagram.source, datagram.number) == expected:
                    sending.acknowledged |= {n for n in numbers if n <= len(sending.packet.frames)}
            return
        if datagram.kind is DatagramKind.DATA_WITH_ACK and datagram.destination == self._settings.address:
            received = tuple(None if frame is None else b"" for frame in datagram.frames)
            own = self._settings.address
            self._send(Datagram(DatagramKind.ACK, own, datagram.source, datagram.rate, datagram.number, received))
        if self._is_repeated(datagram):
            return
        rate = datagram.rate if datagram.rate in RATES else None
        ack = datagram.kind is DatagramKind.DATA_WITH_ACK
        frames = tuple(
            FrameReceived(datagram.source, datagram.destination, ack, number, frame, now, rate, None)
            for number, frame in enumerate(datagram.frames, start=1)
            if frame is not None
        )
        lost, count = len(datagram.frames) - len(frames), len(datagram.frames)
        source, destination = datagram.source, datagram.destination
        packet = PacketReceived(frames, lost, count, source, destination, rate, None, complete=lost == 0)
        self._events += [*frames, packet]

    def _is_repeated(self, datagram: Datagram) -> bool:
        """Return whether the network has repeated a datagram."""
        # A station that has restarted counts from 1 again, so the number alone does not identify a packet.
        if datagram in self._seen:
            return True
        self._seen[datagram] = None
        if len(self._seen) > REMEMBERED_PACKETS:
            del self._seen[next(iter(self._seen))]
        return False

    def _send(self, datagram: Datagram) -> None:
        self._out.append(datagram.pack())


DRIVER = ModemDriver("udp", CAPABILITIES, UdpModem, "UDP multicast: for tests, and for radio above water")
