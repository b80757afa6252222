"""Emulated modems by the name of their driver. The group of entry points is `sonarpost.emulated_modems`."""

from functools import cache
from typing import ClassVar

from typing_extensions import override

from sonarpost.errors import SentenceError
from sonarpost.extensions.simulation.channel.events import AcousticPacket, ArrivalEnded, PacketKind
from sonarpost.extensions.simulation.modem.emulator import EmulatedMicroModem
from sonarpost.extensions.simulation.modem.packet_modem import PacketModem, good_frames
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig
from sonarpost.extensions.simulation.modem.transmitter import TravelTimes
from sonarpost.modem.registry import DEFAULT_DRIVER
from sonarpost.modem.udp.datagram import Datagram, DatagramAssembler, DatagramKind
from sonarpost.modem.udp.rates import RATES
from sonarpost.registry import Registry

EmulatedModem = EmulatedMicroModem | PacketModem


@cache
def packet_modems() -> Registry[type[PacketModem]]:
    """Return the emulated modems that are a `PacketModem`, by the name of their driver; see `sonarpost.registry`."""
    expected = "a subclass of sonarpost.extensions.simulation.modem.packet_modem.PacketModem"

    def is_valid(found: object, _: str) -> bool:
        return isinstance(found, type) and issubclass(found, PacketModem)

    return Registry("sonarpost.emulated_modems", expected, is_valid, {"udp": UdpRelay})


def emulated_drivers() -> tuple[str, ...]:
    """Return the names of the drivers that have an emulated modem."""
    return (DEFAULT_DRIVER, *packet_modems().names())


def create_modem(config: EmulatedModemConfig, travel_times: TravelTimes) -> EmulatedModem:
    """Return the modem of its configuration, switched on at time zero."""
    if config.driver == DEFAULT_DRIVER:
        return EmulatedMicroModem(config, travel_times)
    return packet_modems().get(config.driver)(config)


_ACK_AIRTIME_S = 0.05


class UdpRelay(PacketModem):
    """The channel's end of one station's port."""

    INPUT_PAUSE_S: ClassVar[float] = 5.0  # longer than the longest datagram takes at 9600 bit/s

    def __init__(self, settings: EmulatedModemConfig) -> None:
        super().__init__(settings)
        self._assembler = DatagramAssembler()

    @override
    def host_disconnected(self) -> None:
        self._assembler.reset()

    @override
    def _on_pause(self) -> None:
        self._assembler.reset()

    @override
    def _read_input(self, now: float) -> None:
        """Transmit the datagrams of the host; other bytes are ignored, as a network has no answer for them."""
        data = bytes(self._input)
        self._input.clear()
        for item in self._assembler.feed(data):
            if isinstance(item, SentenceError):
                continue
            is_ack = item.kind is DatagramKind.ACK
            packet = AcousticPacket(
                PacketKind.ACK if is_ack else PacketKind.DATA,
                item.source,
                item.destination,
                item.rate,
                _ACK_AIRTIME_S if is_ack or item.rate not in RATES else RATES[item.rate].airtime_s,
                () if is_ack else tuple(frame or b"" for frame in item.frames),
                ack_requested=item.kind is DatagramKind.DATA_WITH_ACK,
                acked_frames=tuple(n for n, frame in enumerate(item.frames, 1) if is_ack and frame is not None),
                mini=item.number,
                announced_frames=len(item.frames),
            )
            self._transmit(packet)

    @override
    def _on_packet(self, arrival: ArrivalEnded, now: float) -> bytes:
        packet = arrival.transmission.packet
        if packet.kind is PacketKind.ACK:
            kind = DatagramKind.ACK
            numbers = range(1, packet.announced_frames + 1)
            frames: list[bytes | None] = [b"" if n in packet.acked_frames else None for n in numbers]
        else:
            kind = DatagramKind.DATA_WITH_ACK if packet.ack_requested else DatagramKind.DATA
            frames = good_frames(arrival)
        datagram = Datagram(kind, packet.source, packet.destination, packet.rate, packet.mini, tuple(frames))
        return datagram.pack()
