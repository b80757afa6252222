"""Properties of the acoustic link for any bytes: the v1 receiver, and the modem driver.

Inputs are lists of steps, as in `builders.modem_fuzz`, which has the checks of the driver.
"""

from collections.abc import Iterator
from functools import cache
from itertools import islice
from typing import Final

from builders import v1_fuzz
from builders.modem_fuzz import CHECKED, check_driver, real_lines, steps
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.receiver import ImageUpdate, MessageReceived

VEHICLE: Final = 3
STRANGER: Final = 4
_GENUINE_FRAMES: Final = 250


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
    for kind, body in steps(data):
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


CHECKS: Final = {"receiver": check_receiver, "driver": check_driver}


def seeds(name: str) -> Iterator[bytes]:
    """Yield first inputs that cover genuine traffic."""
    if name == "receiver":
        frames = _genuine()
        for first in range(0, _GENUINE_FRAMES, 25):
            yield bytes([0, 25, *range(first, first + 25)])
            yield b"".join(bytes([2 | first % 3 << 2, len(f) - 2]) + f[2:] for f in frames[first : first + 8])
        return
    lines = real_lines()
    for first in range(0, len(lines), 8):
        asked = bytes([0, 3, first % 256, 1, 2])
        yield asked + bytes([2, 8, *(n % 256 for n in range(first, first + 8))])
        yield asked + b"".join(
            bytes([CHECKED | 1 << 3, len(body)]) + body
            for line in lines[first : first + 8]
            if len(body := line[1:].split(b"*")[0]) < 256
        )
