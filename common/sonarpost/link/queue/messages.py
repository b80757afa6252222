"""Messages of several programs that wait for the water: by priority, by age, and evenly among programs. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

LOWEST_PRIORITY: Final = 7
FILLS_FROM: Final = 6
"""From this priority on a message goes only where frames have room, until it has aged."""
_IDS_REMEMBERED: Final = 1024


@dataclass(frozen=True, slots=True)
class QueuedMessage:
    """A message of a program.

    Attributes:
        key: Number in the queue, the order of arrival.
        message_id: The program's name for it.
        source: The program.
        priority: 1 first to 7 last.
        added_at: When it was queued, UTC in seconds.
        expires_at: When it is worth nothing any more.
        data: What goes through the water.
    """

    key: int
    message_id: str
    source: str
    priority: int
    added_at: float
    expires_at: float
    data: bytes

    def level(self, now: float, aging_s: float) -> int:
        """Return the priority it has by now: one level more urgent for each `aging_s`, to 2 at most."""
        aged = self.priority - int(max(0.0, now - self.added_at) / aging_s)
        return max(min(self.priority, 2), aged)


@dataclass(eq=False)
class WaitingMessages:
    """The messages that wait.

    Attributes:
        waiting: By key.
        next_key: Of the next message.
        served: Bytes sent for each program, a program that has just come begins where the others are.
        known: Identifiers of late, so that a message given twice is sent once.
        expired: How many were dropped because their time was over.
    """

    waiting: dict[int, QueuedMessage] = field(default_factory=dict)
    next_key: int = 0
    served: Counter[str] = field(default_factory=Counter)
    known: dict[str, None] = field(default_factory=dict)
    expired: int = 0

    @property
    def waiting_bytes(self) -> int:
        """Bytes that wait."""
        return sum(len(message.data) for message in self.waiting.values())

    def add(
        self, message_id: str, source: str, priority: int, data: bytes, *, added_at: float, expires_at: float
    ) -> bool:
        """Take a message; False when this identifier of this program is known."""
        name = f"{source}\0{message_id}"
        if name in self.known:
            return False
        self.known[name] = None
        while len(self.known) > _IDS_REMEMBERED:
            del self.known[next(iter(self.known))]
        busy = {m.source for m in self.waiting.values()}
        if source not in busy:
            # Silence earns no credit: whoever was silent could otherwise keep everybody else out for as long.
            floor = min((self.served[name] for name in busy), default=0)
            self.served[source] = max(self.served[source], floor)
        message = QueuedMessage(self.next_key, message_id, source, priority, added_at, expires_at, data)
        self.waiting[message.key] = message
        self.next_key += 1
        return True

    def prune(self, now: float) -> None:
        """Drop what has expired, and what is remembered of programs that have nothing waiting."""
        for message in [m for m in self.waiting.values() if m.expires_at <= now]:
            del self.waiting[message.key]
            self.expired += 1
        if not self.waiting:
            self.served.clear()

    def next(self, now: float, aging_s: float, *, among: Iterable[int] | None = None) -> QueuedMessage | None:
        """Return the message to send next: of the most urgent, the least served program's oldest.

        Args:
            now: UTC in seconds.
            aging_s: See `QueuedMessage.level`.
            among: Keys to choose from, all if not given.
        """
        open_ones = [m for k, m in self.waiting.items()] if among is None else [self.waiting[k] for k in among]
        if not open_ones:
            return None
        return min(open_ones, key=lambda m: (m.level(now, aging_s), self.served[m.source], m.key))

    def take(self, message: QueuedMessage) -> None:
        """Note that a message is on its way."""
        del self.waiting[message.key]
        self.served[message.source] += len(message.data)
