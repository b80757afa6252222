"""Emulated modems in one water: the whole simulated acoustic side, still without clock or port.

Whoever drives it passes bytes from the hosts in with `receive`, calls `advance` with the simulated time, and writes
what `take_outputs` returns. Everything that happens by itself happens at its own exact time, however late `advance` is
called, so a slow or jittery driver changes no result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType

from sonarpost.simulation.channel.acoustics import LocalPosition
from sonarpost.simulation.channel.channel_config import ChannelParameters
from sonarpost.simulation.channel.channel_events import ArrivalStarted, Transmission
from sonarpost.simulation.channel.propagation import ChannelModel
from sonarpost.simulation.modem.config import EmulatedModemConfig, HostOutput, PacketReport
from sonarpost.simulation.modem.emulator import EmulatedMicroModem
from sonarpost.simulation.modem.serial_timing import SerialLineTiming


@dataclass(frozen=True, slots=True)
class PlacedModem:
    """One modem and where it is."""

    config: EmulatedModemConfig
    position: LocalPosition = field(default_factory=LocalPosition)


@dataclass(slots=True)
class _Port:
    """A modem with the two directions of its serial line."""

    modem: EmulatedMicroModem
    to_modem: SerialLineTiming[bytes]
    to_host: SerialLineTiming[HostOutput]
    passed: list[HostOutput] = field(default_factory=list)


class ChannelSimulator:
    """Modems, their serial lines, and the water.

    Args:
        water: What the water does.
        modems: Each modem by its number.
        serial_baud: Speed of the serial lines, or None for lines without delay.
        transponders: Where the transponders for ranging are, by their letters A to D.
    """

    def __init__(
        self,
        water: ChannelParameters,
        modems: Mapping[int, PlacedModem],
        serial_baud: float | None = None,
        transponders: Mapping[str, LocalPosition] = MappingProxyType({}),
    ) -> None:
        self.now = 0.0
        self.water = ChannelModel(water, {number: place.position for number, place in modems.items()})
        self._ports = {
            number: _Port(
                EmulatedMicroModem(place.config, travel_times=partial(self.water.travel_times_s, number, transponders)),
                SerialLineTiming(serial_baud),
                SerialLineTiming(serial_baud),
            )
            for number, place in modems.items()
        }
        # What the modems say when they are switched on belongs to this moment, not to the first event.
        self._step(self.now)

    def modem(self, number: int) -> EmulatedMicroModem:
        """Return one modem.

        Raises:
            KeyError: No modem of that number.
        """
        return self._ports[number].modem

    def receive(self, number: int, data: bytes, now: float) -> None:
        """Put bytes from a host on its modem's serial line; `advance` acts on them."""
        port = self._ports[number]
        for piece in data.splitlines(keepends=True):
            port.to_modem.put(piece, len(piece), max(now, self.now))

    def forget_host(self, number: int) -> None:
        """The host of a modem went away."""
        self._ports[number].modem.forget_host()

    def next_deadline_s(self) -> float:
        """Return the simulated time at which `advance` has something to do."""
        times_s = [port.modem.next_deadline_s() for port in self._ports.values()]
        for port in self._ports.values():
            times_s += [time_s for time_s in (port.to_modem.next_s(), port.to_host.next_s()) if time_s is not None]
        water_s = self.water.next_event_s()
        return min(times_s if water_s is None else [*times_s, water_s])

    def advance(self, now: float) -> list[Transmission | PacketReport]:
        """Let everything happen up to `now`.

        Returns:
            Every packet put into the water, and of the packets that passed a modem the reports that its host is
            not told; the others come with `take_outputs`, when their bytes do.
        """
        happened: list[Transmission | PacketReport] = []
        while (due_s := self.next_deadline_s()) <= now:
            happened += self._step(max(due_s, self.now))
        self.now = max(self.now, now)
        return happened

    def take_outputs(self, number: int) -> list[HostOutput]:
        """Return, once, what has come out of a modem's serial line by the last `advance`."""
        port = self._ports[number]
        passed, port.passed = port.passed, []
        return passed

    def abandon_outputs(self, number: int) -> list[HostOutput]:
        """Return what has not come out of a modem's serial line, and drop it."""
        return self.take_outputs(number) + self._ports[number].to_host.abandon()

    def _step(self, now: float) -> list[Transmission | PacketReport]:
        """Let happen what happens at `now`, which no event lies before."""
        self.now = now
        happened: list[Transmission | PacketReport] = []
        for event in self.water.poll(now):
            modem = self._ports[event.receiver].modem
            if isinstance(event, ArrivalStarted):
                modem.packet_started(event)
                continue
            report = modem.packet_ended(event)
            if report.untold is not None:
                happened.append(report)
        for number, port in self._ports.items():
            for data in port.to_modem.take(now):
                port.modem.receive(data, now)
            port.modem.poll(now)
            happened += [self.water.transmit(number, packet, now) for packet in port.modem.packets_to_transmit()]
            for output in port.modem.take_outputs():
                port.to_host.put(output, len(output.data), now)
            port.passed += port.to_host.take(now)
        return happened
