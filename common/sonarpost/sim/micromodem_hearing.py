"""What the emulated modem tells its host about a packet that has passed.

Order, as hosts expect it: `CARXP` when the packet begins (the modem writes that itself), then `CACYC`, a line for each
frame, and `CACST` last; rate 0, which sends its cycle header as a packet of its own, has a `CACST` for that too.
Frames that were announced and left empty have no line.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from sonarpost.modem import nmea
from sonarpost.sim.micromodem_sentences import Heard, PacketType, ReceiveMode, receive_statistics
from sonarpost.sim.micromodem_settings import ModemClock, Settings
from sonarpost.sim.water_records import ArrivalEnded, Fate, Outcome, Packet, PacketKind


@dataclass(frozen=True, slots=True)
class Listener:
    """Who listens: the settings, clock and habits of one modem."""

    settings: Settings
    clock: ModemClock
    generation: int
    promiscuous: bool
    broadcast_addresses: frozenset[int]

    def accepts(self, destination: int) -> bool:
        """Return whether the host is shown data that was meant for `destination`."""
        addressed = destination == self.settings["SRC"] or destination in self.broadcast_addresses
        return self.promiscuous or addressed


@dataclass(slots=True)
class Hearing:
    """What comes of a packet at one modem.

    Attributes:
        lines: Sentences for the host.
        untold: Why the frames that arrived are not among them; None when they are.
        good_frames: Numbers of the frames that passed for good.
    """

    lines: list[bytes] = field(default_factory=list)
    untold: str | None = None
    good_frames: tuple[int, ...] = ()


def packet_type(packet: Packet) -> PacketType:
    """Return the type that the statistics give for a packet."""
    if packet.kind is not PacketKind.DATA:
        return PacketType.FSK_MINI
    return PacketType.FSK if packet.rate == 0 else PacketType.PSK


def hear(arrival: ArrivalEnded, listener: Listener) -> Hearing:
    """Return what the modem tells about `arrival`."""
    if not arrival.detected:
        return Hearing(untold=arrival.outcome.value)
    if arrival.outcome is not Outcome.ARRIVED:
        return _broken(arrival, listener)
    if arrival.transmission.packet.kind is PacketKind.DATA:
        return _data(arrival, listener)
    return _short(arrival, listener)


def _broken(arrival: ArrivalEnded, listener: Listener) -> Hearing:
    lines = [nmea.format("CAMSG", "PACKET_TIMEOUT", arrival.transmission.packet.rate)]
    heard = replace(
        _heard(arrival, listener), mode=ReceiveMode.TIMEOUT, source=0, destination=0, frames=0, bad_frames=0
    )
    return Hearing(lines + _statistics(heard, listener), untold=arrival.outcome.value)


def _data(arrival: ArrivalEnded, listener: Listener) -> Hearing:
    packet = arrival.transmission.packet
    ack = int(packet.ack_requested)
    hearing = Hearing()
    cycle = (0, packet.source, packet.destination, packet.rate, ack, len(packet.frames))
    hearing.lines.append(nmea.format("CACYC", *cycle))
    heard = _heard(arrival, listener)
    if packet.rate == 0:
        header = replace(heard, mode=ReceiveMode.GOOD, packet_type=PacketType.FSK_MINI, frames=0, bad_frames=0)
        hearing.lines += _statistics(header, listener)
    if not listener.accepts(packet.destination):
        hearing.untold = "addressed to another modem"
    elif not listener.settings.on("RXD"):
        hearing.untold = "RXD is off"
    for frame in arrival.frames:
        if frame.fate is Fate.LOST:
            hearing.lines.append(nmea.format("CAMSG", "BAD_CRC", frame.number))
        elif frame.fate is not Fate.EMPTY and hearing.untold is None:
            fields = (packet.source, packet.destination, ack, frame.number, frame.received.hex().upper())
            hearing.lines.append(nmea.format("CARXD", *fields))
    hearing.lines += _statistics(heard, listener)
    good = {Fate.DELIVERED, Fate.DAMAGED}
    hearing.good_frames = tuple(frame.number for frame in arrival.frames if frame.fate in good)
    return hearing


def _short(arrival: ArrivalEnded, listener: Listener) -> Hearing:
    packet = arrival.transmission.packet
    ends = (packet.source, packet.destination)
    own = packet.destination == listener.settings["SRC"]
    hearing = Hearing()
    if packet.kind is PacketKind.ACK:
        if listener.accepts(packet.destination):
            hearing.lines += [nmea.format("CAACK", *ends, number, 1) for number in packet.acked_frames]
        else:
            hearing.untold = "addressed to another modem"
    elif not own:
        hearing.untold = "addressed to another modem"
    elif packet.kind is PacketKind.PING:
        hearing.lines.append(nmea.format("CAMPA", *ends))
    elif packet.kind is PacketKind.PING_REPLY:
        hearing.lines.append(nmea.format("CAMPR", *ends, f"{arrival.delay_s:.4f}"))
    elif packet.kind is PacketKind.MINI:
        hearing.lines.append(nmea.format("CAMUA", *ends, f"{packet.mini:04X}"))
    else:
        hearing.lines.append(nmea.format("CAMUR", *ends))
    hearing.lines += _statistics(_heard(arrival, listener), listener)
    return hearing


def _heard(arrival: ArrivalEnded, listener: Listener) -> Heard:
    packet = arrival.transmission.packet
    held = [frame for frame in arrival.frames if frame.fate is not Fate.EMPTY]
    bad = sum(frame.fate is Fate.LOST for frame in held)
    return Heard(
        mode=ReceiveMode.BAD_CRC if bad else ReceiveMode.GOOD,
        arrived=listener.clock.at(arrival.transmission.started_s + arrival.delay_s),
        clock_set=listener.clock.was_set,
        rate=packet.rate,
        source=packet.source,
        destination=packet.destination,
        packet_type=packet_type(packet),
        frames=len(held),
        bad_frames=bad,
        snr_db=arrival.snr_db,
        range_m=arrival.range_m,
    )


def _statistics(heard: Heard, listener: Listener) -> list[bytes]:
    return [receive_statistics(heard, listener.generation)] if listener.settings.on("CST") else []
