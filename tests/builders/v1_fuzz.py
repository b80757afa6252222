"""Hostile frames for the v1 receiver, as a short and a long run; `run_atheris.py` is guided by coverage.

PYTHONPATH=tests python -m builders.v1_fuzz FRAMES [SEED]
"""

import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import islice

import numpy as np

from builders.modem_fuzz import steps
from builders.v1_world import add_message
from sonarpost.link.config import ReceiverConfig, SenderConfig
from sonarpost.link.downlink.messages import number_of_image
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.frame import checksum
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import ImageUpdate, MessageReceived

SMALL = ReceiverConfig(max_sources=3, max_contacts=20, block_memory_s=300.0, contact_memory_s=900.0)
MESSAGE = b"status: "
VEHICLE, STRANGER = 3, 4
GENUINE_FRAMES = 250


def image_stream(number: int) -> bytes:
    return np.random.default_rng(number).integers(0, 256, 40 + number % 400, dtype=np.uint8).tobytes()


def record(number: int) -> ContactSummary:
    plain = ContactSummary(lat_deg=number / 1000, lon_deg=1.0, confidence=1.0)
    classified = replace(plain, atd_class="mine_like", p_mine_like=0.8, p_other_object=0.15)
    return (classified if number % 2 else plain).rounded()


def genuine(seed: int) -> Iterator[bytes]:
    """Yield endless frames of a vehicle with all kinds of content and changing frame lengths and settings."""
    rng, number = np.random.default_rng(seed), 0
    while True:
        sender = V1Sender(
            SenderConfig(
                frame_bytes=int(rng.choice([32, 64, 256])),
                group_images=int(rng.integers(1, 9)),
                feedback=bool(rng.random() < 0.5),
            ),
            first_block=int(rng.integers(0, 32)),
        )
        for _ in range(int(rng.integers(1, 12))):
            number = number % 5000 + 1
            sender.add_image(number, record(number), image_stream(number), 0.0)
            if rng.random() < 0.3:
                add_message(sender, MESSAGE + bytes([number % 256]) * int(rng.integers(1, 150)), 0.0)
        while (frame := sender.next_frame(0.0)) is not None:
            yield frame


def mangled(frame: bytes, rng: np.random.Generator, kind: int) -> bytes:
    """Return a frame that a modem, the channel or an attacker changed, in one of nine ways; 6 and 7 are forgeries."""
    data, cut = bytearray(frame), int(rng.integers(0, len(frame)))
    match kind:
        case 0:
            data = bytearray(rng.bytes(int(rng.integers(0, 300))))
        case 1:
            del data[cut:]
        case 2:
            data[cut:] = bytes(len(data) - cut)
        case 3:
            data[cut:] = rng.bytes(len(data) - cut)
        case 4:
            for _ in range(int(rng.integers(1, 20))):
                data[int(rng.integers(0, len(data)))] ^= 1 << int(rng.integers(0, 8))
        case 5:
            data += bytes(int(rng.integers(1, 200)))
        case 6:  # a correct checksum over random content: only the inner checks can reject it
            head = bytes([int(rng.integers(0, 128)), int(rng.integers(0, 8)), int(rng.integers(0, 6))])
            data = with_checksum(head + rng.bytes(int(rng.choice([27, 59, 251]))))
        case 7:  # a correct checksum over a damaged frame
            for _ in range(int(rng.integers(1, 4))):
                data[2 + int(rng.integers(0, len(data) - 2))] = int(rng.integers(0, 256))
            data = with_checksum(bytes(data[2:]))
        case _:
            data = bytearray(rng.permutation(np.frombuffer(frame, np.uint8)).tobytes())
    return bytes(data)


def with_checksum(covered: bytes) -> bytearray:
    return bytearray(checksum(covered).to_bytes(2, "big") + covered)


def is_right(event: object) -> bool:
    """Whether the vehicle sent what the event reports."""
    if isinstance(event, ImageUpdate):
        number = number_of_image(event.image_id)
        return event.contact == record(number) and image_stream(number).startswith(event.stream)
    if isinstance(event, MessageReceived):
        return event.data.startswith(MESSAGE)
    return True


def run(frames: int, seed: int = 0) -> dict[str, int]:
    """Pass frames to a receiver, a third of them genuine, replayed or out of order; return counts.

    `forged` counts reported content that was never sent. An attacker who computes checksums can forge messages,
    contacts and feedback without authentication. So frames with correct checksums over random content have a source of
    their own, which is counted separately; no event of the other source may be wrong.
    """
    rng = np.random.default_rng(seed)
    source, receiver, now = genuine(seed), V1Receiver(SMALL), 0.0
    past: list[bytes] = []
    counts = {"frames": 0, "shown": 0, "wrong": 0, "forged": 0}
    for step in range(frames):
        now += float(rng.choice([0.0, 0.3, 2.0, 40.0], p=[0.2, 0.5, 0.29, 0.01]))
        frame, address = next(source), 3
        past = [*past[-63:], frame]
        kind = rng.random()
        if kind < 0.35:
            how = int(rng.integers(0, 9))
            frame = mangled(past[int(rng.integers(0, len(past)))], rng, how)
            address = 4 if how in (6, 7) and frame not in past else 3
        elif kind < 0.6:
            frame = past[int(rng.integers(0, len(past)))]
        elif kind < 0.7:
            continue
        events = receiver.accept(address, frame, now)
        counts["frames"] += 1
        for event in events:
            wrong = not is_right(event)
            counts["shown"] += isinstance(event, ImageUpdate | MessageReceived)
            counts["wrong" if address == 3 else "forged"] += wrong
        if step % 5000 == 0:
            check_bounds(receiver)
            restored = V1Receiver(SMALL)
            assert not restored.restore(receiver.parts())
            receiver = restored
    check_bounds(receiver)
    return counts


def check_bounds(receiver: V1Receiver) -> None:
    """Assert that memory is bounded."""
    assert len(receiver.sources) <= SMALL.max_sources
    groups = Counter(name.rpartition("/")[0] for name in receiver.parts())
    assert all(n <= SMALL.max_contacts for group, n in groups.items() if group.startswith("image/"))
    assert all(n <= 32 for group, n in groups.items() if group.startswith(("block/", "rival/")))
    assert all(n <= 16 for group, n in groups.items() if group.startswith(("block-symbols/", "rival-symbols/")))


@cache
def _genuine() -> tuple[bytes, ...]:
    return tuple(islice(genuine(1), GENUINE_FRAMES))


def check(data: bytes) -> int:
    """Pass frames of an input to a receiver; return the number of image updates and messages.

    The steps of an input are those of `builders.modem_fuzz`.

    A stranger sends the input's bytes, with correct checksums or without. Between them, genuine frames of a vehicle
    arrive in any order and number; updates of the vehicle must hold what it sent. Feedback, the state and its bounds
    are checked at the end.

    Raises:
        AssertionError: A property does not hold.
    """
    receiver, now, reported = V1Receiver(SMALL), 0.0, 0
    for kind, body in steps(data):
        now += (0.0, 1.0, 70.0, 4000.0)[kind >> 2 & 3]
        if kind & 3 == 0:
            frames = [(VEHICLE, _genuine()[number % GENUINE_FRAMES]) for number in body]
        elif kind & 3 == 1:
            frames = [(STRANGER, body)]
        else:
            frames = [(STRANGER, bytes(with_checksum(body)))]
        for source, frame in frames:
            for event in receiver.accept(source, frame, now):
                assert source == STRANGER or is_right(event), f"reported but never sent: {event}"
                reported += isinstance(event, ImageUpdate | MessageReceived)
        for source in receiver.sources:
            if receiver.feedback_is_due(source, now):
                feedback = receiver.feedback(source, now)
                assert feedback is None or len(feedback.pack()) <= 19
    check_bounds(receiver)
    restored = V1Receiver(SMALL)
    assert not restored.restore(receiver.parts())
    assert restored.parts() == receiver.parts()
    return reported


def seeds() -> Iterator[bytes]:
    """Yield first inputs of `check` that cover genuine traffic."""
    frames = _genuine()
    for first in range(0, GENUINE_FRAMES, 25):
        yield bytes([0, 25, *range(first, first + 25)])
        yield b"".join(bytes([2 | first % 3 << 2, len(f) - 2]) + f[2:] for f in frames[first : first + 8])


def main(arguments: list[str]) -> None:
    started = time.process_time()
    seed = int(arguments[1]) if len(arguments) > 1 else 0
    print(run(int(arguments[0]), seed), f"{time.process_time() - started:.0f} s CPU")


if __name__ == "__main__":
    main(sys.argv[1:])
