"""Contract of every modem driver: 45 hostile conditions between the driver and its modem.

Under each condition the driver raises nothing, gives exactly one result for every packet, and passes on no data that no
station has sent. Soon after the condition ends, packets travel in both directions again. The conditions are those of a
check of the Micro-Modem driver against hostile modems; a driver declares those that make no sense for it.
"""

from collections.abc import Callable

import pytest
from builders.extensions import modules
from builders.hostile_line import (
    COMMANDS,
    DATA_REQUESTS,
    DUMPS,
    FALSE_RECEPTIONS,
    HOSTILE,
    PADDED,
    PEER,
    REPORTS,
    RESTARTS,
    Bench,
    Condition,
    Parts,
    Subject,
)

from sonarpost.errors import ConfigError
from sonarpost.modem.interface import ModemReady, PacketFailed, PacketSent
from sonarpost.modem.micromodem import nmea
from sonarpost.modem.registry import ModemSettings, default_registry, modem_driver

CONDITION_S = 90.0
RECOVERY_S = 240.0


def lines(data: bytes) -> list[bytes]:
    return data.splitlines(keepends=True)


def sentence_kind(message: bytes) -> str:
    return message[1:6].decode("ascii", "replace")


UDP_NOT_APPLICABLE = {
    "the driver has no dialogue with a modem": (*DUMPS, *DATA_REQUESTS, *PADDED, *REPORTS, *COMMANDS),
    "there is no modem that can restart": RESTARTS,
    "the driver senses no carrier": FALSE_RECEPTIONS,
}


SUBJECTS = [
    Subject(
        "micromodem",
        sentence_kind,
        lines,
        restart=nmea.format("CCMSC", HOSTILE, HOSTILE, 0),
        refusal=("CACYC", nmea.format("CAERR", "000000", "CYCLE", 4, "busy")),
        reception=(nmea.format("CARXP", 1), nmea.format("CAMSG", "PACKET_TIMEOUT", 1)),
        unknown=nmea.format("CAXYZ", 1, 2, 3),
    ),
    Subject("udp", lambda message: "datagram", lambda data: [data], not_applicable=UDP_NOT_APPLICABLE),
    *(subject for module in modules("modem_subjects") for subject in module.SUBJECTS),
]


class Drop(Condition):
    """Drop messages of some kinds, or of all, with a probability."""

    def __init__(self, probability: float, *kinds: str) -> None:
        self._probability, self._kinds = probability, kinds

    def to_host(self, message: bytes, kind: str) -> Parts:
        dropped = (not self._kinds or kind in self._kinds) and self.rng.random() < self._probability
        return [] if dropped else [(0.0, message)]


class Late(Condition):
    """Delay messages of some kinds, or all."""

    def __init__(self, delay_s: float, *kinds: str) -> None:
        self._delay_s, self._kinds = delay_s, kinds

    def to_host(self, message: bytes, kind: str) -> Parts:
        return [(self._delay_s if not self._kinds or kind in self._kinds else 0.0, message)]


class Doubled(Condition):
    """Repeat messages of some kinds, or all, at once or later."""

    def __init__(self, *kinds: str, delay_s: float = 0.0) -> None:
        self._kinds, self._delay_s = kinds, delay_s

    def to_host(self, message: bytes, kind: str) -> Parts:
        doubled = not self._kinds or kind in self._kinds
        return [(0.0, message), *([(self._delay_s, message)] if doubled else [])]


class Deaf(Condition):
    """The modem does not read."""

    def to_modem(self, data: bytes) -> bytes:
        return b""


class Every(Condition):
    """Do something at an interval in seconds."""

    def __init__(self, interval_s: float, action: Callable[[Condition], None]) -> None:
        self._interval_s, self._action, self._next_s = interval_s, action, 0.0

    def tick(self) -> None:
        if self.bench.now >= self._next_s:
            self._next_s = self.bench.now + self._interval_s
            self._action(self)


class RestartAfter(Condition):
    """Restart the modem some time after a message."""

    def __init__(self, delay_s: float, probability: float, *kinds: str) -> None:
        self._delay_s, self._probability, self._kinds = delay_s, probability, kinds

    def to_host(self, message: bytes, kind: str) -> Parts:
        if kind in self._kinds and self.rng.random() < self._probability:
            self.bench.later(self._delay_s, self.bench.restart_modem)
        return [(0.0, message)]


class Cut(Condition):
    """Lose the end of some messages."""

    def to_host(self, message: bytes, kind: str) -> Parts:
        return [(0.0, message[: self.rng.randrange(len(message))] if self.rng.random() < 0.15 else message)]


class Garbage(Condition):
    """Random bytes between the messages, twice a second."""

    def tick(self) -> None:
        for _ in range(2):
            self.bench.inject(self.rng.randbytes(self.rng.randrange(1, 80)))


class Padded(Condition):
    """Zeros after the data of a frame, and frames without data."""

    def to_host(self, message: bytes, kind: str) -> Parts:
        if kind != "CARXD":
            return [(0.0, message)]
        fields = message[7 : message.index(b"*")].decode().split(",")
        blank = nmea.format("CARXD", *fields[:3], 2, "")
        return [(0.0, nmea.format("CARXD", *fields[:4], fields[4] + "00" * 8)), (0.0, blank)]


class NoChecks(Condition):
    """Messages without their check."""

    def to_host(self, message: bytes, kind: str) -> Parts:
        return [(0.0, message[:-5] + b"\r\n" if message.endswith(b"\r\n") else message[:-4] + bytes(4))]


class Refuse(Condition):
    """Commands are refused instead of echoed."""

    def __init__(self, probability: float) -> None:
        self._probability = probability

    def to_host(self, message: bytes, kind: str) -> Parts:
        accepted, refusal = self.bench.subject.refusal
        if kind == accepted and self.rng.random() < self._probability:
            return [(0.0, refusal)]
        return [(0.0, message)]


def dump(condition: Condition) -> None:
    """Send 100 settings over 6 seconds."""
    for number in range(100):
        line = nmea.format("CACFG", f"N{number:03d}", number)
        condition.bench.later(0.06 * number, lambda line=line: condition.bench.inject(line))


class DumpAfterEcho(Condition):
    """A dump of the settings after each echo of a command."""

    def to_host(self, message: bytes, kind: str) -> Parts:
        if kind == "CACYC":
            dump(self)
        return [(0.0, message)]


class StartInDump(Condition):
    """The process starts during a dump."""

    def begin(self) -> None:
        dump(self)
        self.bench.kill()


class Soak(Condition):
    """Everything that every driver has: losses, repetitions, cuts, garbage, a port that blinks."""

    def tick(self) -> None:
        if self.rng.random() < 0.05:
            self.bench.close_port(self.rng.choice((0.05, 2.0)))
        if self.rng.random() < 0.2:
            self.bench.inject(self.rng.randbytes(30))
        if self.rng.random() < 0.02 and self.bench.subject.restart:
            self.bench.restart_modem()

    def to_host(self, message: bytes, kind: str) -> Parts:
        draw = self.rng.random()
        if draw < 0.05:
            return []
        if draw < 0.1:
            return [(0.0, message[: len(message) // 2])]
        return [(0.0, message)] * (2 if draw < 0.15 else 1)


def chaos(condition: Condition) -> None:
    """Kill the driver and restart the modem in turn."""
    condition.bench.kill()
    condition.bench.later(3.0, condition.bench.restart_modem)


def errors(condition: Condition) -> None:
    """An error report and a message."""
    condition.bench.inject(nmea.format("CAERR", "000000", "AGC", 9, "odd") + nmea.format("CAMSG", "CLOCK_DRIFT", 1))


def reception_start(condition: Condition) -> None:
    """The start of a reception that does not end."""
    condition.bench.inject(condition.bench.subject.reception[0])


def false_reception(condition: Condition) -> None:
    """A reception that times out."""
    reception_start(condition)
    condition.bench.later(2.0, lambda: condition.bench.inject(condition.bench.subject.reception[1]))


CONDITIONS: dict[str, Callable[[], Condition]] = {
    "none": Condition,
    "configuration dump every 30 s": lambda: Every(30.0, dump),
    "dump after the echo": DumpAfterEcho,
    "start in a dump": StartInDump,
    "data requests lost": lambda: Drop(0.4, "CADRQ"),
    "ends of transmissions lost": lambda: Drop(0.6, "CATXF", "SENDEND", "DELIVERED"),
    "ends and statistics of transmissions lost": lambda: Drop(1.0, "CATXF", "CAXST", "SENDEND", "DELIVERED"),
    "restart after the echo": lambda: RestartAfter(0.0, 0.3, "CACYC", "*SENDIM", "*SEND"),
    "restart after the data": lambda: RestartAfter(0.0, 0.2, "CATXD"),
    "restart on the air": lambda: RestartAfter(0.5, 0.3, "CATXP", "SENDSTART"),
    "restart while receiving": lambda: RestartAfter(0.5, 0.3, "CARXP", "RECVSTART"),
    "restarts when idle": lambda: Every(20.0, lambda c: c.bench.restart_modem()),
    "errors and messages every second": lambda: Every(1.0, errors),
    "garbage": Garbage,
    "received frames doubled": lambda: Doubled("CARXD", "datagram", "RECVIM", "RECV", "#B"),
    "everything doubled": Doubled,
    "statistics doubled": lambda: Doubled("CACST", "RECVEND", "SENDEND", delay_s=0.2),
    "lines cut": Cut,
    "port vanishes for 2 s": lambda: Every(15.0, lambda c: c.bench.close_port(2.0)),
    "port blinks": lambda: Every(10.0, lambda c: c.bench.close_port(0.05)),
    "port gone for 30 s": lambda: Every(60.0, lambda c: c.bench.close_port(30.0)),
    "mute": lambda: Drop(1.0),
    "modem does not read": Deaf,
    "false receptions": lambda: Every(3.0, reception_start),
    "false receptions every second": lambda: Every(1.0, reception_start),
    "false receptions that time out": lambda: Every(3.0, false_reception),
    "echo of the command late": lambda: Late(7.0, "CACYC", "*SENDIM", "*SEND", "$B"),
    "echo of the data late": lambda: Late(6.0, "CATXD"),
    "everything 6 s late": lambda: Late(6.0),
    "unknown sentences": lambda: Every(1.0, lambda c: c.bench.inject(c.bench.subject.unknown)),
    "padded and blank frames": Padded,
    "no checksums": NoChecks,
    "mostly busy": lambda: Refuse(0.7),
    "all commands refused": lambda: Refuse(1.0),
    "packet reported twice": lambda: Doubled(
        "CARXP", "CACYC", "CARXD", "CACST", "datagram", "RECVIM", "RECV", "#B", delay_s=0.5
    ),
    "any message lost": lambda: Drop(0.15),
    "echo of the command never": lambda: Drop(1.0, "CACYC", "*SENDIM", "*SEND", "$B"),
    "echo of the data never": lambda: Drop(1.0, "CATXD"),
    "start of the transmission never": lambda: Drop(1.0, "CATXP", "SENDSTART"),
    "statistics never": lambda: Drop(1.0, "CACST", "RECVEND"),
    "start of the reception never": lambda: Drop(1.0, "CARXP", "RECVSTART"),
    "reports of transmissions off": lambda: Drop(1.0, "CATXP", "CATXF", "CAXST", "SENDSTART", "SENDEND"),
    "process killed": lambda: Every(15.0, lambda c: c.bench.kill()),
    "killed with restarts": lambda: Every(20.0, chaos),
    "everything": Soak,
}


def test_every_driver_is_tested_and_every_exception_is_a_condition() -> None:
    assert sorted({subject.driver for subject in SUBJECTS}) == list(default_registry().names())
    assert len(CONDITIONS) == 45
    assert all(subject.exceptions <= set(CONDITIONS) for subject in SUBJECTS)


CASES = [
    pytest.param(subject, name, id=f"{subject.name}-{name}")
    for subject in SUBJECTS
    for name in CONDITIONS
    if name not in subject.exceptions
]


@pytest.mark.parametrize(("subject", "name"), CASES)
def test_driver_withstands_a_hostile_modem(subject: Subject, name: str) -> None:
    bench = Bench(subject)
    bench.run(20.0)
    assert any(isinstance(event, ModemReady) for event in bench.events[HOSTILE])
    bench.run(CONDITION_S, CONDITIONS[name]())
    ended = {number: len(bench.events[number]) for number in bench.events}
    before = {number: set(bench.received(number)) for number in (HOSTILE, PEER)}
    bench.run(RECOVERY_S)
    assert bench.drivers[HOSTILE].ready
    for receiver, sender in ((PEER, HOSTILE), (HOSTILE, PEER)):
        received = set(bench.received(receiver))
        sent = {data.rstrip(b"\0") for data in bench.sent[sender]}
        assert received - {b""} <= sent, "no data that was not sent"
        assert len(received - before[receiver]) >= 3, f"station {receiver} receives again"
    results = [e for e in bench.events[HOSTILE][ended[HOSTILE] :] if isinstance(e, (PacketSent, PacketFailed))]
    assert sum(isinstance(event, PacketSent) for event in results) >= 3


@pytest.mark.parametrize("subject", SUBJECTS, ids=lambda subject: subject.name)
def test_driver_limits_its_queue_and_the_age_of_packets(subject: Subject) -> None:
    bench = Bench(subject)
    bench.run(20.0)
    driver = bench.drivers[HOSTILE]
    rate = driver.capabilities.uplink_rate if subject.rate is None else subject.rate
    bench.run(60.0)
    driver.port_lost(bench.now)
    driver.poll(bench.now)
    numbers = [driver.send_packet(PEER, rate, [b"x"], now=bench.now) for _ in range(40)]
    assert len(set(numbers)) == 40
    failed = [event for event in driver.poll(bench.now) if isinstance(event, PacketFailed)]
    assert 0 < len(failed) < 40
    assert driver.queued + len(failed) == 40
    failed += [event for event in driver.poll(bench.now + 3600.0) if isinstance(event, PacketFailed)]
    assert sorted(event.packet_id for event in failed) == numbers
    assert driver.queued == 0


@pytest.mark.parametrize("subject", SUBJECTS, ids=lambda subject: subject.name)
def test_driver_accepts_any_bytes_in_any_parts(subject: Subject) -> None:
    bench = Bench(subject)
    bench.run(5.0)
    for length in (1, 3, 70, 5000):
        for _ in range(50):
            bench.inject(bench.rng.randbytes(length))
    bench.run(RECOVERY_S)
    assert len(bench.received(PEER)) >= 3


@pytest.mark.parametrize("name", default_registry().names())
def test_address_of_the_modem_is_checked(name: str) -> None:
    limits = modem_driver(name).create(ModemSettings(1), "test port").capabilities
    for address in (limits.min_address - 1, limits.max_address + 1):
        with pytest.raises(ConfigError, match="address"):
            modem_driver(name).create(ModemSettings(address), "test port")
