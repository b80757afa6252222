"""Receiver of short messages: messages in, records and acknowledgements out. Without I/O and clock."""

from dataclasses import dataclass, field
from typing import Final

import msgpack

from sonarpost.errors import BadInputError
from sonarpost.extensions.satellite.short_message import (
    WINDOW,
    ItemType,
    ShortAcknowledgement,
    ShortMessage,
    ShortMessageError,
    fragment,
    unpack_contact,
    unpack_decision,
)
from sonarpost.limits import limit
from sonarpost.link.state import SavedCount, Word, unpack_value
from sonarpost.messages import Decision, ReceivedImage

ACKNOWLEDGE_AFTER_MESSAGES = 16
ACKNOWLEDGE_AFTER_S = 60.0
MAX_WINDOWS: Final = limit(
    4, "windows", "shares", "short messages", "vessel", "windows", "the one with the fewest messages is deleted"
)
MAX_FRAGMENTS_KEPT: Final = limit(
    3 * WINDOW, "fragments", "shares", "short messages", "vessel", "fragments", "the oldest decision is deleted"
)
_WHERE: Final = "state of short messages"
_WINDOWS: Final = "windows"

Fragments = dict[tuple[int, int, int], dict[int, bytes]]
"""Data of the received fragments of a decision by index, by epoch, record number and number of fragments."""


@dataclass(slots=True)
class _Window:
    """Sequence numbers of an epoch: all from `start` to `base` - 1, and further ones below `base` + 256, were received.

    `received` has the CRC of the messages that were received: those numbers, and the 256 before `base`.
    """

    epoch: int
    start: int
    base: int
    received: dict[int, int] = field(default_factory=dict)
    unanswered: int = 0
    since_s: float = 0.0

    def includes(self, message: ShortMessage) -> bool:
        return self.epoch == message.epoch and self.start <= message.oldest and message.seq < self.base + WINDOW

    def add(self, seq: int, crc: int, now_s: float) -> None:
        self.received[seq] = crc
        while self.base in self.received:
            self.base += 1
        self.received = {number: crc for number, crc in self.received.items() if number >= self.base - WINDOW}
        self.since_s = self.since_s if self.unanswered else now_s
        self.unanswered += 1  # a repeated message too: its acknowledgement was lost

    def acknowledgement(self) -> bytes:
        further = frozenset(seq for seq in self.received if seq >= self.base)
        return ShortAcknowledgement(self.epoch, self.base, further).pack()


@dataclass(slots=True)
class ShortMessageReceiver:
    """Receives the messages of one vessel; each record is returned once.

    A message whose numbers do not continue those of its epoch begins a window of its own: a vessel whose messages were
    lost, or that c2 knows from an older copy of its store, is received further, and no message makes others count as
    received.

    The caller commits the records together with `parts` before it sends an acknowledgement.

    Attributes:
        vessel_id: The vessel.
    """

    vessel_id: str
    _windows: list[_Window] = field(default_factory=list)
    _fragments: Fragments = field(default_factory=dict)
    _lost: int = 0

    def receive(self, data: bytes, now_s: float) -> list[ReceivedImage | Decision]:
        """Process a message; return its new records.

        Raises:
            BadInputError: The message is not valid; it is not acknowledged.
        """
        where = f"short message of {self.vessel_id}"
        message = ShortMessage.unpack(data, where)
        crc = int.from_bytes(data[-2:], "big")
        same_epoch = [window for window in self._windows if window.epoch == message.epoch]
        is_new = all(window.received.get(message.seq) != crc for window in same_epoch)
        # Everything is parsed before the state changes.
        records, parts = self._records(message, where) if is_new else ([], {})
        found = [window for window in same_epoch if window.includes(message)]
        used = min(found, key=lambda window: window.start, default=None)
        used = used or _Window(message.epoch, message.oldest, message.oldest)
        others = [window for window in self._windows if window is not used]
        if len(others) >= MAX_WINDOWS:
            # Without the vessel's own window, a forged message could begin one whose base is above missing messages.
            others.remove(min(others, key=lambda window: window.base - window.start))
        self._windows = [*others, used]
        used.add(message.seq, crc, now_s)
        self._add_fragments(parts)
        return records

    def _records(self, message: ShortMessage, where: str) -> tuple[list[ReceivedImage | Decision], Fragments]:
        """Return the records of a message, and the fragments that are kept; an empty map for a complete decision."""
        records: list[ReceivedImage | Decision] = []
        parts: Fragments = {}
        for item in message.items:
            if item.type == ItemType.CONTACT:
                records.append(unpack_contact(item.content, self.vessel_id, where))
            elif item.type == ItemType.DECISION:
                records.append(unpack_decision(item.content, self.vessel_id, where))
            else:
                number, index, count, part = fragment(item.content, where)
                # Fragments have consecutive numbers; the first identifies the decision.
                name = (message.epoch, number, count)
                have = {**self._fragments.get(name, {}), **parts.get(name, {}), index: part}
                if len(have) == count:
                    records += self._joined(have, where)
                    have = {}
                parts[name] = have
        return records, parts

    def _joined(self, fragments: dict[int, bytes], where: str) -> list[Decision]:
        """Return the decision; nothing if a fragment is wrong: to refuse its last message would stop the vessel."""
        try:
            return [unpack_decision(b"".join(fragments[n] for n in sorted(fragments)), self.vessel_id, where)]
        except BadInputError:
            self._lost += 1
            return []

    def _add_fragments(self, parts: Fragments) -> None:
        for name, have in parts.items():
            self._fragments.pop(name, None)
            if have:
                self._fragments[name] = have
        while sum(map(len, self._fragments.values())) > MAX_FRAGMENTS_KEPT:
            del self._fragments[next(iter(self._fragments))]
            self._lost += 1

    def take_lost(self) -> int:
        """Return the number of decisions since the last call whose fragments were deleted or do not fit together."""
        lost, self._lost = self._lost, 0
        return lost

    def acknowledgements(self, now_s: float) -> list[bytes]:
        """Return the acknowledgements that are due; they count as sent."""
        found = []
        for window in self._windows:
            overdue = window.unanswered and now_s - window.since_s >= ACKNOWLEDGE_AFTER_S
            if overdue or window.unanswered >= ACKNOWLEDGE_AFTER_MESSAGES:
                window.unanswered = 0
                found.append(window.acknowledgement())
        return found

    def parts(self) -> dict[str, bytes]:
        """Return the state for the store: the windows, and each fragment, so that a message changes little."""
        rows = [(w.epoch, w.start, w.base, w.received, w.unanswered, w.since_s) for w in self._windows]
        fragments = {
            f"{epoch}/{number}/{count}/{index}": part
            for (epoch, number, count), have in self._fragments.items()
            for index, part in have.items()
        }
        return {_WINDOWS: msgpack.packb(rows), **fragments}

    def restore(self, name: str, data: bytes) -> bytes:
        """Add a part that `parts` has returned; return it.

        Raises:
            BadInputError, ValueError: It is not valid; nothing was added.
        """
        if name == _WINDOWS:
            kind = list[tuple[Word, Word, Word, dict[Word, Word], SavedCount, float]]
            windows = [_Window(*fields) for fields in unpack_value(kind, data, _WHERE)]
            for window in windows:
                window.acknowledgement()  # checks the numbers
            self._windows = windows
            return data
        epoch, number, count, index = map(int, name.split("/"))
        if not 0 <= index < count or not data:
            raise ShortMessageError(_WHERE, "fragment", name, f"an index below {count}, and data")
        self._fragments.setdefault((epoch, number, count), {})[index] = data
        return data
