"""Sender of short messages: records in, messages out, acknowledgements in. Without I/O and clock."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Final

import msgpack

from sonarpost.extensions.satellite.short_message import (
    ITEM_HEAD_BYTES,
    MAX_MESSAGE_BYTES,
    MAX_SEQ,
    WINDOW,
    Item,
    ItemType,
    ShortAcknowledgement,
    ShortMessage,
    ShortMessageError,
    contact_head_bytes,
    decision_fragments,
    items_bytes,
    pack_contact,
    pack_decision,
    unpack_contact,
)
from sonarpost.limits import Turns
from sonarpost.link.state import Bounds, Byte, Word, unpack_value
from sonarpost.messages import Decision, ReceivedImage

FIRST_TIMEOUT_S = 300.0
MAX_TIMEOUT_S = 3600.0
DECISION_PRIORITY = 2
CONTACT_PRIORITY = 5
_WHERE: Final = "state of short messages"


@dataclass(frozen=True, slots=True)
class QueuedItem:
    """An item that no message contains yet.

    Attributes:
        number: Order of arrival.
        priority: 2 for decisions, 5 for contacts.
        name: Identity of its record, to withdraw it.
        created_s: When it was queued.
        item: The item. The preview of a contact can be shortened.
    """

    number: int
    priority: int
    name: str
    created_s: float
    item: Item

    @property
    def vehicle_id(self) -> str:
        """Vehicle of a contact."""
        return self.name.partition("/")[0]

    @property
    def is_first_version(self) -> bool:
        """Whether a contact is the first version of its image."""
        content = self.item.content
        return int.from_bytes(content[content[0] + 4 : content[0] + 8], "big") == 1

    @property
    def min_bytes(self) -> int:
        """Length of the content without the preview."""
        content = self.item.content
        return contact_head_bytes(content) if self.item.type == ItemType.CONTACT else len(content)

    def pack(self) -> bytes:
        """Return the bytes for the store."""
        fields = (self.number, self.priority, self.name, self.created_s, int(self.item.type), self.item.content)
        packed: bytes = msgpack.packb(fields)
        return packed

    @classmethod
    def unpack(cls, data: bytes) -> "QueuedItem":
        """Parse the bytes of `pack`.

        Raises:
            BadInputError: They are not valid.
        """
        number, priority, name, created_s, item_type, content = unpack_value(
            tuple[Word, Byte, str, float, ItemType, bytes], data, _WHERE
        )
        if item_type == ItemType.CONTACT:
            unpack_contact(content, "vessel", _WHERE)
        return cls(number, priority, name, created_s, Item(item_type, content))


@dataclass(slots=True)
class PendingMessage:
    """A message that was made and not acknowledged.

    Attributes:
        data: The bytes.
        due_s: When it is sent again.
        timeout_s: Time between its last transmission and `due_s`.
        turn: Number of its last transmission.
    """

    data: bytes
    due_s: float
    timeout_s: float = FIRST_TIMEOUT_S
    turn: int = 0

    def pack(self) -> bytes:
        """Return the bytes for the store."""
        packed: bytes = msgpack.packb((self.due_s, self.timeout_s, self.data))
        return packed

    @classmethod
    def unpack(cls, data: bytes) -> "PendingMessage":
        """Parse the bytes of `pack`.

        Raises:
            BadInputError: They are not valid.
        """
        due_s, timeout_s, message = unpack_value(
            tuple[float, Annotated[float, Bounds(0, MAX_TIMEOUT_S)], bytes], data, _WHERE
        )
        ShortMessage.unpack(message, _WHERE)
        return cls(message, due_s, timeout_s)

    @property
    def message(self) -> ShortMessage:
        """The message."""
        return ShortMessage.unpack(self.data)


@dataclass(frozen=True, slots=True)
class NextMessage:
    """A message to send now.

    Attributes:
        seq: Its sequence number.
        data: The bytes.
        stored: The bytes for the store, for `ShortMessageSender.restore`.
        packed: Numbers of the queued items that it contains for the first time; empty for a repetition.
    """

    seq: int
    data: bytes
    stored: bytes
    packed: tuple[int, ...] = ()


@dataclass(slots=True)
class ShortMessageSender:
    """Packs records into messages and repeats each message until it is acknowledged.

    The caller stores `queued` items and messages before it sends them, and gives both to the next object after a
    restart, with the same epoch.

    Attributes:
        epoch: Random number (0..2^32 - 1) of the store in which the sequence numbers count.
        next_seq: Sequence number of the next new message.
        next_number: Number of the next queued item.
        after_s: Time that an item waits for another way before it is sent.
    """

    epoch: int
    next_seq: int = 0
    next_number: int = 0
    after_s: float = 0.0
    _queue: dict[int, QueuedItem] = field(default_factory=dict)
    _pending: dict[int, PendingMessage] = field(default_factory=dict)
    _turn: int = 0
    _turns: Turns = field(default_factory=Turns)

    def restore(self, items: Iterable[QueuedItem], messages: Iterable[PendingMessage], now_s: float) -> None:
        """Continue with the stored items and unacknowledged messages; these keep their time-outs."""
        for item in items:
            self._queue[item.number] = item
            self.next_number = max(self.next_number, item.number + 1)
        for pending in messages:
            seq = pending.message.seq
            # The clock can have been set back.
            pending.due_s = min(pending.due_s, now_s + MAX_TIMEOUT_S)
            self._pending[seq] = pending
            self.next_seq = max(self.next_seq, seq + 1)

    @property
    def waiting(self) -> int:
        """Number of queued items."""
        return len(self._queue)

    @property
    def unacknowledged(self) -> int:
        """Number of messages that were made and not acknowledged."""
        return len(self._pending)

    def insert(self, items: Sequence[QueuedItem]) -> tuple[int, ...]:
        """Queue items; a contact replaces a queued one of the same image.

        A later version of an image is not sent if its first version was packed already: further detail waits for
        another way.

        Returns:
            Numbers of the items to remove from the store.
        """
        removed: list[int] = []
        for item in items:
            self.next_number = max(self.next_number, item.number + 1)
            if item.item.type != ItemType.CONTACT:
                self._queue[item.number] = item
                continue
            replaced = self.withdraw(item.name)
            removed += replaced
            if replaced or item.is_first_version:
                self._queue[item.number] = item
            else:
                removed.append(item.number)
        return tuple(removed)

    def withdraw(self, name: str) -> tuple[int, ...]:
        """Remove the queued items of a record that has arrived in another way; return their numbers."""
        numbers = tuple(n for n, queued in self._queue.items() if queued.name == name)
        for number in numbers:
            del self._queue[number]
        return numbers

    def _ready(self, now_s: float) -> list[QueuedItem]:
        """Return the items that have waited long enough: decisions, then contacts, first one of the vehicle in turn."""
        ready = [item for item in self._queue.values() if item.created_s + self.after_s <= now_s]
        ready.sort(key=lambda item: (item.priority, item.number))
        if not ready or ready[0].priority < CONTACT_PRIORITY:
            return ready
        waiting: dict[str, list[QueuedItem]] = {}
        for item in ready:
            waiting.setdefault(item.vehicle_id, []).append(item)
        [first] = self._turns.pick(waiting, 1)
        return [first, *(item for item in ready if item is not first)]

    @property
    def _window_open(self) -> bool:
        return self.next_seq - min(self._pending, default=self.next_seq) < WINDOW and self.next_seq <= MAX_SEQ

    def next_message(self, now_s: float) -> NextMessage | None:
        """Return the message to send now: the oldest that is due for repetition, else a new one.

        The message counts as sent; `failed` takes that back.
        """
        due = [seq for seq, pending in self._pending.items() if pending.due_s <= now_s]
        if due:
            seq = min(due)
            pending = self._pending[seq]
            self._sent(pending, now_s, min(2 * pending.timeout_s, MAX_TIMEOUT_S))
            return NextMessage(seq, pending.data, pending.pack())
        ready = self._ready(now_s) if self._window_open else []
        if not ready:
            return None
        packed, items = _choose(ready)
        seq, oldest = self.next_seq, min(self._pending, default=self.next_seq)
        data = ShortMessage(self.epoch, seq, oldest, items).pack()
        for number in packed:
            del self._queue[number]
        self.next_seq += 1
        pending = self._pending[seq] = PendingMessage(data, 0.0)
        self._sent(pending, now_s, FIRST_TIMEOUT_S)
        return NextMessage(seq, data, pending.pack(), packed)

    def failed(self, seq: int, now_s: float, retry_s: float) -> None:
        """Schedule a message again that the terminal could not send."""
        if seq in self._pending:
            self._pending[seq].due_s = now_s + retry_s

    def _sent(self, pending: PendingMessage, now_s: float, timeout_s: float) -> None:
        self._turn += 1
        pending.turn, pending.timeout_s, pending.due_s = self._turn, timeout_s, now_s + timeout_s

    def acknowledge(self, data: bytes, now_s: float) -> tuple[int, ...]:
        """Process an acknowledgement; return the sequence numbers to remove from the store.

        A message that was sent before a received one, and is not among the received ones, is due for repetition.
        Single numbers of messages that were never made are ignored: the shore site can have received a forged message.

        Raises:
            ShortMessageError: It is not a valid acknowledgement, or its base is above all messages that were made.
        """
        ack = ShortAcknowledgement.unpack(data)
        if ack.epoch != self.epoch:
            return ()  # of an earlier store
        if ack.base > self.next_seq:
            raise ShortMessageError("acknowledgement", "base", ack.base, f"at most {self.next_seq}")
        done = tuple(seq for seq in self._pending if seq < ack.base or seq in ack.received)
        last_turn = max((self._pending.pop(seq).turn for seq in done), default=0)
        for pending in self._pending.values():
            if pending.turn < last_turn:
                pending.due_s = min(pending.due_s, now_s)
        return done


def image_items(image: ReceivedImage, number: int, preview_bytes: int, now_s: float) -> list[QueuedItem]:
    """Return the contact and preview of an image as an item of this number.

    Raises:
        ShortMessageError: A value does not fit the format.
    """
    content = pack_contact(image)
    item = Item(ItemType.CONTACT, content[: contact_head_bytes(content) + preview_bytes])
    return [QueuedItem(number, CONTACT_PRIORITY, image_name(image.vehicle_id, image.image_id), now_s, item)]


def decision_items(decision: Decision, number: int, now_s: float) -> list[QueuedItem]:
    """Return a decision as items that are numbered from this number on.

    Raises:
        ShortMessageError: It is too long.
    """
    items = decision_fragments(pack_decision(decision), number)
    return [
        QueuedItem(number + n, DECISION_PRIORITY, decision.decision_id, now_s, item) for n, item in enumerate(items)
    ]


def image_name(vehicle_id: str, image_id: str) -> str:
    """Return the name of an image for `ShortMessageSender.withdraw`."""
    return f"{vehicle_id}/{image_id}"


def _choose(queue: Sequence[QueuedItem]) -> tuple[tuple[int, ...], tuple[Item, ...]]:
    """Return the first items that fit one message, and their numbers."""
    numbers: list[int] = []
    items: list[Item] = []
    for queued in queue:
        free = MAX_MESSAGE_BYTES - items_bytes(items) - ITEM_HEAD_BYTES
        content = queued.item.content
        # The first item is shortened to fit. Further ones only fill what is left.
        if len(content) > free and (items or queued.min_bytes > free):
            continue
        numbers.append(queued.number)
        items.append(Item(queued.item.type, content[:free]))
    return tuple(numbers), tuple(items)
