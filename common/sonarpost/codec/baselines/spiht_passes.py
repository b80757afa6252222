"""The passes of `spiht`: the questions it asks about coefficients, answered from a picture or from a stream."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sonarpost.codec.baselines.spiht_wavelet import FRACTION_BITS, Forest, Integers

MAX_PLANES = 20
"""The energy of 512 x 512 px keeps every coefficient below plane 18."""
UNIT = 1 << (FRACTION_BITS - 3)
"""A phase counts eighths of a grey level."""


class EndOfBits(Exception):  # noqa: N818  (no error: the budget is full, or the stream is at its end)
    """There is no room for, or there are no, further bits."""


@dataclass(frozen=True)
class SignificanceTests:
    """The questions SPIHT asks about a coefficient in a plane; answered from the picture, or from the stream."""

    significant: Callable[[int, int], bool]
    negative: Callable[[int], bool]
    descendants: Callable[[int, int], bool]
    grandchildren: Callable[[int, int], bool]
    refined: Callable[[int, int], None]


def run_passes(forest: Forest, planes: range, ask: SignificanceTests) -> None:
    """Ask every question in SPIHT's order, plane by plane; ends early when a test raises EndOfBits.

    Encoder and decoder are this one routine, so they cannot disagree about the order.
    """
    children = forest.children
    pending = list(range(forest.roots))  # the list of insignificant pixels
    known: list[int] = []  # the list of significant pixels
    sets = [(node, False) for node in range(forest.roots) if children[node]]  # of insignificant sets; True: type B
    for plane in planes:
        found: list[int] = []

        def classify(node: int, plane: int = plane, found: list[int] = found) -> bool:
            if ask.significant(node, plane):
                found.append(node)
                ask.negative(node)
                return True
            return False

        pending = [node for node in pending if not classify(node)]
        waiting: list[tuple[int, bool]] = []
        for node, is_b in sets:  # grows while it is walked
            if not (ask.grandchildren if is_b else ask.descendants)(node, plane):
                waiting.append((node, is_b))
            elif is_b:
                sets.extend((child, False) for child in children[node] if children[child])
            else:
                pending.extend([child for child in children[node] if not classify(child)])
                if any(children[child] for child in children[node]):
                    sets.append((node, True))
        sets = waiting
        for node in known:
            ask.refined(node, plane)
        known += found


class EncoderTests:
    """Answers from the quantised coefficients, and writes each answer."""

    def __init__(self, flat: Integers, phase: int, forest: Forest, limit: int | None) -> None:
        quantised = np.abs(flat) // ((4 + phase) * UNIT)
        below = np.zeros(forest.size, dtype=np.int64)
        beyond = np.zeros(forest.size, dtype=np.int64)
        ends = [forest.roots, *(start + h * w for start, h, w in forest.bands[2::3])]
        for start, stop in reversed(list(pairwise(ends))):
            above = forest.parents[start:stop]
            np.maximum.at(beyond, above, below[start:stop])
            np.maximum.at(below, above, np.maximum(quantised[start:stop], below[start:stop]))
        self.planes = max(int(quantised.max()).bit_length(), 1)
        self.bits = bytearray()
        self._limit = MAX_PLANES * forest.size * 4 if limit is None else limit
        self._levels, self._below, self._beyond = quantised.tolist(), below.tolist(), beyond.tolist()
        self._signs = (flat < 0).tolist()

    def tests(self) -> SignificanceTests:
        """Return the questions, each of which writes its answer; at the limit they raise EndOfBits."""
        return SignificanceTests(
            lambda node, plane: self._write(bool(self._levels[node] >> plane)),
            lambda node: self._write(self._signs[node]),
            lambda node, plane: self._write(bool(self._below[node] >> plane)),
            lambda node, plane: self._write(bool(self._beyond[node] >> plane)),
            self._refine,
        )

    def _refine(self, node: int, plane: int) -> None:
        self._write(bool(self._levels[node] >> plane & 1))

    def _write(self, answer: bool) -> bool:  # noqa: FBT001  (the answer is the bit)
        if len(self.bits) >= self._limit:
            raise EndOfBits
        self.bits.append(answer)
        return answer


class DecoderTests:
    """Answers from the stream, and keeps what is known of each coefficient: a lower bound and an interval."""

    def __init__(self, bits: bytes, forest: Forest) -> None:
        self._bits = iter(bits)
        self.lower = [0] * forest.size
        self.width = [0] * forest.size
        self.sign = [1] * forest.size
        self._last = 0

    def tests(self) -> SignificanceTests:
        """Return the questions, each of which reads its answer; at the end they raise EndOfBits."""
        read = self._read
        return SignificanceTests(
            self._significant, self._negative, lambda _node, _plane: read(), lambda _node, _plane: read(), self._refined
        )

    def _read(self) -> bool:
        bit = next(self._bits, None)
        if bit is None:
            raise EndOfBits
        return bool(bit)

    def _significant(self, node: int, plane: int) -> bool:
        if self._read():
            self._last = plane
            return True
        return False

    def _negative(self, node: int) -> bool:
        # The coefficient counts from its sign on: without one it is better left at nought.
        negative = self._read()
        self.sign[node] = -1 if negative else 1
        self.lower[node] = self.width[node] = 1 << self._last
        return negative

    def _refined(self, node: int, plane: int) -> None:
        self.lower[node] += self._read() << plane
        self.width[node] = 1 << plane

    def coefficients(self, phase: int) -> Integers:
        """Return what the answers so far say of the coefficients, shape (forest.size,), in 2**-8 grey levels."""
        lower, width, sign = (np.array(values, dtype=np.int64) for values in (self.lower, self.width, self.sign))
        # Small coefficients are more frequent than large ones, also within an interval: 3/8 of the way up, not 1/2.
        return sign * ((8 * lower + 3 * width) * ((4 + phase) * UNIT) >> 3)
