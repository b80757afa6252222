"""Two of the project's drivers on two emulated modems, on simulated time, with serial lines that a test can spoil."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from sonarpost.modem.micromodem import MicroModem, MicroModemConfig, ModemEvent, nmea
from sonarpost.simulation.channel.acoustics import LocalPosition
from sonarpost.simulation.channel.parameters import ChannelParameters
from sonarpost.simulation.channel.simulator import ChannelSimulator, PlacedModem
from sonarpost.simulation.modem.settings import EmulatedModemConfig

Spoil = Callable[[bytes], bytes]


def drop(line: bytes) -> bytes:
    """Lose the sentence."""
    return b""


def garble(line: bytes) -> bytes:
    """Damage one byte in the middle of it."""
    middle = len(line) // 2
    return line[:middle] + bytes([line[middle] ^ 0x04]) + line[middle + 1 :]


def cut(line: bytes) -> bytes:
    """Lose its second half, line end and all."""
    return line[: len(line) // 2]


def double(line: bytes) -> bytes:
    """Say it twice."""
    return line + line


@dataclass
class Passed:
    """One sentence on a serial line: which host's, and in which direction."""

    host: int
    to_modem: bool
    line: bytes


@dataclass
class TwoDrivers:
    """The rig.

    Attributes:
        spoil_number: Which of the sentences from `arm` on is spoiled, from 0; None for none.
        spoil: How.
        mishap: What happens besides, when that sentence passes.
    """

    spoil_number: int | None = None
    spoil: Spoil = drop
    mishap: Callable[[TwoDrivers], None] | None = None
    generation: int = 2
    water: ChannelParameters = field(default_factory=ChannelParameters)
    config: Callable[[int], MicroModemConfig] = MicroModemConfig

    def __post_init__(self) -> None:
        places = {n: PlacedModem(EmulatedModemConfig(n, self.generation), LocalPosition(150.0 * n)) for n in (1, 2)}
        self.world = ChannelSimulator(self.water, places)
        self.drivers = {n: MicroModem(self.config(n)) for n in (1, 2)}
        self.events: dict[int, list[ModemEvent]] = {1: [], 2: []}
        self.passed: list[Passed] = []
        self.armed = False
        self.spoiled: Passed | None = None
        self.now = 0.0
        self.ports_back: list[tuple[float, int]] = []
        for driver in self.drivers.values():
            driver.start(0.0)

    def arm(self) -> None:
        """Count sentences from now on."""
        self.passed.clear()
        self.armed = True

    def run(self, until_s: float, done: Callable[[], bool] = lambda: False) -> bool:
        """Let everything happen, from event to event, until a time or until something holds."""
        while self.now < until_s:
            self._exchange()
            if done():
                return True
            times_s = [self.world.next_deadline_s(), *(d.next_wakeup() or until_s for d in self.drivers.values())]
            times_s += [at_s for at_s, _ in self.ports_back]
            # A modem's answer to what it was told a moment ago must not wait for the next event.
            self.now = min(until_s, max(min(times_s), self.now + 0.001))
        self._exchange()
        return done()

    def got(self, host: int, *kinds: type) -> list[ModemEvent]:
        """The events of some types at a host."""
        return [event for event in self.events[host] if isinstance(event, kinds)]

    def unplug(self, host: int, for_s: float) -> None:
        """Take a host's port away for some time."""
        self.drivers[host].port_lost(self.now)
        self.ports_back.append((self.now + for_s, host))

    def _exchange(self) -> None:
        for at_s, host in [back for back in self.ports_back if back[0] <= self.now]:
            self.ports_back.remove((at_s, host))
            self.drivers[host].port_opened(self.now)
        for n, driver in self.drivers.items():
            self.events[n] += driver.poll(self.now)
            for line in driver.bytes_to_send().splitlines(keepends=True):
                self.world.receive(n, self._through(Passed(n, True, line)), self.now)
        self.world.advance(self.now)
        for n, driver in self.drivers.items():
            for output in self.world.take_outputs(n):
                self.events[n] += driver.receive(self._through(Passed(n, False, output.data)), self.now)

    def _through(self, passed: Passed) -> bytes:
        if not self.armed:
            return passed.line
        number = len(self.passed)
        self.passed.append(passed)
        if number != self.spoil_number:
            return passed.line
        self.spoiled = passed
        if self.mishap is not None:
            self.mishap(self)
        return self.spoil(passed.line)


def kinds_of(passed: list[Passed]) -> list[str]:
    """The kinds of sentences that have passed."""
    items = nmea.LineAssembler().feed(b"".join(each.line for each in passed))
    return [item.kind for item in items if isinstance(item, nmea.Sentence)]
