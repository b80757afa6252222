"""Two stations on the simulated water; the line between one driver and its modem is hostile. Simulated time only."""

from __future__ import annotations

import heapq
import itertools
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from sonarpost.extensions.simulation.channel.acoustics import LocalPosition
from sonarpost.extensions.simulation.channel.parameters import build_parameters
from sonarpost.extensions.simulation.channel.simulator import ChannelSimulator, PlacedModem
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig
from sonarpost.modem.interface import FrameReceived, Modem, ModemEvent, PacketFailed, PacketSent
from sonarpost.modem.registry import ModemSettings, modem_driver

HOSTILE, PEER = 1, 2
Parts = list[tuple[float, bytes]]
"""What becomes of one message: parts, each with a delay in seconds."""

# Names of conditions that a driver may declare as not applicable.
DUMPS = ("configuration dump every 30 s", "dump after the echo", "start in a dump")
DATA_REQUESTS = ("data requests lost", "echo of the data late", "echo of the data never")
RESTARTS = ("restart after the echo", "restart after the data", "restart on the air", "restart while receiving")
RESTARTS += ("restarts when idle", "killed with restarts")
REPORTS = ("ends of transmissions lost", "ends and statistics of transmissions lost", "statistics doubled")
REPORTS += ("start of the transmission never", "statistics never", "start of the reception never")
REPORTS += ("reports of transmissions off",)
FALSE_RECEPTIONS = ("false receptions", "false receptions every second", "false receptions that time out")
COMMANDS = ("echo of the command late", "echo of the command never", "mostly busy", "all commands refused")
COMMANDS += ("errors and messages every second", "unknown sentences")
PADDED = ("padded and blank frames",)


@dataclass
class Subject:
    """What the bench needs to know about a driver under test.

    Attributes:
        kind_of: Name of a message from the modem, as `CARXD`.
        split: Divides the bytes from the modem into messages.
        restart: Bytes that restart the modem; b"" if it cannot be restarted.
        refusal: Kind of a message that accepts a command, and the message that refuses it instead.
        reception: Messages about a reception: its start, and a failed end.
        unknown: A message that no modem sends.
        not_applicable: Conditions that make no sense for this driver, by reason.
        rate: Rate of the packets; None for the driver's first one.
    """

    driver: str
    kind_of: Callable[[bytes], str]
    split: Callable[[bytes], list[bytes]]
    restart: bytes = b""
    refusal: tuple[str, bytes] = ("", b"")
    reception: tuple[bytes, bytes] = (b"", b"")
    unknown: bytes = b""
    not_applicable: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    rate: int | None = None

    @property
    def exceptions(self) -> set[str]:
        """Names of the conditions that make no sense."""
        return {name for names in self.not_applicable.values() for name in names}

    @property
    def name(self) -> str:
        """Name in the tests."""
        return self.driver if self.rate is None else f"{self.driver}-rate-{self.rate}"


class Condition:
    """A hostile condition; the default passes everything on.

    Attributes:
        bench: The bench, set when the condition begins.
        rng: Seeded draws.
    """

    bench: Bench
    rng: random.Random

    def begin(self) -> None:
        """Act when the condition begins."""

    def tick(self) -> None:
        """Act once a simulated second."""

    def to_host(self, message: bytes, kind: str) -> Parts:
        """Return what the driver receives of a message of its modem."""
        return [(0.0, message)]

    def to_modem(self, data: bytes) -> bytes:
        """Return what the modem receives of the driver's bytes."""
        return data


class Bench:
    """Drivers, emulated modems and the hostile line.

    Args:
        subject: The driver under test.
        seed: Seed of the condition.
    """

    def __init__(self, subject: Subject, seed: int = 1) -> None:
        self.subject = subject
        self.rng = random.Random(seed)
        self.now = 0.0
        modems = {
            number: PlacedModem(
                EmulatedModemConfig(number, utc_at_zero_s=1.5e9, driver=subject.driver), LocalPosition(100.0 * number)
            )
            for number in (HOSTILE, PEER)
        }
        self.simulator = ChannelSimulator(build_parameters({}, "test"), modems)
        self.drivers = {number: self.new_driver(number) for number in modems}
        self.events: dict[int, list[ModemEvent]] = {number: [] for number in modems}
        self.condition: Condition | None = None
        self.is_open = True
        self.open_packets: dict[int, set[int]] = {number: set() for number in modems}
        self.sent: dict[int, list[bytes]] = {number: [] for number in modems}
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._number = itertools.count(1)
        for driver in self.drivers.values():
            driver.port_opened(0.0)

    def new_driver(self, number: int) -> Modem:
        """Return a new driver of a station."""
        return modem_driver(self.subject.driver).create(ModemSettings(number, stream=True), "test port")

    def later(self, delay_s: float, action: Callable[[], None]) -> None:
        """Do something after a delay."""
        heapq.heappush(self._due, (self.now + delay_s, next(self._order), action))

    def inject(self, data: bytes) -> None:
        """Give bytes to the hostile driver, as if its modem had sent them."""
        if self.is_open:
            self._keep(HOSTILE, self.drivers[HOSTILE].receive(data, self.now))

    def close_port(self, duration_s: float) -> None:
        """Take the port away for a time."""
        if self.is_open:
            self.is_open = False
            self.drivers[HOSTILE].port_lost(self.now)
            self.later(duration_s, self._reopen)

    def _reopen(self) -> None:
        self.is_open = True
        self.drivers[HOSTILE].port_opened(self.now)

    def kill(self) -> None:
        """Replace the driver by a new one, as after a crash of its process."""
        self.open_packets[HOSTILE].clear()
        self.drivers[HOSTILE] = self.new_driver(HOSTILE)
        if self.is_open:
            self.drivers[HOSTILE].port_opened(self.now)

    def restart_modem(self) -> None:
        """Restart the hostile modem."""
        self.simulator.receive(HOSTILE, self.subject.restart, self.now)

    def offer(self, number: int) -> None:
        """Send a packet from a station that has none in progress."""
        if self.open_packets[number]:
            return
        data = b"%d packet %06d" % (number, next(self._number)) + bytes(10)
        driver = self.drivers[number]
        self.sent[number].append(data)
        rate = driver.capabilities.uplink_rate if self.subject.rate is None else self.subject.rate
        # The result may come at once, so the number is stored before the events are read.
        packet_id = driver.send_packet(3 - number, rate, [data], now=self.now)
        self.open_packets[number].add(packet_id)
        self._keep(number, driver.poll(self.now))

    def received(self, number: int) -> list[bytes]:
        """Return the data that a station has received, without padding."""
        return [e.data.rstrip(b"\0") for e in self.events[number] if isinstance(e, FrameReceived)]

    def run(self, duration_s: float, condition: Condition | None = None) -> None:
        """Run both stations with traffic both ways, under a condition."""
        until_s = self.now + duration_s
        if condition is not None:
            condition.bench, condition.rng = self, self.rng
            self.condition = condition
            condition.begin()
        next_tick_s = self.now
        while self.now < until_s:
            if self.now >= next_tick_s:
                next_tick_s += 1.0
                if condition is not None:
                    condition.tick()
                # In turns, because two stations that transmit at the same time do not receive.
                second = round(next_tick_s) % 30
                if second < 12:
                    self.offer(HOSTILE)
                elif second == 21:
                    self.offer(PEER)
            self._exchange()
            self.now = min(until_s, next_tick_s, max(self.now + 0.001, self._next_s()))
        self.condition = None

    def _next_s(self) -> float:
        times = [self.simulator.next_deadline_s()]
        times += [time_s for driver in self.drivers.values() if (time_s := driver.next_wakeup()) is not None]
        times += [self._due[0][0]] if self._due else []
        return min(times)

    def _exchange(self) -> None:
        while self._due and self._due[0][0] <= self.now:
            heapq.heappop(self._due)[2]()
        for number, driver in self.drivers.items():
            if number == PEER or self.is_open:
                self._keep(number, driver.poll(self.now))
            while data := driver.bytes_to_send():
                self._write(number, data)
        self.simulator.advance(self.now)
        for output in self.simulator.take_outputs(PEER):
            self._keep(PEER, self.drivers[PEER].receive(output.data, self.now))
        for output in self.simulator.take_outputs(HOSTILE):
            for message in self.subject.split(output.data):
                condition = self.condition or Condition()
                for delay_s, part in condition.to_host(message, self.subject.kind_of(message)):
                    self._deliver(delay_s, part)

    def _write(self, number: int, data: bytes) -> None:
        if number == HOSTILE and self.condition is not None:
            data = self.condition.to_modem(data)
        if data and (number == PEER or self.is_open):
            self.simulator.receive(number, data, self.now)

    def _deliver(self, delay_s: float, part: bytes) -> None:
        if delay_s <= 0:
            self.inject(part)
        else:
            self.later(delay_s, lambda: self.inject(part))

    def _keep(self, number: int, events: list[ModemEvent]) -> None:
        self.events[number] += events
        for event in events:
            if isinstance(event, (PacketSent, PacketFailed)):
                # A poll of the far modem and a packet of a killed driver have other numbers.
                assert event.packet_id in self.open_packets[number], "exactly one result for each packet"
                self.open_packets[number].discard(event.packet_id)
