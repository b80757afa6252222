"""The time that bytes spend on a serial line."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

Item = TypeVar("Item")

BITS_PER_BYTE = 10
"""Start bit, eight data bits, stop bit (8N1)."""


class SerialLineTiming(Generic[Item]):
    """One direction of a serial line: what is put in comes out when its last byte would have passed.

    Args:
        baud: Bits a second, above zero, or None for a line without delay.

    Raises:
        ValueError: A speed that is not above zero.
    """

    def __init__(self, baud: float | None) -> None:
        if baud is not None and not baud > 0:
            raise ValueError(f"baud: got {baud!r}, expected bits a second above 0, or None")
        self._baud = baud
        self._items: deque[tuple[float, Item]] = deque()
        self._free_s = 0.0

    def put(self, item: Item, size_bytes: int, now: float) -> None:
        """Put an item of `size_bytes` on the line at `now`, behind those before it."""
        passing_s = size_bytes * BITS_PER_BYTE / self._baud if self._baud else 0.0
        self._free_s = max(now, self._free_s) + passing_s
        self._items.append((self._free_s, item))

    def take(self, now: float) -> list[Item]:
        """Return, once, what has passed by `now`."""
        passed = []
        while self._items and self._items[0][0] <= now:
            passed.append(self._items.popleft()[1])
        return passed

    def abandon(self) -> list[Item]:
        """Return what is still on the line, and drop it."""
        dropped = [item for _, item in self._items]
        self._items.clear()
        return dropped

    def next_s(self) -> float | None:
        """Return when the next item has passed, or None."""
        return self._items[0][0] if self._items else None
