"""The sending half of the emulated modem: cycles that a host fills, mini-packets, and automatic answers.

One packet is in the water at a time. What the host asks for while an automatic answer is on the air waits for its end.
A cycle at rate 0, and a poll of another modem, put a header into the water first; the modem asks its host for data when
that has gone, or waits for the other modem's data.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem import RATES, nmea
from sonarpost.simulation.channel.channel_events import AcousticPacket, ArrivalEnded, PacketKind, PacketOutcome
from sonarpost.simulation.modem import commands
from sonarpost.simulation.modem.config import EmulatedModemConfig
from sonarpost.simulation.modem.reception import packet_type
from sonarpost.simulation.modem.sentences import TransmittedPacket, transmit_statistics
from sonarpost.simulation.modem.settings import ModemClock, ModemSettings

_ANSWERS = frozenset({PacketKind.ACK, PacketKind.PING_REPLY, PacketKind.MINI_REPLY})
_WITH_STATISTICS = frozenset({PacketKind.DATA, PacketKind.CYCLE, PacketKind.FLEXIBLE})


class BusyError(SentenceError):
    """The host asks for a transmission while the one before it is not over."""


@dataclass(slots=True)
class _Cycle:
    """A packet that is being filled; `deadline_s` is None until its header has gone."""

    request: commands.StartCycle
    deadline_s: float | None = None
    frames: list[commands.FillFrame] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Sending:
    """A packet in the water."""

    packet: AcousticPacket
    started_s: float
    ended_s: float


class Transmitter:
    """Fills, sends and answers.

    Args:
        config: The modem's.
        settings: The modem's.
        clock: The modem's.
        write: Takes each sentence for the host.
        expect: Told of the header of a poll when it has gone: data from another modem should follow.
    """

    def __init__(
        self,
        config: EmulatedModemConfig,
        settings: ModemSettings,
        clock: ModemClock,
        write: Callable[[bytes], None],
        expect: Callable[[AcousticPacket, float], None],
    ) -> None:
        self._config = config
        self._settings = settings
        self._clock = clock
        self._write = write
        self._expect = expect
        self._packets: deque[AcousticPacket] = deque()
        self._cycle: _Cycle | None = None
        self._sending: _Sending | None = None
        self._waiting: deque[tuple[float, AcousticPacket]] = deque()
        self._flexible_packets = 0

    @property
    def busy(self) -> bool:
        """Whether a cycle is being filled, or a packet is in the water or waits to be."""
        return self._cycle is not None or self._sending is not None or bool(self._waiting)

    def packets_to_transmit(self) -> list[AcousticPacket]:
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
        if self._cycle and self._cycle.deadline_s is not None:
            times_s.append(self._cycle.deadline_s)
        return min(times_s, default=None)

    def poll(self, now: float) -> None:
        """End a transmission, give up on a silent host, start what waits."""
        if self._sending and self._sending.ended_s <= now:
            sending, self._sending = self._sending, None
            self._tell_sent(sending)
            if sending.packet.kind is PacketKind.CYCLE:
                self._header_gone(sending.packet, now)
        cycle = self._cycle
        if cycle and cycle.deadline_s is not None and cycle.deadline_s <= now:
            self._cycle = None
            self._say("CAERR", self._clock.hhmmss(now), "DATA_TIMEOUT", len(cycle.frames) + 1)
        if self._waiting and self._waiting[0][0] <= now and not self._sending:
            self.send_when_free(self._waiting.popleft()[1], now)

    def abandon(self) -> None:
        """Forget everything (the modem reboots)."""
        self._cycle = None
        self._sending = None
        self._waiting.clear()
        self._packets.clear()

    def check_free(self, sentence: nmea.Sentence) -> None:
        """Refuse a command of the host's while the one before it is not over.

        Raises:
            BusyError: It is not.
        """
        pending = [packet for _, packet in self._waiting]
        if self._sending:
            pending.append(self._sending.packet)
        if self._cycle or any(packet.kind not in _ANSWERS for packet in pending):
            raise BusyError(sentence.kind, "moment", "", "the end of the cycle before it")

    def start_cycle(self, sentence: nmea.Sentence, now: float) -> None:
        """Act on `CCCYC`: fill a packet, or poll another modem for one.

        Raises:
            SentenceError: It does not parse.
            BusyError: A cycle or transmission of the host's is not over.
        """
        request = commands.start_cycle(sentence)
        self.check_free(sentence)
        ends = (request.command, request.source, request.destination)
        self._say("CACYC", *ends, request.rate, int(request.ack_requested), request.frames)
        if request.source == self._settings["SRC"]:
            self._cycle = _Cycle(request)
            if request.rate != 0:
                self._ask_frame(self._cycle, now)
                return
        header = AcousticPacket(
            PacketKind.CYCLE,
            request.source,
            request.destination,
            request.rate,
            self._config.mini_airtime_s,
            ack_requested=request.ack_requested,
            announced_frames=request.frames,
        )
        self.send_when_free(header, now)

    def polled(self, header: AcousticPacket, now: float) -> None:
        """Another modem asks for data of this one: ask the host for it, unless that is sending already."""
        if self._cycle is not None:
            return
        ends = (0, header.source, header.destination, header.rate)
        self._cycle = _Cycle(commands.StartCycle(*ends, header.ack_requested, header.announced_frames))
        self._ask_frame(self._cycle, now)

    def fill_frame(self, sentence: nmea.Sentence, now: float) -> None:
        """Act on `CCTXD` and `CCTXA`: ask for the next frame, or transmit.

        Raises:
            SentenceError: It does not parse, nobody asked for data, or it is longer than a frame.
        """
        filled = commands.fill_frame(sentence)
        cycle = self._cycle
        if cycle is None or cycle.deadline_s is None:
            raise SentenceError(sentence.kind, "moment", "", "a data request before it")
        most = RATES[cycle.request.rate].frame_bytes
        if len(filled.data) > most:
            raise SentenceError(sentence.kind, "length", len(filled.data), f"at most {most} bytes")
        # The cycle's own addresses count, as they are what goes into the packet's header.
        ends = (cycle.request.source, cycle.request.destination, int(filled.ack_requested))
        self._say("CA" + sentence.kind[2:], *ends, len(filled.data))
        cycle.frames.append(filled)
        if filled.data and len(cycle.frames) < cycle.request.frames:
            self._ask_frame(cycle, now)
            return
        self._cycle = None
        self.send_when_free(self._data_packet(cycle), now)

    def send_mini(self, sentence: nmea.Sentence, now: float) -> None:
        """Act on `CCMPC` and `CCMUC`.

        Raises:
            SentenceError: It does not parse, or has another modem's address as source.
            BusyError: A cycle or transmission of the host's is not over.
        """
        asked = commands.mini(sentence)
        if asked.source != self._settings["SRC"]:
            raise SentenceError(sentence.kind, "source", asked.source, f"own address {self._settings['SRC']}")
        self.check_free(sentence)
        is_ping = sentence.kind == "CCMPC"
        bits = () if is_ping else (f"{asked.bits:04X}",)
        self._say("CA" + sentence.kind[2:], asked.source, asked.destination, *bits)
        kind = PacketKind.PING if is_ping else PacketKind.MINI
        airtime_s = self._config.mini_airtime_s
        self.send_when_free(AcousticPacket(kind, asked.source, asked.destination, 0, airtime_s, mini=asked.bits), now)

    def send_flexible(self, sentence: nmea.Sentence, now: float) -> None:
        """Act on `CCTDP`.

        Raises:
            SentenceError: It does not parse.
            BusyError: A cycle or transmission of the host's is not over.
        """
        asked = commands.flexible(sentence)
        self.check_free(sentence)
        self._flexible_packets += 1
        ends = (asked.destination, asked.rate, int(asked.ack_requested), 0)
        self._say("CATDP", 0, self._flexible_packets, *ends, len(asked.data))
        rate = RATES[asked.rate]
        rest = asked.data[commands.FLEXIBLE_MINI_BYTES :]
        frames = [asked.data[: commands.FLEXIBLE_MINI_BYTES]]
        frames += [rest[at : at + rate.frame_bytes] for at in range(0, len(rest), rate.frame_bytes)]
        airtime_s = self._config.mini_airtime_s + self._config.airtime_s(asked.rate) * (len(frames) - 1) / rate.frames
        own, ack = self._settings["SRC"], asked.ack_requested
        packet = AcousticPacket(PacketKind.FLEXIBLE, own, asked.destination, asked.rate, airtime_s, tuple(frames), ack)
        self.send_when_free(packet, now)

    def send_when_free(self, packet: AcousticPacket, now: float) -> None:
        """Put a packet into the water, after what is in it now."""
        if self._sending:
            self._waiting.appendleft((now, packet))
            return
        self._sending = _Sending(packet, now, now + packet.airtime_s)
        self._packets.append(packet)
        if self._settings.on("TXP") and packet.kind is not PacketKind.NAVIGATION:
            self._say("CATXP", sum(map(len, packet.frames)))

    def answer(self, arrival: ArrivalEnded, good_frames: tuple[int, ...]) -> None:
        """Plan the automatic answer to a packet that was heard whole and was meant for this modem, if it wants one."""
        packet = arrival.transmission.packet
        if arrival.outcome is not PacketOutcome.ARRIVED:
            return
        own = self._settings["SRC"]
        if packet.kind is PacketKind.CYCLE and packet.source == own:
            self.polled(packet, arrival.at_s)
        if packet.destination != own:
            return
        ends = (own, packet.source, 0, self._config.mini_airtime_s)
        acked = tuple(number for number in good_frames if number in packet.ack_frames)
        if packet.kind is PacketKind.PING:
            answer = AcousticPacket(PacketKind.PING_REPLY, *ends)
        elif packet.kind is PacketKind.MINI:
            answer = AcousticPacket(PacketKind.MINI_REPLY, *ends)
        elif packet.kind is PacketKind.DATA and acked:
            answer = AcousticPacket(PacketKind.ACK, *ends, acked_frames=acked)
        else:
            return
        self._waiting.append((arrival.at_s + self._config.turnaround_s, answer))

    def _say(self, kind: str, *fields: str | int) -> None:
        self._write(nmea.format(kind, *fields))

    def _header_gone(self, header: AcousticPacket, now: float) -> None:
        if header.source != self._settings["SRC"]:
            self._expect(header, now)
        elif self._cycle is not None and self._cycle.deadline_s is None:
            self._ask_frame(self._cycle, now)

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

    def _data_packet(self, cycle: _Cycle) -> AcousticPacket:
        request, filled = cycle.request, list(enumerate(cycle.frames, start=1))
        empty = (b"",) * (request.frames - len(cycle.frames))
        return AcousticPacket(
            PacketKind.DATA,
            request.source,
            request.destination,
            request.rate,
            self._config.airtime_s(request.rate),
            tuple(frame.data for frame in cycle.frames) + empty,
            request.ack_requested,
            ack_frames=tuple(number for number, frame in filled if frame.ack_requested and frame.data),
            ascii_frames=tuple(number for number, frame in filled if frame.is_text),
        )

    def _tell_sent(self, sending: _Sending) -> None:
        packet = sending.packet
        if packet.kind is PacketKind.NAVIGATION:
            return
        total = sum(map(len, packet.frames))
        if self._settings.on("TXF"):
            self._say("CATXF", total)
        if packet.kind not in _WITH_STATISTICS or not self._settings.on("XST"):
            return
        statistics = TransmittedPacket(
            started=self._clock.at(sending.started_s),
            clock=str(int(self._clock.was_set)),
            rate=packet.rate,
            source=packet.source,
            destination=packet.destination,
            ack_requested=packet.ack_requested,
            frames_expected=max(len(packet.frames), packet.announced_frames),
            frames_sent=sum(map(bool, packet.frames)),
            packet_type=packet_type(packet),
            data_bytes=total,
        )
        self._write(transmit_statistics(statistics, self._config.statistics_version))
