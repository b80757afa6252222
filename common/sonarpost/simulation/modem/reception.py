"""What the emulated modem tells its host about a packet that has passed.

Order, as hosts expect it: `CARXP` when the packet begins (the modem writes that itself), then `CACYC`, a line for each
frame, and `CACST` last. A packet of rate 0, and a poll, begin with a cycle header that is a packet of its own, with
`CACYC` and a `CACST` of its own; the data of rate 0 that follows has no `CACYC`. Frames that were announced and left
empty have no line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from sonarpost.modem.micromodem import nmea
from sonarpost.simulation.channel.channel_events import (
    AcousticPacket,
    ArrivalEnded,
    FrameArrival,
    FrameOutcome,
    PacketKind,
    PacketOutcome,
)
from sonarpost.simulation.modem.config import EmulatedModemConfig
from sonarpost.simulation.modem.sentences import PacketType, ReceivedPacket, ReceiveMode, receive_statistics
from sonarpost.simulation.modem.settings import ModemClock, ModemSettings

_GOOD = frozenset({FrameOutcome.DELIVERED, FrameOutcome.DAMAGED})
_NOT_MINE = "addressed to another modem"


@dataclass(slots=True)
class HostReport:
    """What comes of a packet at one modem.

    Attributes:
        lines: Sentences for the host.
        untold: Why the frames that arrived are not among them; None when they are.
        good_frames: Numbers of the frames that passed for good.
        missed: Whether nothing of the packet was heard.
    """

    lines: list[bytes] = field(default_factory=list)
    untold: str | None = None
    good_frames: tuple[int, ...] = ()
    missed: bool = False


@dataclass(frozen=True, slots=True)
class _Expected:
    """Data that a cycle header, heard or sent, has announced."""

    header: AcousticPacket
    deadline_s: float


def packet_type(packet: AcousticPacket) -> PacketType:
    """Return the type that the statistics give for a packet."""
    if packet.kind is PacketKind.FLEXIBLE:
        return PacketType.FLEXIBLE
    if packet.kind is not PacketKind.DATA:
        return PacketType.FSK_MINI
    return PacketType.FSK if packet.rate == 0 else PacketType.PSK


class Receiver:
    """The listening half of one modem.

    Args:
        config: The modem's.
        settings: The modem's.
        clock: The modem's.
    """

    def __init__(self, config: EmulatedModemConfig, settings: ModemSettings, clock: ModemClock) -> None:
        self._config = config
        self._settings = settings
        self._clock = clock
        self._expected: _Expected | None = None
        self._arriving = False

    @property
    def busy(self) -> bool:
        """Whether a packet is arriving or announced."""
        return self._arriving or self._expected is not None

    @property
    def deadline_s(self) -> float | None:
        """When an announced packet that has not begun is given up."""
        return None if self._expected is None or self._arriving else self._expected.deadline_s

    def expect(self, header: AcousticPacket, now: float) -> None:
        """Wait for the data that `header` announces."""
        max_defer_s = self._settings["CTO"] + header.announced_frames * self._settings["DTO"]
        self._expected = _Expected(header, now + max_defer_s)

    def forget(self) -> None:
        """Forget everything (the modem reboots)."""
        self._expected = None
        self._arriving = False

    def poll(self, now: float) -> list[bytes]:
        """Give up an announced packet that has not begun; return what the host is told."""
        if self._expected is None or self._arriving or now < self._expected.deadline_s:
            return []
        rate = self._expected.header.rate
        self._expected = None
        return [nmea.format("CAMSG", "PACKET_TIMEOUT", rate)]

    def begin(self, packet: AcousticPacket) -> list[bytes]:
        """A packet begins to arrive; return what the host is told."""
        if packet.kind is PacketKind.NAVIGATION:
            return []
        self._arriving = True
        if not self._settings.on("RXP"):
            return []
        psk = packet_type(packet) in {PacketType.PSK, PacketType.FLEXIBLE}
        return [nmea.format("CARXP", int(psk))]

    def hear(self, arrival: ArrivalEnded) -> HostReport:
        """Return what the modem tells about a packet that has passed."""
        packet = arrival.transmission.packet
        if packet.kind is PacketKind.NAVIGATION:
            return HostReport(untold="no communication", missed=True)
        if not arrival.detected:
            return HostReport(untold=arrival.outcome.value, missed=True)
        if not self._arriving:
            return HostReport(untold="rebooting", missed=True)
        self._arriving = False
        expected, self._expected = self._expected, None
        if arrival.outcome is not PacketOutcome.ARRIVED:
            return self._broken(arrival, arrival.outcome.value)
        if packet.kind is PacketKind.DATA:
            missed = packet.rate == 0 and not _announces(expected, packet)
            return self._broken(arrival, "cycle header missed") if missed else self._data(arrival)
        # A short packet between a header and its data does not end the wait.
        self._expected = expected
        tell = {PacketKind.CYCLE: self._cycle, PacketKind.FLEXIBLE: self._flexible}.get(packet.kind, self._short)
        return tell(arrival)

    def _accepts(self, destination: int) -> bool:
        addressed = destination == self._settings["SRC"] or destination in self._config.broadcast_addresses
        return self._config.promiscuous or addressed

    def _broken(self, arrival: ArrivalEnded, untold: str) -> HostReport:
        lines = [nmea.format("CAMSG", "PACKET_TIMEOUT", arrival.transmission.packet.rate)]
        heard = self._heard(arrival)
        heard = replace(heard, mode=ReceiveMode.TIMEOUT, source=0, destination=0, frames=0, bad_frames=0)
        return HostReport(lines + self._statistics(heard), untold=untold)

    def _cycle(self, arrival: ArrivalEnded) -> HostReport:
        packet = arrival.transmission.packet
        if packet.source != self._settings["SRC"]:
            self.expect(packet, arrival.at_s)
        lines = [_cycle_line(packet, packet.announced_frames)]
        return HostReport(lines + self._statistics(replace(self._heard(arrival), frames=0, bad_frames=0)))

    def _data(self, arrival: ArrivalEnded) -> HostReport:
        packet = arrival.transmission.packet
        hearing = HostReport()
        if packet.rate != 0:
            hearing.lines.append(_cycle_line(packet, len(packet.frames)))
        if not self._accepts(packet.destination):
            hearing.untold = _NOT_MINE
        for frame in arrival.frames:
            if frame.fate is FrameOutcome.LOST:
                hearing.lines.append(nmea.format("CAMSG", "BAD_CRC", frame.number))
            elif frame.fate is not FrameOutcome.EMPTY and hearing.untold != _NOT_MINE:
                line, switch = self._frame_line(packet, frame)
                if self._settings.on(switch):
                    hearing.lines.append(line)
                else:
                    hearing.untold = f"{switch} is off"
        hearing.lines += self._details(arrival)
        hearing.lines += self._statistics(self._heard(arrival))
        hearing.good_frames = tuple(frame.number for frame in arrival.frames if frame.fate in _GOOD)
        return hearing

    @staticmethod
    def _frame_line(packet: AcousticPacket, frame: FrameArrival) -> tuple[bytes, str]:
        head = (packet.source, packet.destination, int(frame.number in packet.ack_frames), frame.number)
        # What noise made of a text need not be text any more.
        if frame.number in packet.ascii_frames and nmea.is_text(frame.received):
            return nmea.format("CARXA", *head, *frame.received.decode("ascii").split(",")), "RXA"
        return nmea.format("CARXD", *head, frame.received.hex().upper()), "RXD"

    def _flexible(self, arrival: ArrivalEnded) -> HostReport:
        packet = arrival.transmission.packet
        hearing = HostReport()
        if self._accepts(packet.destination):
            mini, *rest = [_group(frame) for frame in arrival.frames]
            ends = (packet.source, packet.destination, packet.rate, int(packet.ack_requested), 0)
            hearing.lines.append(nmea.format("CARDP", *ends, mini, ";".join(rest)))
        else:
            hearing.untold = _NOT_MINE
        hearing.lines += self._statistics(self._heard(arrival))
        return hearing

    def _short(self, arrival: ArrivalEnded) -> HostReport:
        packet = arrival.transmission.packet
        ends = (packet.source, packet.destination)
        hearing = HostReport()
        if packet.kind is PacketKind.ACK:
            if self._accepts(packet.destination):
                hearing.lines += [nmea.format("CAACK", *ends, number, 1) for number in packet.acked_frames]
            else:
                hearing.untold = _NOT_MINE
        elif packet.destination != self._settings["SRC"]:
            hearing.untold = _NOT_MINE
        else:
            hearing.lines.append(_SHORT[packet.kind](arrival))
        hearing.lines += self._statistics(self._heard(arrival))
        return hearing

    def _heard(self, arrival: ArrivalEnded) -> ReceivedPacket:
        packet = arrival.transmission.packet
        held = [frame for frame in arrival.frames if frame.fate is not FrameOutcome.EMPTY]
        bad = sum(frame.fate is FrameOutcome.LOST for frame in held)
        arrived_s = arrival.transmission.started_s + arrival.delay_s
        return ReceivedPacket(
            mode=ReceiveMode.BAD_CRC if bad else ReceiveMode.GOOD,
            arrived=self._clock.at(arrived_s),
            clock=self._clock.status(self._config.generation),
            rate=packet.rate,
            source=packet.source,
            destination=packet.destination,
            packet_type=packet_type(packet),
            frames=len(held),
            bad_frames=bad,
            snr_db=arrival.snr_db,
            range_m=arrival.range_m,
        )

    def _details(self, arrival: ArrivalEnded) -> list[bytes]:
        """Return the lines that are off unless a host asks for them."""
        lines = []
        arrived = self._clock.at(arrival.transmission.started_s + arrival.delay_s)
        if self._settings.on("TOA"):
            lines.append(nmea.format("CATOA", arrived.strftime("%H%M%S.%f")[:-2], int(self._clock.was_set)))
        if self._settings.on("DQF") and packet_type(arrival.transmission.packet) is PacketType.FSK:
            lines.append(nmea.format("CADQF", max(0, min(254, round(180 + arrival.snr_db))), PacketType.FSK.value))
        return lines

    def _statistics(self, heard: ReceivedPacket) -> list[bytes]:
        return [receive_statistics(heard, self._config.statistics_version)] if self._settings.on("CST") else []


_SHORT: dict[PacketKind, Callable[[ArrivalEnded], bytes]] = {
    PacketKind.PING: lambda a: nmea.format("CAMPA", *_ends(a)),
    PacketKind.PING_REPLY: lambda a: nmea.format("CAMPR", *_ends(a), f"{a.delay_s:.4f}"),
    PacketKind.MINI: lambda a: nmea.format("CAMUA", *_ends(a), f"{a.transmission.packet.mini:04X}"),
    PacketKind.MINI_REPLY: lambda a: nmea.format("CAMUR", *_ends(a)),
}


def _ends(arrival: ArrivalEnded) -> tuple[int, int]:
    return arrival.transmission.packet.source, arrival.transmission.packet.destination


def _cycle_line(packet: AcousticPacket, frames: int) -> bytes:
    return nmea.format("CACYC", 0, packet.source, packet.destination, packet.rate, int(packet.ack_requested), frames)


def _announces(expected: _Expected | None, packet: AcousticPacket) -> bool:
    if expected is None:
        return False
    header = expected.header
    return (header.source, header.destination, header.rate) == (packet.source, packet.destination, packet.rate)


def _group(frame: FrameArrival) -> str:
    """Return `crc;nbytes;hex` of a frame of the flexible data protocol; a bad one's bytes are worth nothing."""
    data = bytes(len(frame.sent)) if frame.fate is FrameOutcome.LOST else frame.received
    return f"{int(frame.fate in _GOOD)};{len(frame.sent)};{data.hex().upper()}"
