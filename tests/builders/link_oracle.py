"""Properties of the acoustic link for any bytes: the v1 receiver, and the modem driver.

An input is a list of steps. Every step begins with one byte for its kind and one for its length.
"""

from collections.abc import Iterator
from functools import cache
from itertools import islice
from typing import Final

from builders import v1_fuzz
from builders.modem_fuzz import ENDS, LIKELY, Fuzz, real_lines, send_request
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.receiver import ImageUpdate, MessageReceived
from sonarpost.modem.micromodem import MicroModem, MicroModemConfig, nmea

VEHICLE: Final = 3
STRANGER: Final = 4
_GENUINE_FRAMES: Final = 250
_MOST_STEPS: Final = 200


def _steps(data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    for _ in range(_MOST_STEPS):
        if at + 2 > len(data):
            return
        kind, length = data[at], data[at + 1]
        yield kind, data[at + 2 : at + 2 + length]
        at += 2 + length


@cache
def _genuine() -> tuple[bytes, ...]:
    return tuple(islice(v1_fuzz.genuine(1), _GENUINE_FRAMES))


def check_receiver(data: bytes) -> int:
    """Pass frames to a receiver; return the number of image updates and messages.

    A stranger sends the input's bytes, with correct checksums or without. Between them, genuine frames of a vehicle
    arrive in any order and number; updates of the vehicle must hold what it sent. Feedback, the state and its bounds
    are checked at the end.

    Raises:
        AssertionError: A property does not hold.
    """
    receiver, now, reported = V1Receiver(v1_fuzz.SMALL), 0.0, 0
    for kind, body in _steps(data):
        now += (0.0, 1.0, 70.0, 4000.0)[kind >> 2 & 3]
        if kind & 3 == 0:
            frames = [(VEHICLE, _genuine()[number % _GENUINE_FRAMES]) for number in body]
        elif kind & 3 == 1:
            frames = [(STRANGER, body)]
        else:
            frames = [(STRANGER, bytes(v1_fuzz.with_checksum(body)))]
        for source, frame in frames:
            for event in receiver.accept(source, frame, now):
                assert source == STRANGER or v1_fuzz.is_right(event), f"reported but never sent: {event}"
                reported += isinstance(event, ImageUpdate | MessageReceived)
        for source in receiver.sources:
            if receiver.feedback_is_due(source, now):
                feedback = receiver.feedback(source, now)
                assert feedback is None or len(feedback.pack()) <= 19
    v1_fuzz.check_bounds(receiver)
    restored = V1Receiver(v1_fuzz.SMALL)
    assert not restored.restore(receiver.parts())
    assert restored.parts() == receiver.parts()
    return reported


@cache
def _real_lines() -> tuple[bytes, ...]:
    return tuple(real_lines())


def check_driver(data: bytes) -> int:
    """Pass lines to a driver and to the parser alone; return the number of sentences.

    Lines are raw, or built from the input's fields with a correct checksum, or from real exchanges. Packets are
    requested between them. Each request ends once, and a modem that answers again is used again.

    Raises:
        AssertionError: A property does not hold.
    """
    fuzz = Fuzz.__new__(Fuzz)  # for its checks only: the lines come from the input
    driver, parser = MicroModem(MicroModemConfig(1)), nmea.LineAssembler()
    now, taken, asked, ended = 0.0, 0, [], []
    driver.port_opened(now)
    fuzz._make_ready(driver)
    for kind, body in _steps(data):
        now += (0.0, 0.01, 0.5, 7.0)[kind >> 3 & 3]
        line = _line(kind & 7, body)
        if line is None:
            choice, ack = (body[0] % 5 if body else 4), len(body) % 2 == 0
            asked.append(send_request(driver, choice, body[:64] or b".", 1, now, ack=ack))
        else:
            taken += sum(isinstance(item, nmea.Sentence) for item in parser.feed(line))
            ended += [e for e in driver.receive(line, now) if isinstance(e, ENDS)]
        ended += [e for e in driver.poll(now) if isinstance(e, ENDS)]
        fuzz._check(driver, parser, now)
    fuzz._recover(driver, now, asked, ended)
    return taken


def _line(kind: int, body: bytes) -> bytes | None:
    match kind:
        case 0:
            return None
        case 1:
            return body
        case 2:
            return b"".join(_real_lines()[number % len(_real_lines())] for number in body[:8])
        case 3 | 4:
            name, rest = body[:5], body[5:]
            return _checked(b"$" + name + b"".join(b"," + LIKELY[n % len(LIKELY)].encode() for n in rest))
        case _:
            return _checked(b"$" + body)


def _checked(start: bytes) -> bytes:
    """Return a line with its checksum if its text can have one."""
    total = 0
    for byte in start[1:]:
        total ^= byte
    return start + b"*%02X\r\n" % total


CHECKS: Final = {"receiver": check_receiver, "driver": check_driver}


def seeds(name: str) -> Iterator[bytes]:
    """Yield first inputs that cover genuine traffic."""
    if name == "receiver":
        frames = _genuine()
        for first in range(0, _GENUINE_FRAMES, 25):
            yield bytes([0, 25, *range(first, first + 25)])
            yield b"".join(bytes([2 | first % 3 << 2, len(f) - 2]) + f[2:] for f in frames[first : first + 8])
        return
    lines = _real_lines()
    for first in range(0, len(lines), 8):
        asked = bytes([0, 3, first % 256, 1, 2])
        yield asked + bytes([2, 8, *(n % 256 for n in range(first, first + 8))])
        yield asked + b"".join(
            bytes([5 | 1 << 3, len(body)]) + body
            for line in lines[first : first + 8]
            if len(body := line[1:].split(b"*")[0]) < 256
        )
