"""Sets of byte positions, and byte strings of which only parts have arrived.

Ranges are half-open, `[start, stop)`. A set of them is sorted and disjoint, and no two of its ranges touch.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import msgpack

from sonarpost.errors import FrameError
from sonarpost.link.state import Bounds, from_plain, unpack_plain

Range = tuple[int, int]
Ranges = tuple[Range, ...]
MAX_PARTIAL_BYTES = 0xFFFF
"""Longest byte string of a saved state."""

_Position = Annotated[int, Bounds(0, MAX_PARTIAL_BYTES)]


def add_range(ranges: Ranges, start: int, stop: int) -> Ranges:
    """Return the union of `ranges` and `[start, stop)`; ranges that touch become one."""
    if start >= stop:
        return ranges
    before = [r for r in ranges if r[1] < start]
    after = [r for r in ranges if r[0] > stop]
    joined = ranges[len(before) : len(ranges) - len(after)]
    if joined:
        start, stop = min(start, joined[0][0]), max(stop, joined[-1][1])
    return (*before, (start, stop), *after)


def covered_within(ranges: Ranges, start: int, stop: int) -> Ranges:
    """Return the parts of `[start, stop)` that `ranges` covers."""
    return tuple((max(a, start), min(b, stop)) for a, b in ranges if a < stop and b > start)


def gaps_within(ranges: Ranges, start: int, stop: int) -> Ranges:
    """Return the parts of `[start, stop)` that `ranges` does not cover."""
    gaps: list[Range] = []
    position = start
    for a, b in covered_within(ranges, start, stop):
        if a > position:
            gaps.append((position, a))
        position = b
    if position < stop:
        gaps.append((position, stop))
    return tuple(gaps)


def count_positions(ranges: Ranges) -> int:
    """Return how many positions `ranges` covers."""
    return sum(stop - start for start, stop in ranges)


@dataclass(frozen=True, slots=True)
class _SavedBytes:
    length: _Position
    pieces: list[tuple[_Position, bytes]]


@dataclass(eq=False, slots=True)
class PartialBytes:
    """A byte string that arrives in pieces.

    Attributes:
        data: The bytes, zero where none has arrived.
        received: The ranges that have arrived.
    """

    data: bytearray = field(default_factory=bytearray)
    received: Ranges = ()

    def write(self, start: int, piece: bytes) -> tuple[bool, bool]:
        """Store the bytes of a piece that are new; a byte that has arrived before keeps its value.

        Returns:
            Whether a byte was new, and whether the piece contradicts an earlier one.
        """
        stop = start + len(piece)
        if len(self.data) < stop:
            self.data.extend(bytes(stop - len(self.data)))
        conflict = any(
            self.data[a:b] != piece[a - start : b - start] for a, b in covered_within(self.received, start, stop)
        )
        gaps = gaps_within(self.received, start, stop)
        for a, b in gaps:
            self.data[a:b] = piece[a - start : b - start]
        self.received = add_range(self.received, start, stop)
        return bool(gaps), conflict

    @property
    def received_bytes(self) -> int:
        """Number of bytes that have arrived."""
        return count_positions(self.received)

    @property
    def prefix_bytes(self) -> int:
        """Number of bytes from the beginning to the first gap."""
        return self.received[0][1] if self.received and self.received[0][0] == 0 else 0

    def pack(self) -> bytes:
        """Return the length and the pieces that have arrived, as msgpack."""
        pieces = [[start, bytes(self.data[start:stop])] for start, stop in self.received]
        packed: bytes = msgpack.packb([len(self.data), pieces])
        return packed

    @classmethod
    def unpack(cls, packed: bytes) -> PartialBytes:
        """Return what `pack` saved.

        Raises:
            FrameError: `packed` is something else.
        """
        where = "partial bytes"
        saved = from_plain(_SavedBytes, unpack_plain(list, packed, where), where)
        found = cls(bytearray(saved.length))
        for start, data in saved.pieces:
            if not data or start + len(data) > saved.length:
                raise FrameError(where, "piece", (start, len(data)), f"bytes within {saved.length}")
            found.write(start, data)
        return found
