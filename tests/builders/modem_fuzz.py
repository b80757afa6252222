"""Fuzzes the NMEA parser and the driver with inputs of bytes, and checks their invariants.

`PYTHONPATH=tests python -m builders.modem_fuzz --lines 1000000 --seed 1` processes a million random lines; the test
suite some thousands, and `run_atheris.py` is guided by coverage.

An input is a list of steps, each with one byte for its kind and the time before it, and one for the length of the rest.
Lines are recorded from real exchanges, or composed of every kind of sentence with likely and unlikely fields. Some are
damaged: bytes flipped, lost or duplicated, lines truncated, joined or repeated.
"""

# ruff: noqa: SIM905 - lists of this length are harder to read

import argparse
import random
import time
from collections.abc import Iterator
from contextlib import suppress
from functools import cache

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
REQUEST, RAW, REAL, COMPOSED, DAMAGED_REAL, DAMAGED_COMPOSED, CHECKED = range(7)
"""Kinds of steps: the three low bits of the first byte. The next two select a time of `PAUSES_S`."""
PAUSES_S = (0.0, 0.01, 0.5, 7.0)
NOT_READY = 0x80
"""In the first byte of an input: the driver has not configured its modem."""
MOST_STEPS = 1000
INPUT_LINES = 500
MAX_BYTES_TO_SEND = 1 << 20


def steps(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the first byte and the rest of each step of an input."""
    at = 0
    for _ in range(MOST_STEPS):
        if at + 2 > len(data):
            return
        kind, length = data[at], data[at + 1]
        yield kind, data[at + 2 : at + 2 + length]
        at += 2 + length


def check(data: bytes) -> int:
    """Pass lines to a driver and to the parser alone; return the number of sentences.

    Packets are requested between the lines. Each request ends once, and a modem that answers again is used again.

    Raises:
        AssertionError: A property does not hold.
    """
    driver, parser = MicroModem(MicroModemConfig(1)), nmea.LineAssembler()
    driver.set_poll_handler(lambda polled: [b"x" * min(3, polled.frame_bytes)] * (polled.frames // 2))
    now, taken, requested, ended = 0.0, 0, [], []
    driver.port_opened(now)
    if not data[:1] or data[0] < NOT_READY:
        _make_ready(driver)
    for kind, body in steps(data):
        now += PAUSES_S[kind >> 3 & 3]
        if kind & 7 == REQUEST:
            requested.append(_send_request(driver, body.ljust(3, b"\0"), now))
        else:
            line = line_of(kind & 7, body)
            with suppress(SentenceError):
                sentence = nmea.parse(line)
                assert nmea.parse(sentence.encode()) == sentence, "a parsed sentence formats to itself"
            taken += sum(isinstance(item, nmea.Sentence) for item in parser.feed(line))
            ended += [e for e in driver.receive(line, now) if isinstance(e, ENDS)]
        ended += [e for e in driver.poll(now) if isinstance(e, ENDS)]
        _check(driver, parser, now)
    _recover(driver, now, requested, ended)
    return taken


def _check(driver: MicroModem, parser: nmea.LineAssembler, now: float) -> None:
    assert parser.pending_bytes <= nmea.MAX_SENTENCE_BYTES
    assert driver.queued <= driver.config.queued_packets + 1
    out = driver.bytes_to_send()
    assert len(out) < MAX_BYTES_TO_SEND
    for item in nmea.LineAssembler().feed(out):
        assert isinstance(item, nmea.Sentence), "the driver writes complete sentences"
    wakeup_s = driver.next_wakeup()
    assert wakeup_s is None or wakeup_s > now, "nothing is due after a poll"


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


def _make_ready(driver: MicroModem) -> None:
    for _ in range(20):
        for item in nmea.LineAssembler().feed(driver.bytes_to_send()):
            assert isinstance(item, nmea.Sentence)
            value = item.fields[1] if item.kind == "CCCFG" else "1"
            driver.receive(nmea.format("CACFG", item.fields[0], value), 0.0)
    assert driver.ready


def _send_request(driver: MicroModem, body: bytes, now: float) -> int:
    """Send a request of one of three kinds; return its number."""
    rate = (0, 1, 4)[body[2] % 3]
    match body[0] % 5:
        case 0:
            return driver.ping(2, now)
        case 1:
            return driver.request_packet(2, rate, now=now)
        case _:
            return driver.send_packet(2, rate, [body[3:35] or b"ab"], ack=body[1] % 2 == 0, now=now)


@cache
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


def line_of(kind: int, body: bytes) -> bytes:
    """Return the line or lines of a step."""
    real = real_lines()
    match kind:
        case 2:
            return b"".join(real[number % len(real)] for number in body[:8])
        case 3:
            fields = [LIKELY[number % len(LIKELY)] for number in body[1:10]]
            return nmea.format(KINDS[sum(body[:1]) % len(KINDS)], *fields)
        case 4 | 5 if len(body) > 3:
            how, at, other = body[:3]
            return _damaged(line_of(kind - 2, body[3:]), how, at, real[other % len(real)])
        case 6:
            return with_checksum(b"$" + body)
        case _:
            return body


def with_checksum(start: bytes) -> bytes:
    """Return a line with its checksum, whether or not its text can have one."""
    total = 0
    for byte in start[1:]:
        total ^= byte
    return start + b"*%02X\r\n" % total


def _damaged(line: bytes, how: int, at: int, other: bytes) -> bytes:
    bit, at = 1 << at % 8, at % len(line)
    fields = line.split(b"*")[0].split(b",")
    fields[1:] = [LIKELY[how % len(LIKELY)].encode() if n == at % 10 else f for n, f in enumerate(fields[1:])]
    return (
        line[:at] + bytes([line[at] ^ bit]) + line[at + 1 :],
        line[:at] + line[at + 1 :],
        line[:at] + line[at : at + 4] + line[at:],
        line[:at],
        line[:at] + other,
        line + line,
        line.split(b"*")[0] + b"\r\n",
        with_checksum(b",".join(fields)),
    )[how % 8]


def seeds() -> Iterator[bytes]:
    """Yield first inputs that cover genuine traffic."""
    lines = real_lines()
    for first in range(0, len(lines), 8):
        asked = bytes([0, 3, first % 256, 1, 2])
        yield asked + bytes([2, 8, *(n % 256 for n in range(first, first + 8))])
        yield asked + b"".join(
            bytes([CHECKED | 1 << 3, len(body)]) + body
            for line in lines[first : first + 8]
            if len(body := line[1:].split(b"*")[0]) < 256
        )


def random_input(rng: random.Random, lines: int = INPUT_LINES) -> bytes:
    """Return an input with this number of steps, a fiftieth of them requests."""
    kinds = rng.choices(range(6), (2, 5, 26, 29, 18, 20), k=lines)
    longest = {REQUEST: 8, RAW: 79, REAL: 1, COMPOSED: 10, DAMAGED_REAL: 4, DAMAGED_COMPOSED: 13}
    data = bytearray()
    for kind in kinds:
        shortest = longest[kind] if kind in (REAL, DAMAGED_REAL) else 0
        body = rng.randbytes(rng.randint(shortest, longest[kind]))
        data += bytes([kind | rng.choice((0, 0, 1, 2, 3)) << 3, len(body)]) + body
    data[0] |= NOT_READY * (rng.random() < 0.2)
    return bytes(data)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lines", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parsed = parser.parse_args()
    rng, started_s = random.Random(parsed.seed), time.monotonic()
    taken = sum(check(random_input(rng)) for _ in range(parsed.lines // INPUT_LINES))
    print(f"{parsed.lines} lines, {taken} sentences; {time.monotonic() - started_s:.0f} s")


if __name__ == "__main__":
    main()
