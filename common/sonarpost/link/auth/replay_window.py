"""Which counters of a transmitter a receiver has taken, in bounded memory.

After the sliding window of IPsec (RFC 4303, appendix A2): the newest counter, and a bit for each of the 64 up to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

WINDOW: Final = 64
"""Frames that come late by less than this are still taken."""


@dataclass(slots=True)
class ReplayWindow:
    """The counters taken of one transmitter.

    Attributes:
        newest: The highest, -1 before the first.
        seen: Bit i stands for counter newest - i, i below 64.
    """

    newest: int = -1
    seen: int = 0

    def nearest(self, low: int, step: int) -> int:
        """Return the counter that ends with `low` and lies from newest - 63 to newest - 64 + `step`.

        Args:
            low: The counter modulo `step`, as a frame tells it.
            step: A power of two above 64.

        Returns:
            Below zero where no counter that has been can have this end.
        """
        base = self.newest - (WINDOW - 1)
        return base + (low - base) % step

    def is_new(self, counter: int) -> bool:
        """Whether a frame with this counter may be taken."""
        behind = self.newest - counter
        return behind < 0 or (behind < WINDOW and not self.seen >> behind & 1)

    def take(self, counter: int) -> None:
        """Remember a counter that `is_new`."""
        ahead = counter - self.newest
        if ahead > 0:
            # What falls out of the window must not be shifted up to a number of a million bits first.
            self.seen = self.seen << ahead & (1 << WINDOW) - 1 if ahead < WINDOW else 0
            self.newest = counter
        self.seen |= 1 << self.newest - counter
