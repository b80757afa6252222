"""The sending half of the emulated modem: cycles that a host fills, mini-packets, and automatic answers.

One packet is in the water at a time. What the host asks for while an automatic answer is on the air waits for its end.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from sonarpost.errors import SentenceError
from sonarpost.modem import nmea
from sonarpost.modem.rates import RATES
from sonarpost.sim import micromodem_commands as commands
from sonarpost.sim.micromodem_config import ModemConfig
from sonarpost.sim.micromodem_hearing import packet_type
from sonarpost.sim.micromodem_sentences import PacketType, Sent, transmit_statistics
from sonarpost.sim.micromodem_settings import ModemClock, Settings
from sonarpost.sim.water_records import ArrivalEnded, Outcome, Packet, PacketKind

_ASKED_BY_HOST = frozenset({PacketKind.DATA, PacketKind.PING, PacketKind.MINI})


class BusyError(SentenceError):
    """The host asks for a transmission while the one before it is not over."""


@dataclass(slots=True)
class _Cycle:
    """A packet that is being filled."""

    request: commands.StartCycle
    deadline_s: float
    frames: list[bytes] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Sending:
    """A packet in the water."""

    packet: Packet
    started_s: float
    ended_s: float


class Transmitter:
    """Fills, sends and answers.

    Args:
        config: The modem's.
        settings: The modem's.
        clock: The modem's.
        write: Takes each sentence for the host.
    """

    def __init__(
        self, config: ModemConfig, settings: Settings, clock: ModemClock, write: Callable[[bytes], None]
    ) -> None:
        self._config = config
        self._settings = settings
        self._clock = clock
        self._write = write
        self._packets: deque[Packet] = deque()
        self._cycle: _Cycle | None = None
        self._sending: _Sending | None = None
        self._waiting: deque[tuple[float, Packet]] = deque()

    def packets_to_transmit(self) -> list[Packet]:
        """Return, once, the packets that go into the water now."""
        packets = list(self._packets)
        self._packets.clear()
        return packets

    def quiet_at_s(self, now: float) -> float:
        """Return when the packet in the water ends, or `now`."""
        return self._sending.ended_s if self._sending else now

    def next_deadline_s(self) -> float | None:
        """Return when `poll` has something to do, or None."""
        times_s = []
        if self._sending:
            times_s.append(self._sending.ended_s)
        elif self._waiting:
            times_s.append(self._waiting[0][0])
        if self._cycle:
            times_s.append(self._cycle.deadline_s)
        return min(times_s, default=None)

    def poll(self, now: float) -> None:
        """End a transmission, give up on a silent host, start what waits."""
        if self._sending and self._sending.ended_s <= now:
            sending, self._sending = self._sending, None
            self._tell_sent(sending)
        if self._cycle and self._cycle.deadline_s <= now:
            frame = len(self._cycle.frames) + 1
            self._cycle = None
            self._say("CAERR", self._clock.hhmmss(now), "DATA_TIMEOUT", frame)
        if self._waiting and self._waiting[0][0] <= now and not self._sending:
            self._send(self._waiting.popleft()[1], now)

    def abandon(self) -> None:
        """Forget everything (the modem reboots)."""
        self._cycle = None
        self._sending = None
        self._waiting.clear()
        self._packets.clear()

    def start_cycle(self, sentence: nmea.Sentence, now: float) -> None:
        """Act on `CCCYC`.

        Raises:
            SentenceError: It does not parse, or is another modem's turn.
            BusyError: A cycle or transmission of the host's is not over.
        """
        request = commands.start_cycle(sentence)
        self._check_free(sentence, request.source)
        ends = (request.command, request.source, request.destination)
        self._say("CACYC", *ends, request.rate, int(request.ack_requested), request.frames)
        self._cycle = _Cycle(request, now)
        self._ask_frame(self._cycle, now)

    def fill_frame(self, sentence: nmea.Sentence, now: float) -> None:
        """Act on `CCTXD`: ask for the next frame, or transmit.

        Raises:
            SentenceError: It does not parse, nobody asked for data, or it is longer than a frame.
        """
        filled = commands.fill_frame(sentence)
        cycle = self._cycle
        if cycle is None:
            raise SentenceError(sentence.kind, "moment", "", "a data request before it")
        most = RATES[cycle.request.rate].frame_bytes
        if len(filled.data) > most:
            raise SentenceError(sentence.kind, "length", len(filled.data), f"at most {most} bytes")
        # The cycle's own addresses count, as they are what goes into the packet's header.
        ends = (cycle.request.source, cycle.request.destination, int(filled.ack_requested))
        self._say("CATXD", *ends, len(filled.data))
        cycle.frames.append(filled.data)
        if filled.data and len(cycle.frames) < cycle.request.frames:
            self._ask_frame(cycle, now)
            return
        self._cycle = None
        self._send_when_free(self._data_packet(cycle), now)

    def send_mini(self, sentence: nmea.Sentence, now: float) -> None:
        """Act on `CCMPC` and `CCMUC`.

        Raises:
            SentenceError: It does not parse, or has another modem's address as source.
            BusyError: A cycle or transmission of the host's is not over.
        """
        asked = commands.mini(sentence)
        self._check_free(sentence, asked.source)
        is_ping = sentence.kind == "CCMPC"
        bits = () if is_ping else (f"{asked.bits:04X}",)
        self._say("CA" + sentence.kind[2:], asked.source, asked.destination, *bits)
        kind = PacketKind.PING if is_ping else PacketKind.MINI
        airtime_s = self._config.mini_airtime_s
        packet = Packet(kind, asked.source, asked.destination, 0, airtime_s, mini=asked.bits)
        self._send_when_free(packet, now)

    def answer(self, arrival: ArrivalEnded, good_frames: tuple[int, ...]) -> None:
        """Plan the automatic answer to a packet that arrived whole and was meant for this modem, if it wants one."""
        packet = arrival.transmission.packet
        addressed = packet.destination == self._settings["SRC"]
        if not (arrival.detected and addressed and arrival.outcome is Outcome.ARRIVED):
            return
        ends = (packet.destination, packet.source, 0, self._config.mini_airtime_s)
        if packet.kind is PacketKind.PING:
            answer = Packet(PacketKind.PING_REPLY, *ends)
        elif packet.kind is PacketKind.MINI:
            answer = Packet(PacketKind.MINI_REPLY, *ends)
        elif packet.kind is PacketKind.DATA and packet.ack_requested and good_frames:
            answer = Packet(PacketKind.ACK, *ends, acked_frames=good_frames)
        else:
            return
        self._waiting.append((arrival.at_s + self._config.turnaround_s, answer))

    def _say(self, kind: str, *fields: str | int) -> None:
        self._write(nmea.format(kind, *fields))

    def _check_free(self, sentence: nmea.Sentence, source: int) -> None:
        if source != self._settings["SRC"]:
            raise SentenceError(sentence.kind, "source", source, f"own address {self._settings['SRC']}")
        pending = [packet for _, packet in self._waiting]
        if self._sending:
            pending.append(self._sending.packet)
        if self._cycle or any(packet.kind in _ASKED_BY_HOST for packet in pending):
            raise BusyError(sentence.kind, "moment", "", "the end of the cycle before it")

    def _ask_frame(self, cycle: _Cycle, now: float) -> None:
        request = cycle.request
        cycle.deadline_s = now + self._settings["DTO"]
        self._say(
            "CADRQ",
            self._clock.hhmmss(now),
            request.source,
            request.destination,
            int(request.ack_requested),
            RATES[request.rate].frame_bytes,
            len(cycle.frames) + 1,
        )

    def _data_packet(self, cycle: _Cycle) -> Packet:
        request = cycle.request
        frames = cycle.frames + [b""] * (request.frames - len(cycle.frames))
        return Packet(
            PacketKind.DATA,
            request.source,
            request.destination,
            request.rate,
            self._config.airtime_s(request.rate),
            tuple(frames),
            request.ack_requested,
        )

    def _send_when_free(self, packet: Packet, now: float) -> None:
        if self._sending:
            self._waiting.append((now, packet))
        else:
            self._send(packet, now)

    def _send(self, packet: Packet, now: float) -> None:
        self._sending = _Sending(packet, now, now + packet.airtime_s)
        self._packets.append(packet)
        if packet.kind is PacketKind.DATA and self._settings.on("TXP"):
            self._say("CATXP", sum(map(len, packet.frames)))

    def _tell_sent(self, sending: _Sending) -> None:
        packet = sending.packet
        if packet.kind is not PacketKind.DATA:
            return
        total = sum(map(len, packet.frames))
        if self._settings.on("TXF"):
            self._say("CATXF", total)
        if not self._settings.on("XST"):
            return
        # At rate 0 the cycle header is a mini-packet of its own, so it has statistics of its own.
        header = [(PacketType.FSK_MINI, 0, 0)] if packet.rate == 0 else []
        for kind, sent, size in [*header, (packet_type(packet), sum(map(bool, packet.frames)), total)]:
            statistics = Sent(
                started=self._clock.at(sending.started_s),
                clock_set=self._clock.was_set,
                rate=packet.rate,
                source=packet.source,
                destination=packet.destination,
                ack_requested=packet.ack_requested,
                frames_expected=len(packet.frames),
                frames_sent=sent,
                packet_type=kind,
                data_bytes=size,
            )
            self._write(transmit_statistics(statistics, self._config.generation))
