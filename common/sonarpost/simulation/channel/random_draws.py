"""The dice of the simulated water.

Every draw is a keyed hash of what it is about (seed, transmitter, packet number, receiver, frame, purpose), not
the next number of a running generator. So a packet meets the same fate whatever happened around it, however the
process was scheduled, and on every platform and Python version.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from enum import Enum


class TailDamage(Enum):
    """What a damaged tail holds instead of the bytes that were sent."""

    ZEROS = "zeros"
    NOISE = "noise"
    EITHER = "either"


@dataclass(frozen=True, slots=True)
class RandomDraws:
    """Draws for one packet on its way to one receiver.

    Attributes:
        seed: Seed of the whole simulation.
        transmitter: Number of the modem that sends.
        packet: Count of that modem's packets, from 1.
        receiver: Number of the modem that listens.
    """

    seed: int
    transmitter: int
    packet: int
    receiver: int

    def uniform(self, purpose: str, frame: int = 0) -> float:
        """Return a number in [0, 1), the same for the same purpose and frame."""
        return int.from_bytes(self._bytes(purpose, frame, 7), "big") / 2**56

    def happens(self, probability: float, purpose: str, frame: int = 0) -> bool:
        """Return whether something of that probability happens: never at 0, always at 1."""
        return self.uniform(purpose, frame) < probability

    def noise(self, count: int, purpose: str, frame: int = 0) -> bytes:
        """Return `count` bytes of noise."""
        return self._bytes(purpose, frame, count)

    def _bytes(self, purpose: str, frame: int, count: int) -> bytes:
        key = f"{self.seed}|{self.transmitter}|{self.packet}|{self.receiver}|{frame}|{purpose}"
        return hashlib.shake_128(key.encode("ascii")).digest(count)


def damage_tail(frame: bytes, dice: RandomDraws, number: int, kind: TailDamage, longest_fraction: float) -> bytes:
    """Return `frame` with its end replaced, its length kept.

    The tail is between one byte and `longest_fraction` of the frame. A tail of zeros over bytes that were zero
    already leaves the frame as it was; the caller compares.

    Args:
        frame: What was sent, at least one byte.
        dice: The draws of this packet.
        number: The frame's number, from 1.
        kind: Zeros, noise, or an even draw of the two.
        longest_fraction: Longest tail as a part of the frame, above 0 and at most 1.
    """
    longest = max(1, int(len(frame) * longest_fraction))
    tail = 1 + min(longest - 1, int(dice.uniform("tail length", number) * longest))
    zeros = kind is TailDamage.ZEROS or (kind is TailDamage.EITHER and dice.happens(0.5, "tail kind", number))
    return frame[:-tail] + (bytes(tail) if zeros else dice.noise(tail, "tail noise", number))
