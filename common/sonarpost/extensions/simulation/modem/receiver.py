"""Receiving half of the emulated modem: the sentences for the host about every received packet.

Hosts expect this order: `CARXP` at the start of a packet, then `CACYC`, one line for each frame, and `CACST` last. A
packet of rate 0 and a poll begin with a cycle header, a packet of its own with its own `CACYC` and `CACST`; the data of
rate 0 then has no `CACYC`. Announced frames without data have no line.
"""

from dataclasses import dataclass, field
from datetime import datetime

from sonarpost.extensions.simulation.channel.events import (
    AcousticPacket,
    ArrivalEnded,
    FrameArrival,
    FrameOutcome,
    PacketKind,
    PacketOutcome,
)
from sonarpost.extensions.simulation.modem.settings import (
    BROADCAST_ADDRESSES,
    EmulatedModemConfig,
    ModemClock,
    NvramSettings,
)
from sonarpost.extensions.simulation.modem.statistics import PacketType, packet_type, receive_statistics
from sonarpost.modem.micromodem import nmea
from sonarpost.modem.micromodem.sentences import Cycle

_GOOD = frozenset({FrameOutcome.DELIVERED, FrameOutcome.DAMAGED})
_OTHER_DESTINATION = "addressed to another modem"


@dataclass(frozen=True, slots=True)
class PacketReport:
    """A packet at one modem, with the modem's address, and why its host does not receive it (None when it does)."""

    arrival: ArrivalEnded
    address: int
    unreported_reason: str | None


@dataclass(frozen=True, slots=True)
class HostOutput:
    """Bytes for the host, and the report that they complete, if any."""

    data: bytes
    report: PacketReport | None = None


@dataclass(slots=True)
class HostReport:
    """Sentences for the host about one packet.

    Attributes:
        unreported_reason: Why the received frames are not among the lines; None when they are.
        good_frames: Numbers of the frames without CRC error.
        missed: Whether nothing of the packet was received.
    """

    lines: list[bytes] = field(default_factory=list)
    unreported_reason: str | None = None
    good_frames: tuple[int, ...] = ()
    missed: bool = False


@dataclass(frozen=True, slots=True)
class _ExpectedData:
    """Data that a received or transmitted cycle header has announced."""

    header: AcousticPacket
    deadline_s: float

    def includes(self, packet: AcousticPacket) -> bool:
        h = self.header
        return (h.source, h.destination, h.rate) == (packet.source, packet.destination, packet.rate)


class Receiver:
    """Receiving half of one modem."""

    def __init__(self, config: EmulatedModemConfig, settings: NvramSettings, clock: ModemClock) -> None:
        self._config = config
        self._settings = settings
        self._clock = clock
        self._expected: _ExpectedData | None = None
        self._arriving = False

    @property
    def busy(self) -> bool:
        """Whether a packet is arriving or announced."""
        return self._arriving or self._expected is not None

    @property
    def deadline_s(self) -> float | None:
        """When the wait for announced data ends, or None."""
        return None if self._expected is None or self._arriving else self._expected.deadline_s

    def expect_data(self, header: AcousticPacket, now: float) -> None:
        """Wait for the data that `header` announces."""
        timeout_s = self._settings["CTO"] + header.announced_frames * self._settings["DTO"]
        self._expected = _ExpectedData(header, now + timeout_s)

    def reset(self) -> None:
        """Drop the reception in progress (the modem reboots)."""
        self._expected = None
        self._arriving = False

    def poll(self, now: float) -> list[bytes]:
        """End the wait for announced data that has not begun to arrive; return the sentences for the host."""
        if self._expected is None or self._arriving or now < self._expected.deadline_s:
            return []
        rate = self._expected.header.rate
        self._expected = None
        return [nmea.format("CAMSG", "PACKET_TIMEOUT", rate)]

    def arrival_started(self, packet: AcousticPacket) -> list[bytes]:
        """Return the sentences for the host at the start of a packet."""
        if packet.kind is PacketKind.NAVIGATION:
            return []
        self._arriving = True
        if not self._settings.on("RXP"):
            return []
        psk = packet_type(packet) in {PacketType.PSK, PacketType.FLEXIBLE}
        return [nmea.format("CARXP", int(psk))]

    def arrival_ended(self, arrival: ArrivalEnded) -> HostReport:
        """Return the sentences for the host at the end of a packet."""
        packet = arrival.transmission.packet
        missed_reason = self._missed_reason(arrival)
        if missed_reason is not None:
            return HostReport(unreported_reason=missed_reason, missed=True)
        self._arriving = False
        expected, self._expected = self._expected, None
        if arrival.outcome is not PacketOutcome.ARRIVED:
            return self._undecoded(arrival, arrival.outcome.value)
        if packet.kind is PacketKind.DATA:
            if packet.rate == 0 and (expected is None or not expected.includes(packet)):
                return self._undecoded(arrival, "cycle header missed")
            return self._data(arrival)
        # A short packet between a header and its data does not end the wait.
        self._expected = expected
        report = HostReport()
        if packet.kind is PacketKind.CYCLE:
            if packet.source != self._settings["SRC"]:
                self.expect_data(packet, arrival.time_s)
            report.lines.append(_cycle_line(packet, packet.announced_frames))
        elif packet.kind is PacketKind.FLEXIBLE:
            self._flexible(arrival, report)
        else:
            self._short(arrival, report)
            if packet.kind is PacketKind.MINI_REPLY:
                # A modem reports this reply without statistics, and Goby reads statistics as a received message.
                return report
        return self._with_statistics(report, arrival)

    def _missed_reason(self, arrival: ArrivalEnded) -> str | None:
        if arrival.transmission.packet.kind is PacketKind.NAVIGATION:
            return "no communication"
        if not arrival.detected:
            return arrival.outcome.value
        return None if self._arriving else "rebooting"

    def _accepts(self, destination: int) -> bool:
        addressed = destination == self._settings["SRC"] or destination in BROADCAST_ADDRESSES
        return self._config.promiscuous or addressed

    def _undecoded(self, arrival: ArrivalEnded, reason: str) -> HostReport:
        lines = [nmea.format("CAMSG", "PACKET_TIMEOUT", arrival.transmission.packet.rate)]
        return self._with_statistics(HostReport(lines, unreported_reason=reason), arrival, decoded=False)

    def _data(self, arrival: ArrivalEnded) -> HostReport:
        packet = arrival.transmission.packet
        report = HostReport()
        if packet.rate != 0:
            report.lines.append(_cycle_line(packet, len(packet.frames)))
        if not self._accepts(packet.destination):
            report.unreported_reason = _OTHER_DESTINATION
        for frame in arrival.frames:
            if frame.outcome is FrameOutcome.LOST:
                report.lines.append(nmea.format("CAMSG", "BAD_CRC", frame.number))
            elif frame.outcome is not FrameOutcome.EMPTY and report.unreported_reason != _OTHER_DESTINATION:
                line, switch = self._frame_line(packet, frame)
                if self._settings.on(switch):
                    report.lines.append(line)
                else:
                    report.unreported_reason = f"{switch} is off"
        report.lines += self._optional_lines(arrival)
        report.good_frames = tuple(frame.number for frame in arrival.frames if frame.outcome in _GOOD)
        return self._with_statistics(report, arrival)

    @staticmethod
    def _frame_line(packet: AcousticPacket, frame: FrameArrival) -> tuple[bytes, str]:
        head = (packet.source, packet.destination, int(frame.number in packet.ack_frames), frame.number)
        # A damaged text may contain characters that a sentence cannot.
        if frame.number in packet.ascii_frames and nmea.is_text(frame.received):
            return nmea.format("CARXA", *head, *frame.received.decode("ascii").split(",")), "RXA"
        return nmea.format("CARXD", *head, frame.received.hex().upper()), "RXD"

    def _flexible(self, arrival: ArrivalEnded, report: HostReport) -> None:
        packet = arrival.transmission.packet
        if not self._accepts(packet.destination):
            report.unreported_reason = _OTHER_DESTINATION
            return
        mini, *rest = [_flexible_group(frame) for frame in arrival.frames]
        head = (packet.source, packet.destination, packet.rate, int(packet.ack_requested), 0)
        report.lines.append(nmea.format("CARDP", *head, mini, ";".join(rest)))

    def _short(self, arrival: ArrivalEnded, report: HostReport) -> None:
        packet = arrival.transmission.packet
        ends = (packet.source, packet.destination)
        is_ack = packet.kind is PacketKind.ACK
        if not (self._accepts(packet.destination) if is_ack else packet.destination == self._settings["SRC"]):
            report.unreported_reason = _OTHER_DESTINATION
        elif is_ack:
            report.lines += [nmea.format("CAACK", *ends, number, 1) for number in packet.acked_frames]
        elif packet.kind is PacketKind.PING:
            report.lines.append(nmea.format("CAMPA", *ends))
        elif packet.kind is PacketKind.PING_REPLY:
            report.lines.append(nmea.format("CAMPR", *ends, f"{arrival.delay_s:.4f}"))
        elif packet.kind is PacketKind.MINI:
            report.lines.append(nmea.format("CAMUA", *ends, f"{packet.mini:04X}"))
        else:
            report.lines.append(nmea.format("CAMUR", *ends))

    def _optional_lines(self, arrival: ArrivalEnded) -> list[bytes]:
        """Return the lines that are off by default."""
        lines = []
        if self._settings.on("TOA"):
            time = self._arrived(arrival).strftime("%H%M%S.%f")[:-2]
            lines.append(nmea.format("CATOA", time, int(self._clock.was_set)))
        if self._settings.on("DQF") and packet_type(arrival.transmission.packet) is PacketType.FSK:
            lines.append(nmea.format("CADQF", max(0, min(254, round(180 + arrival.snr_db))), PacketType.FSK.value))
        return lines

    def _with_statistics(self, report: HostReport, arrival: ArrivalEnded, *, decoded: bool = True) -> HostReport:
        if self._settings.on("CST"):
            version, clock = self._config.statistics_version, self._clock.status(self._config.generation)
            report.lines.append(receive_statistics(arrival, version, self._arrived(arrival), clock, decoded=decoded))
        return report

    def _arrived(self, arrival: ArrivalEnded) -> datetime:
        return self._clock.at(arrival.transmission.started_s + arrival.delay_s)


def _cycle_line(packet: AcousticPacket, frames: int) -> bytes:
    cycle = Cycle(packet.source, packet.destination, packet.rate, packet.ack_requested, frames)
    return cycle.sentence("CACYC").encode()


def _flexible_group(frame: FrameArrival) -> str:
    """Return `crc;nbytes;hex` of a frame of the flexible data protocol; a lost frame has zeros."""
    data = bytes(len(frame.sent)) if frame.outcome is FrameOutcome.LOST else frame.received
    return f"{int(frame.outcome in _GOOD)};{len(frame.sent)};{data.hex().upper()}"
