"""Emulated modems, their serial lines and the channel between them, on simulated time.

`ChannelSimulator` reads no clock and owns no port. Its owner passes bytes from the hosts to `receive`, calls `advance`
with the simulated time and writes the result of `take_outputs` to the hosts. Every event happens at its own exact time,
however late `advance` is called, so a slow owner changes no result.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Generic, TypeVar

from sonarpost.extensions.simulation.channel.acoustics import LocalPosition
from sonarpost.extensions.simulation.channel.events import ArrivalStarted, TransmittedPacket
from sonarpost.extensions.simulation.channel.model import ChannelModel
from sonarpost.extensions.simulation.channel.parameters import ChannelParameters
from sonarpost.extensions.simulation.modem.emulated import EmulatedModem, create_modem
from sonarpost.extensions.simulation.modem.receiver import HostOutput, PacketReport
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig

T = TypeVar("T")

BITS_PER_BYTE = 10
"""Start bit, eight data bits, stop bit (8N1)."""


class SerialLine(Generic[T]):
    """One direction of a serial line: an item comes out when its last byte would have been transferred.

    Args:
        baud: Bits a second, above zero, or None for a line without delay.
    """

    def __init__(self, baud: float | None) -> None:
        self._baud = baud
        self._items: deque[tuple[float, T]] = deque()
        self._free_s = 0.0

    def put(self, item: T, size_bytes: int, now: float) -> None:
        """Queue an item of `size_bytes` at `now`."""
        transfer_s = size_bytes * BITS_PER_BYTE / self._baud if self._baud else 0.0
        self._free_s = max(now, self._free_s) + transfer_s
        self._items.append((self._free_s, item))

    def take(self, now: float) -> list[T]:
        """Remove and return the items transferred by `now`."""
        items = []
        while self._items and self._items[0][0] <= now:
            items.append(self._items.popleft()[1])
        return items

    def discard(self) -> list[T]:
        """Remove and return the items still on the line."""
        items = [item for _, item in self._items]
        self._items.clear()
        return items

    def next_s(self) -> float | None:
        """Return when the next item will have been transferred, or None."""
        return self._items[0][0] if self._items else None


@dataclass(frozen=True, slots=True)
class PlacedModem:
    """Configuration and position of one modem."""

    config: EmulatedModemConfig
    position: LocalPosition = field(default_factory=LocalPosition)


@dataclass(slots=True)
class _ModemPort:
    """A modem with both directions of its serial line, and its outputs for the host."""

    modem: EmulatedModem
    to_modem: SerialLine[bytes]
    to_host: SerialLine[HostOutput]
    outputs: list[HostOutput] = field(default_factory=list)


class ChannelSimulator:
    """Emulated modems, their serial lines and the channel.

    Args:
        parameters: Parameters of the channel model.
        modems: Each modem by its number.
        serial_baud: Speed of the serial lines, or None for lines without delay.
        transponders: Positions of the ranging transponders, by their letters A to D.
    """

    def __init__(
        self,
        parameters: ChannelParameters,
        modems: Mapping[int, PlacedModem],
        serial_baud: float | None = None,
        transponders: Mapping[str, LocalPosition] = MappingProxyType({}),
    ) -> None:
        self.now = 0.0
        self.channel = ChannelModel(parameters, {number: modem.position for number, modem in modems.items()})
        self._ports = {
            number: _ModemPort(
                create_modem(modem.config, partial(self.channel.travel_times_s, number, transponders)),
                SerialLine(serial_baud),
                SerialLine(serial_baud),
            )
            for number, modem in modems.items()
        }
        # The modems' start-up sentences belong to this moment, not to the first event.
        self._step(self.now)

    def modem(self, number: int) -> EmulatedModem:
        """Return one modem."""
        return self._ports[number].modem

    def receive(self, number: int, data: bytes, now: float) -> None:
        """Put bytes from a host on its modem's serial line; `advance` delivers them."""
        port = self._ports[number]
        for line in data.splitlines(keepends=True):
            port.to_modem.put(line, len(line), max(now, self.now))

    def host_disconnected(self, number: int) -> None:
        """Drop the unfinished sentence of a host that has disconnected."""
        self._ports[number].modem.host_disconnected()

    def next_deadline_s(self) -> float:
        """Return the simulated time of the next event."""
        times_s: list[float | None] = [self.channel.next_event_s()]
        for port in self._ports.values():
            times_s += [port.modem.next_deadline_s(), port.to_modem.next_s(), port.to_host.next_s()]
        return min(time_s for time_s in times_s if time_s is not None)

    def advance(self, now: float) -> list[TransmittedPacket | PacketReport]:
        """Process all events up to `now`.

        Returns:
            Every transmitted packet, and the reports of received packets that are not shown to the host. The other
            reports come with `take_outputs`, together with their bytes.
        """
        happened: list[TransmittedPacket | PacketReport] = []
        while (due_s := self.next_deadline_s()) <= now:
            happened += self._step(max(due_s, self.now))
        self.now = max(self.now, now)
        return happened

    def take_outputs(self, number: int) -> list[HostOutput]:
        """Remove and return the output of a modem's serial line up to the last `advance`."""
        port = self._ports[number]
        outputs, port.outputs = port.outputs, []
        return outputs

    def discard_outputs(self, number: int) -> list[HostOutput]:
        """Remove and return the output of a modem, including the part still on its serial line."""
        return self.take_outputs(number) + self._ports[number].to_host.discard()

    def _step(self, now: float) -> list[TransmittedPacket | PacketReport]:
        """Process the events at `now`; none is earlier."""
        self.now = now
        happened: list[TransmittedPacket | PacketReport] = []
        for event in self.channel.poll(now):
            modem = self._ports[event.receiver].modem
            if isinstance(event, ArrivalStarted):
                modem.arrival_started(event)
                continue
            report = modem.arrival_ended(event)
            if report.unreported_reason is not None:
                happened.append(report)
        for number, port in self._ports.items():
            for data in port.to_modem.take(now):
                port.modem.receive(data, now)
            port.modem.poll(now)
            happened += [self.channel.transmit(number, packet, now) for packet in port.modem.packets_to_transmit()]
            for output in port.modem.take_outputs():
                port.to_host.put(output, len(output.data), now)
            port.outputs += port.to_host.take(now)
        return happened
