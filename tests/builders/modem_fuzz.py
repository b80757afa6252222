"""Fuzzes the NMEA parser and the driver, and checks their invariants.

`PYTHONPATH=tests python -m builders.modem_fuzz --lines 1000000 --seed 1` processes a million lines; the test suite some
thousands. Lines are recorded from real exchanges, or composed of every kind of sentence with likely and unlikely
fields. Some are damaged: bytes flipped, lost or duplicated, lines truncated, joined or repeated. A seed determines the
lines.
"""

# ruff: noqa: SIM905 - lists of this length are harder to read

import argparse
import random
import time
from dataclasses import dataclass, field

from builders.two_drivers import TwoDrivers
from sonarpost.errors import SentenceError
from sonarpost.modem.interface import PacketFailed, PacketSent, RequestDone, RequestFailed
from sonarpost.modem.micromodem import MicroModem, MicroModemConfig, nmea

KINDS = (
    "CAREV CACFG CACLK CATMS CATMQ CATMG CACYC CADRQ CATXD CATXA CATXP CATXF CAXST CARXP CARXD CARXA CAMSG CACST CAACK "
    "CAERR CAMPC CAMPA CAMPR CAMUC CAMUA CAMUR CATDP CARDP CATOA CADQF SNTTA CCCYC GPRMC"
).split()
LIKELY = (
    "0 1 2 3 4 5 6 7 8 15 32 64 127 128 255 256 -1 AB 00FF 1ABC INIT AUV SRC CST RXP BAD_CRC PACKET_TIMEOUT "
    "DATA_TIMEOUT NMEA 120000 20250606230123.348554 2.0.27087 0.93.0.09 1;2;AABB 0;1;00 1;3;AABB 0.1000 1e308 nan inf"
).split()
ENDS = (PacketSent, PacketFailed, RequestDone, RequestFailed)
ROUND_LINES = 500
MAX_BYTES_TO_SEND = 1 << 20


@dataclass
class Fuzz:
    """One fuzz run.

    Attributes:
        seed: Seed of every random draw.
        lines: Number of lines so far.
        sentences_parsed: Number of lines that were valid sentences.
    """

    seed: int
    lines: int = 0
    sentences_parsed: int = 0
    real: list[bytes] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng = random.Random(self.seed)
        self.real = real_lines()

    def run(self, lines: int) -> None:
        """Process lines up to a total number, in rounds with a driver each.

        Raises:
            AssertionError: An invariant is violated.
        """
        while self.lines < lines:
            self._round(min(ROUND_LINES, lines - self.lines))

    def _round(self, count: int) -> None:
        driver = MicroModem(MicroModemConfig(1))
        driver.set_poll_handler(lambda polled: [b"x" * min(3, polled.frame_bytes)] * (polled.frames // 2))
        parser = nmea.LineAssembler()
        now, requested, ended = 0.0, [], []
        driver.port_opened(now)
        if self.rng.random() < 0.8:
            self._make_ready(driver)
        for _ in range(count):
            self.lines += 1
            line = self.line()
            self.sentences_parsed += sum(isinstance(item, nmea.Sentence) for item in parser.feed(line))
            if self.rng.random() < 0.02:
                data, ack, rate = b"ab", self.rng.random() < 0.5, self.rng.choice((0, 1, 4))
                requested.append(send_request(driver, self.rng.randrange(5), data, rate, now, ack=ack))
            events = driver.receive(line, now)
            now += self.rng.choice((0.0, 0.0, 0.01, 0.5, 7.0))
            events += driver.poll(now)
            ended += [e for e in events if isinstance(e, ENDS)]
            self._check(driver, parser, now)
        self._recover(driver, now, requested, ended)

    @staticmethod
    def _check(driver: MicroModem, parser: nmea.LineAssembler, now: float) -> None:
        assert parser.pending_bytes <= nmea.MAX_SENTENCE_BYTES
        assert driver.queued <= driver.config.queued_packets + 1
        out = driver.bytes_to_send()
        assert len(out) < MAX_BYTES_TO_SEND
        for item in nmea.LineAssembler().feed(out):
            assert isinstance(item, nmea.Sentence), "the driver writes complete sentences"
        wakeup_s = driver.next_wakeup()
        assert wakeup_s is None or wakeup_s > now, "nothing is due after a poll"

    @staticmethod
    def _recover(driver: MicroModem, now: float, requested: list[int], ended: list[object]) -> None:
        """Without further input every request ends once, and the driver becomes ready when the modem answers."""
        driver.receive(b"\r\n", now)
        for _ in range(400):
            now += 5.0
            ended += [e for e in driver.poll(now) if isinstance(e, ENDS)]
            for item in nmea.LineAssembler().feed(driver.bytes_to_send()):
                assert isinstance(item, nmea.Sentence)
                if item.kind == "CCCFG":
                    driver.receive(nmea.format("CACFG", *item.fields), now)
                elif item.kind == "CCCFQ":
                    driver.receive(nmea.format("CACFG", item.fields[0], 1), now)
        numbers = [getattr(e, "packet_id", None) or getattr(e, "request_id", None) for e in ended]
        assert len(numbers) == len(set(numbers)), "no request ends twice"
        assert set(requested) <= set(numbers), "every request ends"
        assert driver.ready
        assert not driver.receiving
        assert driver.queued == 0

    @staticmethod
    def _make_ready(driver: MicroModem) -> None:
        for _ in range(20):
            for item in nmea.LineAssembler().feed(driver.bytes_to_send()):
                assert isinstance(item, nmea.Sentence)
                value = item.fields[1] if item.kind == "CCCFG" else "1"
                driver.receive(nmea.format("CACFG", item.fields[0], value), 0.0)
        assert driver.ready

    def line(self) -> bytes:
        """Return the next line, possibly damaged."""
        draw = self.rng.random()
        if draw < 0.45:
            line = self.rng.choice(self.real)
        elif draw < 0.95:
            fields = [self.rng.choice(LIKELY) for _ in range(self.rng.randrange(10))]
            line = nmea.format(self.rng.choice(KINDS), *fields)
        else:
            return self.rng.randbytes(self.rng.randrange(80))
        return self._damaged(line) if self.rng.random() < 0.4 else line

    def _damaged(self, line: bytes) -> bytes:
        at = self.rng.randrange(len(line))
        other = self.rng.choice(self.real)
        return self.rng.choice(
            (
                line[:at] + bytes([line[at] ^ 1 << self.rng.randrange(8)]) + line[at + 1 :],
                line[:at] + line[at + 1 :],
                line[:at] + line[at : at + 4] + line[at:],
                line[:at],
                line[:at] + other,
                line + line,
                line.split(b"*")[0] + b"\r\n",
                nmea.format(*self._swapped(line)),
            )
        )

    def _swapped(self, line: bytes) -> list[str]:
        """Replace one field; the checksum stays correct."""
        fields = line[1:].split(b"*")[0].decode("ascii").split(",")
        if len(fields) > 1:
            fields[self.rng.randrange(1, len(fields))] = self.rng.choice(LIKELY)
        return fields


def send_request(driver: MicroModem, kind: int, data: bytes, rate: int, now: float, *, ack: bool) -> int:
    """Send a request of one of three kinds; return its number."""
    match kind:
        case 0:
            return driver.ping(2, now)
        case 1:
            return driver.request_packet(2, rate, now=now)
        case _:
            return driver.send_packet(2, rate, [data], ack=ack, now=now)


def real_lines() -> list[bytes]:
    """Return the sentences for a driver in an exchange of each kind."""
    rig = TwoDrivers()
    rig.drivers[2].set_poll_handler(lambda polled: [b"polled"])
    rig.start_counting()
    rig.run(10.0)
    for rate in (0, 1, 4):
        rig.drivers[1].send_packet(2, rate, [b"real"], ack=True, now=rig.now)
        rig.drivers[2].send_packet(1, rate, [b"back"], now=rig.now)
    rig.drivers[1].ping(2, rig.now)
    rig.drivers[2].request_packet(1, 1, now=rig.now)
    rig.run(150.0)
    return [passed.line for passed in rig.transferred if passed.host == 1 and not passed.to_modem]


def parse_alone(lines: list[bytes]) -> int:
    """Parse lines one by one and return the number of valid ones; only `SentenceError` may be raised."""
    valid = 0
    for line in lines:
        try:
            sentence = nmea.parse(line)
        except SentenceError:
            continue
        valid += 1
        assert nmea.parse(sentence.encode()) == sentence, "a parsed sentence formats to itself"
    return valid


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lines", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parsed = parser.parse_args()
    fuzz, started_s = Fuzz(parsed.seed), time.monotonic()
    fuzz.run(parsed.lines)
    valid = parse_alone([fuzz.line() for _ in range(parsed.lines // 10)])
    seconds = time.monotonic() - started_s
    alone = f"{valid} of {parsed.lines // 10} alone"
    print(f"{fuzz.lines} lines, {fuzz.sentences_parsed} taken as sentences, {alone}; {seconds:.0f} s")


if __name__ == "__main__":
    main()
