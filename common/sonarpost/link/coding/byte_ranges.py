"""Sets of byte positions, and byte strings of which only parts have arrived.

Ranges are half-open, `[start, stop)`. A set of them is sorted and disjoint, and no two of its ranges touch.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import msgpack

from sonarpost.errors import FrameError

Range = tuple[int, int]
Ranges = tuple[Range, ...]
MAX_PARTIAL_BYTES = 0xFFFF
"""Longest byte string of a saved state."""


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
        try:
            match msgpack.unpackb(packed):
                case [int(length), list(pieces)] if 0 <= length <= MAX_PARTIAL_BYTES:
                    found = cls(bytearray(length))
                case _:
                    raise FrameError("partial bytes", "", packed, f"a length up to {MAX_PARTIAL_BYTES}, and pieces")
        except (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException) as error:
            raise FrameError("partial bytes", "", packed, "msgpack") from error
        for piece in pieces:
            match piece:
                case [int(start), bytes(data)] if data and start >= 0 and start + len(data) <= length:
                    found.write(start, data)
                case _:
                    raise FrameError("partial bytes", "piece", piece, f"[position, bytes] within {length} bytes")
        return found
