"""Transmitting half of the emulated modem: cycles filled by the host, short packets, ranging and automatic replies.

One packet is transmitted at a time. A packet that the host requests during an automatic reply waits for its end. A
cycle at rate 0, and a poll of another modem, transmit a header first. The modem then requests the data from its host,
or waits for the data of the other modem.
"""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from sonarpost.errors import SentenceError
from sonarpost.extensions.simulation.channel.events import AcousticPacket, ArrivalEnded, PacketKind, PacketOutcome
from sonarpost.extensions.simulation.modem import commands
from sonarpost.extensions.simulation.modem.settings import (
    MINI_AIRTIME_S,
    TURNAROUND_S,
    EmulatedModemConfig,
    ModemClock,
    NvramSettings,
)
from sonarpost.extensions.simulation.modem.statistics import transmit_statistics
from sonarpost.modem.micromodem import RATES, nmea
from sonarpost.modem.micromodem.sentences import Cycle

RANGING_PING_S = 0.01

TravelTimes = Callable[[], Mapping[str, float]]
"""Returns the one-way travel time, in seconds, to every transponder by its letter."""

_REPLIES = frozenset({PacketKind.ACK, PacketKind.PING_REPLY, PacketKind.MINI_REPLY})
_WITH_STATISTICS = frozenset({PacketKind.DATA, PacketKind.CYCLE, PacketKind.FLEXIBLE})


class BusyError(SentenceError):
    """The host requests a transmission before the previous one is over."""


@dataclass(slots=True)
class _FilledCycle:
    """A packet that the host fills; `deadline_s` is None until its header has been transmitted."""

    cycle: Cycle
    deadline_s: float | None = None
    frames: list[commands.FrameData] = field(default_factory=list)

    def packet(self, airtime_s: float) -> AcousticPacket:
        """Return the packet with the data of its frames; missing frames are empty."""
        filled = list(enumerate(self.frames, start=1))
        empty = (b"",) * (self.cycle.nframes - len(filled))
        return AcousticPacket(
            PacketKind.DATA,
            self.cycle.src,
            self.cycle.dest,
            self.cycle.rate,
            airtime_s,
            tuple(frame.data for frame in self.frames) + empty,
            self.cycle.ack,
            ack_frames=tuple(number for number, frame in filled if frame.ack_requested and frame.data),
            ascii_frames=tuple(number for number, frame in filled if frame.is_text),
        )


@dataclass(frozen=True, slots=True)
class _OnAir:
    """A packet being transmitted."""

    packet: AcousticPacket
    started_s: float
    ended_s: float


class Transmitter:
    """Transmitting half of one modem.

    A method that processes a sentence raises `SentenceError` for a wrong field, or for a sentence out of place, and
    `BusyError` while the host's previous command is not over.

    Args:
        write: Sends a sentence to the host.
        expect_data: Called with the header of a poll after its transmission: data of another modem should follow.
    """

    def __init__(
        self,
        config: EmulatedModemConfig,
        settings: NvramSettings,
        clock: ModemClock,
        write: Callable[[bytes], None],
        expect_data: Callable[[AcousticPacket, float], None],
    ) -> None:
        self._config = config
        self._settings = settings
        self._clock = clock
        self._write = write
        self._expect_data = expect_data
        self._packets: deque[AcousticPacket] = deque()
        self._filling: _FilledCycle | None = None
        self._on_air: _OnAir | None = None
        self._waiting: deque[tuple[float, AcousticPacket]] = deque()
        self._flexible_packets = 0

    @property
    def busy(self) -> bool:
        """Whether a cycle is being filled, or a packet is being transmitted or waits."""
        return self._filling is not None or self._on_air is not None or bool(self._waiting)

    def packets_to_transmit(self) -> list[AcousticPacket]:
        """Remove and return the packets whose transmission starts now."""
        packets = list(self._packets)
        self._packets.clear()
        return packets

    def end_of_transmission_s(self, now: float) -> float:
        """Return when the transmission in progress ends, or `now`."""
        return self._on_air.ended_s if self._on_air else now

    def next_deadline_s(self) -> float | None:
        """Return when `poll` has something to do, or None."""
        times_s = []
        if self._on_air:
            times_s.append(self._on_air.ended_s)
        elif self._waiting:
            times_s.append(self._waiting[0][0])
        if self._filling and self._filling.deadline_s is not None:
            times_s.append(self._filling.deadline_s)
        return min(times_s, default=None)

    def poll(self, now: float) -> None:
        """End a transmission, end a cycle whose host does not answer, start a packet that waits."""
        if self._on_air and self._on_air.ended_s <= now:
            ended, self._on_air = self._on_air, None
            self._report_transmission(ended)
            if ended.packet.kind is PacketKind.CYCLE:
                self._header_transmitted(ended.packet, now)
        filling = self._filling
        if filling and filling.deadline_s is not None and filling.deadline_s <= now:
            self._filling = None
            self._say("CAERR", self._clock.hhmmss(now), "DATA_TIMEOUT", len(filling.frames) + 1)
        if self._waiting and self._waiting[0][0] <= now and not self._on_air:
            self.send(self._waiting.popleft()[1], now)

    def reset(self) -> None:
        """Drop everything (the modem reboots)."""
        self._filling = None
        self._on_air = None
        self._waiting.clear()
        self._packets.clear()

    def check_free(self, sentence: nmea.Sentence) -> None:
        """Raise `BusyError` if the previous command of the host is not over."""
        pending = [packet for _, packet in self._waiting]
        if self._on_air:
            pending.append(self._on_air.packet)
        if self._filling or any(packet.kind not in _REPLIES for packet in pending):
            raise BusyError(sentence.kind, "moment", "", "the end of the cycle before it")

    def start_cycle(self, sentence: nmea.Sentence, now: float) -> None:
        """Process `CCCYC`: fill a packet, or poll another modem for one."""
        cycle = commands.start_cycle(sentence)
        self.check_free(sentence)
        self._write(cycle.sentence("CACYC").encode())
        if cycle.src == self._settings["SRC"]:
            self._filling = _FilledCycle(cycle)
            if cycle.rate != 0:
                self._request_frame(self._filling, now)
                return
        header = AcousticPacket(
            PacketKind.CYCLE,
            cycle.src,
            cycle.dest,
            cycle.rate,
            MINI_AIRTIME_S,
            ack_requested=cycle.ack,
            announced_frames=cycle.nframes,
        )
        self.send(header, now)

    def fill_frame(self, sentence: nmea.Sentence, now: float) -> None:
        """Process `CCTXD` and `CCTXA`: request the next frame, or transmit."""
        frame = commands.frame_data(sentence)
        filling = self._filling
        if filling is None or filling.deadline_s is None:
            raise SentenceError(sentence.kind, "moment", "", "a data request before it")
        cycle = filling.cycle
        capacity = RATES[cycle.rate].frame_bytes
        if len(frame.data) > capacity:
            raise SentenceError(sentence.kind, "length", len(frame.data), f"at most {capacity} bytes")
        # The cycle's addresses are those of the packet's header; the ones in the sentence have no effect.
        self._say("CA" + sentence.kind[2:], cycle.src, cycle.dest, int(frame.ack_requested), len(frame.data))
        filling.frames.append(frame)
        if frame.data and len(filling.frames) < cycle.nframes:
            self._request_frame(filling, now)
            return
        self._filling = None
        self.send(filling.packet(self._config.airtime_s(cycle.rate)), now)

    def send_mini(self, sentence: nmea.Sentence, now: float) -> None:
        """Process `CCMPC` and `CCMUC`."""
        mini = commands.mini_packet(sentence)
        if mini.source != self._settings["SRC"]:
            raise SentenceError(sentence.kind, "source", mini.source, f"own address {self._settings['SRC']}")
        self.check_free(sentence)
        is_ping = sentence.kind == "CCMPC"
        bits = () if is_ping else (f"{mini.bits:04X}",)
        self._say("CA" + sentence.kind[2:], mini.source, mini.destination, *bits)
        kind = PacketKind.PING if is_ping else PacketKind.MINI
        airtime_s = MINI_AIRTIME_S
        self.send(AcousticPacket(kind, mini.source, mini.destination, 0, airtime_s, mini=mini.bits), now)

    def send_flexible(self, sentence: nmea.Sentence, now: float) -> None:
        """Process `CCTDP`."""
        command = commands.flexible_data(sentence)
        self.check_free(sentence)
        self._flexible_packets += 1
        dest, ack = command.destination, command.ack_requested
        self._say("CATDP", 0, self._flexible_packets, dest, command.rate, int(ack), 0, len(command.data))
        rate = RATES[command.rate]
        rest = command.data[commands.FLEXIBLE_MINI_BYTES :]
        frames = [command.data[: commands.FLEXIBLE_MINI_BYTES]]
        frames += [rest[at : at + rate.frame_bytes] for at in range(0, len(rest), rate.frame_bytes)]
        airtime_s = MINI_AIRTIME_S + self._config.airtime_s(command.rate) * (len(frames) - 1) / rate.frames
        own = self._settings["SRC"]
        self.send(AcousticPacket(PacketKind.FLEXIBLE, own, dest, command.rate, airtime_s, tuple(frames), ack), now)

    def send(self, packet: AcousticPacket, now: float) -> None:
        """Transmit a packet, after the transmission in progress."""
        if self._on_air:
            self._waiting.appendleft((now, packet))
            return
        self._on_air = _OnAir(packet, now, now + packet.airtime_s)
        self._packets.append(packet)
        if self._settings.on("TXP") and packet.kind is not PacketKind.NAVIGATION:
            self._say("CATXP", sum(map(len, packet.frames)))

    def reply(self, arrival: ArrivalEnded, good_frames: tuple[int, ...]) -> None:
        """Schedule the automatic reply to a received packet that is addressed to this modem and requires one."""
        packet = arrival.transmission.packet
        if arrival.outcome is not PacketOutcome.ARRIVED:
            return
        own = self._settings["SRC"]
        if packet.kind is PacketKind.CYCLE and packet.source == own and self._filling is None:
            # Another modem polls this one, which requests the data from its host.
            ends = (packet.source, packet.destination, packet.rate)
            self._filling = _FilledCycle(Cycle(*ends, packet.ack_requested, packet.announced_frames))
            self._request_frame(self._filling, arrival.time_s)
        if packet.destination != own:
            return
        reply = (own, packet.source, 0, MINI_AIRTIME_S)
        acked = tuple(number for number in good_frames if number in packet.ack_frames)
        if packet.kind is PacketKind.PING:
            answer = AcousticPacket(PacketKind.PING_REPLY, *reply)
        elif packet.kind is PacketKind.MINI:
            answer = AcousticPacket(PacketKind.MINI_REPLY, *reply)
        elif packet.kind is PacketKind.DATA and acked:
            answer = AcousticPacket(PacketKind.ACK, *reply, acked_frames=acked)
        else:
            return
        self._waiting.append((arrival.time_s + TURNAROUND_S, answer))

    def _say(self, kind: str, *fields: str | int) -> None:
        self._write(nmea.format(kind, *fields))

    def _header_transmitted(self, header: AcousticPacket, now: float) -> None:
        if header.source != self._settings["SRC"]:
            self._expect_data(header, now)
        elif self._filling is not None and self._filling.deadline_s is None:
            self._request_frame(self._filling, now)

    def _request_frame(self, filling: _FilledCycle, now: float) -> None:
        cycle = filling.cycle
        filling.deadline_s = now + self._settings["DTO"]
        frame_bytes, number = RATES[cycle.rate].frame_bytes, len(filling.frames) + 1
        self._say("CADRQ", self._clock.hhmmss(now), cycle.src, cycle.dest, int(cycle.ack), frame_bytes, number)

    def _report_transmission(self, ended: _OnAir) -> None:
        packet = ended.packet
        if packet.kind is PacketKind.NAVIGATION:
            return
        if self._settings.on("TXF"):
            self._say("CATXF", sum(map(len, packet.frames)))
        if packet.kind not in _WITH_STATISTICS or not self._settings.on("XST"):
            return
        started, version = self._clock.at(ended.started_s), self._config.statistics_version
        self._write(transmit_statistics(packet, version, started, clock_was_set=self._clock.was_set))


@dataclass(frozen=True, slots=True)
class _Interrogation:
    """A ranging ping whose answers are collected."""

    pinged_s: float
    ends_s: float
    answers: Mapping[str, float]


class TransponderRanging:
    """Ranging to transponders: `CCPDT` (REMUS) and `CCPNT` (narrow-band), answered by `SNTTA`.

    The ping is a packet on the channel; transponders are not modems. Each replies after the turn-around time `TAT`, and
    counts if its reply arrives within the time-out of the command. At the time-out the modem reports the one-way travel
    times, with the time of the ping.
    """

    def __init__(
        self,
        settings: NvramSettings,
        clock: ModemClock,
        transmitter: Transmitter,
        travel_times: TravelTimes,
        write: Callable[[bytes], None],
    ) -> None:
        self._settings = settings
        self._clock = clock
        self._transmitter = transmitter
        self._travel_times = travel_times
        self._write = write
        self._interrogation: _Interrogation | None = None

    @property
    def busy(self) -> bool:
        """Whether an interrogation is in progress."""
        return self._interrogation is not None

    @property
    def deadline_s(self) -> float | None:
        """When `poll` has something to do, or None."""
        return self._interrogation.ends_s if self._interrogation else None

    def reset(self) -> None:
        """Drop the interrogation (the modem reboots)."""
        self._interrogation = None

    def start(self, sentence: nmea.Sentence, now: float) -> None:
        """Process `CCPDT` and `CCPNT`."""
        command = commands.ranging(sentence)
        self._transmitter.check_free(sentence)
        if self._interrogation is not None:
            raise BusyError(sentence.kind, "moment", "", "the end of the ranging before it")
        self._write(nmea.format("SN" + sentence.kind[2:], *sentence.fields))
        turnaround_s = self._settings["TAT"] / 1000
        answers = {
            letter: travel_s
            for letter, travel_s in self._travel_times().items()
            if letter in command.transponders and 2 * travel_s + turnaround_s <= command.timeout_s
        }
        self._interrogation = _Interrogation(now, now + max(command.timeout_s, RANGING_PING_S), answers)
        ping = AcousticPacket(PacketKind.NAVIGATION, self._settings["SRC"], 0, 0, RANGING_PING_S)
        self._transmitter.send(ping, now)

    def poll(self, now: float) -> None:
        """Report the travel times at the time-out; the field of a transponder without an answer is empty."""
        if self._interrogation is None or now < self._interrogation.ends_s:
            return
        ended, self._interrogation = self._interrogation, None
        times = [f"{ended.answers[letter]:.4f}" if letter in ended.answers else "" for letter in "ABCD"]
        pinged = self._clock.at(ended.pinged_s).strftime("%H%M%S.%f")[:-2]
        self._write(nmea.format("SNTTA", *times, pinged))
