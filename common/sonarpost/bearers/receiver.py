"""Receiver of short messages: messages in, records and acknowledgements out. Without I/O and clock."""

from __future__ import annotations

from dataclasses import dataclass, field

import msgpack

from sonarpost.bearers.short_message import (
    Acknowledgement,
    ItemType,
    ShortMessage,
    fragment,
    unpack_contact,
    unpack_decision,
)
from sonarpost.messages import Decision, ReceivedImage

ACKNOWLEDGE_AFTER_MESSAGES = 16
ACKNOWLEDGE_AFTER_S = 60.0
MAX_EPOCHS = 4
"""Stores of one vessel whose state is kept; more than one only after the vessel's store was replaced."""
MAX_INCOMPLETE = 512
"""Incomplete decisions that are kept: more than a window of messages can leave incomplete."""


@dataclass(slots=True)
class _Epoch:
    base: int = 0
    received: set[int] = field(default_factory=set)
    unanswered: int = 0
    since_s: float = 0.0


@dataclass(slots=True)
class MessageReceiver:
    """Receives the messages of one vessel; each record is returned once.

    The caller commits the records together with `pack` before it sends an acknowledgement.

    Attributes:
        vessel_id: The vessel.
    """

    vessel_id: str
    _epochs: dict[int, _Epoch] = field(default_factory=dict)
    _fragments: dict[tuple[int, int], dict[int, bytes]] = field(default_factory=dict)

    def receive(self, data: bytes, now_s: float) -> list[ReceivedImage | Decision]:
        """Process a message; return its new records.

        Raises:
            BadInputError: The message is not valid; it is not acknowledged.
        """
        where = f"short message of {self.vessel_id}"
        message = ShortMessage.unpack(data, where)
        known = self._epochs.get(message.epoch, _Epoch())
        base = max(known.base, message.oldest)
        is_new = message.seq >= base and message.seq not in known.received
        # Everything is parsed before the state changes.
        records, parts = self._records(message, where) if is_new else ([], {})
        self._add_epoch(message.epoch, known)
        self._add_fragments(parts)
        if is_new:
            known.received.add(message.seq)
        known.base = base
        known.received = {seq for seq in known.received if seq >= base}
        while known.base in known.received:
            known.received.remove(known.base)
            known.base += 1
        known.since_s = known.since_s if known.unanswered else now_s
        known.unanswered += 1  # a repeated message too: its acknowledgement was lost
        return records

    def _records(
        self, message: ShortMessage, where: str
    ) -> tuple[list[ReceivedImage | Decision], dict[tuple[int, int], dict[int, bytes]]]:
        """Return the records of a message, and the fragments that are kept; an empty map for a complete decision."""
        records: list[ReceivedImage | Decision] = []
        parts: dict[tuple[int, int], dict[int, bytes]] = {}
        for item in message.items:
            if item.type == ItemType.CONTACT:
                records.append(unpack_contact(item.content, self.vessel_id, where))
            elif item.type == ItemType.DECISION:
                records.append(unpack_decision(item.content, self.vessel_id, where))
            else:
                number, index, count, part = fragment(item.content, where)
                # Fragments have consecutive numbers; the first identifies the decision.
                name = (message.epoch, number)
                have = {**self._fragments.get(name, {}), **parts.get(name, {}), index: part}
                if len(have) == count:
                    content = b"".join(have[n] for n in sorted(have))
                    records.append(unpack_decision(content, self.vessel_id, where))
                    have = {}
                parts[name] = have
        return records, parts

    def _add_epoch(self, number: int, epoch: _Epoch) -> None:
        self._epochs.pop(number, None)
        self._epochs[number] = epoch
        while len(self._epochs) > MAX_EPOCHS:
            del self._epochs[next(iter(self._epochs))]

    def _add_fragments(self, parts: dict[tuple[int, int], dict[int, bytes]]) -> None:
        for name, have in parts.items():
            self._fragments.pop(name, None)
            if have:
                self._fragments[name] = have
        while len(self._fragments) > MAX_INCOMPLETE:
            del self._fragments[next(iter(self._fragments))]

    def acknowledgements(self, now_s: float) -> list[bytes]:
        """Return the acknowledgements that are due; they count as sent."""
        found = []
        for number, epoch in self._epochs.items():
            overdue = epoch.unanswered and now_s - epoch.since_s >= ACKNOWLEDGE_AFTER_S
            if overdue or epoch.unanswered >= ACKNOWLEDGE_AFTER_MESSAGES:
                epoch.unanswered = 0
                found.append(Acknowledgement(number, epoch.base, frozenset(epoch.received)).pack())
        return found

    def pack(self) -> bytes:
        """Return the state for the store."""
        epochs = [(n, e.base, sorted(e.received), e.unanswered, e.since_s) for n, e in self._epochs.items()]
        fragments = [(*name, list(have.items())) for name, have in self._fragments.items()]
        packed: bytes = msgpack.packb((epochs, fragments))
        return packed

    @classmethod
    def unpack(cls, vessel_id: str, data: bytes) -> MessageReceiver:
        """Return a receiver with a stored state."""
        epochs, fragments = msgpack.unpackb(data, strict_map_key=False)
        return cls(
            vessel_id,
            {n: _Epoch(base, set(received), count, since_s) for n, base, received, count, since_s in epochs},
            {(epoch, number): dict(have) for epoch, number, have in fragments},
        )
