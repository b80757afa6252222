"""Two drivers on two emulated modems, on simulated time, with faults on the serial lines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from sonarpost.extensions.simulation.channel.acoustics import LocalPosition
from sonarpost.extensions.simulation.channel.parameters import ChannelParameters
from sonarpost.extensions.simulation.channel.simulator import ChannelSimulator, PlacedModem
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig
from sonarpost.modem.interface import ModemEvent
from sonarpost.modem.micromodem import MicroModem, MicroModemConfig, nmea

Fault = Callable[[bytes], bytes]


def drop(line: bytes) -> bytes:
    """Lose the sentence."""
    return b""


def corrupt(line: bytes) -> bytes:
    """Change one bit in the middle of the sentence."""
    middle = len(line) // 2
    return line[:middle] + bytes([line[middle] ^ 0x04]) + line[middle + 1 :]


def truncate(line: bytes) -> bytes:
    """Lose the second half with the line end."""
    return line[: len(line) // 2]


def duplicate(line: bytes) -> bytes:
    """Repeat the sentence."""
    return line + line


@dataclass
class LineSentence:
    """One sentence on a serial line: its host and direction."""

    host: int
    to_modem: bool
    line: bytes


@dataclass
class TwoDrivers:
    """Two drivers, two modems and the lines between them.

    Attributes:
        fault_number: Number (from 0, after `start_counting`) of the sentence with the fault; None for none.
        fault: The fault.
        disturbance: Called when that sentence is transferred.
    """

    fault_number: int | None = None
    fault: Fault = drop
    disturbance: Callable[[TwoDrivers], None] | None = None
    generation: int = 2
    parameters: ChannelParameters = field(default_factory=ChannelParameters)
    config: Callable[[int], MicroModemConfig] = MicroModemConfig

    def __post_init__(self) -> None:
        places = {n: PlacedModem(EmulatedModemConfig(n, self.generation), LocalPosition(150.0 * n)) for n in (1, 2)}
        self.simulator = ChannelSimulator(self.parameters, places)
        self.drivers = {n: MicroModem(self.config(n)) for n in (1, 2)}
        self.events: dict[int, list[ModemEvent]] = {1: [], 2: []}
        self.transferred: list[LineSentence] = []
        self.counting = False
        self.faulty: LineSentence | None = None
        self.now = 0.0
        self.reopening_ports: list[tuple[float, int]] = []
        for driver in self.drivers.values():
            driver.port_opened(0.0)

    def start_counting(self) -> None:
        """Count sentences from now on; the fault applies to the one with the given number."""
        self.transferred.clear()
        self.counting = True

    def run(self, until_s: float, done: Callable[[], bool] = lambda: False) -> bool:
        """Run from event to event until a time, or until a condition holds."""
        while self.now < until_s:
            self._exchange()
            if done():
                return True
            times_s = [self.simulator.next_deadline_s(), *(d.next_wakeup() or until_s for d in self.drivers.values())]
            times_s += [at_s for at_s, _ in self.reopening_ports]
            # The next step follows within 1 ms, so that an answer of a modem does not wait for the next event.
            self.now = min(until_s, max(min(times_s), self.now + 0.001))
        self._exchange()
        return done()

    def events_of(self, host: int, *kinds: type) -> list[ModemEvent]:
        """Return the events of some types at a host."""
        return [event for event in self.events[host] if isinstance(event, kinds)]

    def unplug(self, host: int, for_s: float) -> None:
        """Remove the port of a host for some time."""
        self.drivers[host].port_lost(self.now)
        self.reopening_ports.append((self.now + for_s, host))

    def _exchange(self) -> None:
        for at_s, host in [port for port in self.reopening_ports if port[0] <= self.now]:
            self.reopening_ports.remove((at_s, host))
            self.drivers[host].port_opened(self.now)
        for n, driver in self.drivers.items():
            self.events[n] += driver.poll(self.now)
            for line in driver.bytes_to_send().splitlines(keepends=True):
                self.simulator.receive(n, self._transfer(LineSentence(n, True, line)), self.now)
        self.simulator.advance(self.now)
        for n, driver in self.drivers.items():
            for output in self.simulator.take_outputs(n):
                self.events[n] += driver.receive(self._transfer(LineSentence(n, False, output.data)), self.now)

    def _transfer(self, sentence: LineSentence) -> bytes:
        if not self.counting:
            return sentence.line
        number = len(self.transferred)
        self.transferred.append(sentence)
        if number != self.fault_number:
            return sentence.line
        self.faulty = sentence
        if self.disturbance is not None:
            self.disturbance(self)
        return self.fault(sentence.line)


def kinds_of(sentences: list[LineSentence]) -> list[str]:
    """Return the kinds of the transferred sentences."""
    items = nmea.LineAssembler().feed(b"".join(each.line for each in sentences))
    return [item.kind for item in items if isinstance(item, nmea.Sentence)]
