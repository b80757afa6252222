"""Messages to send: the programs' messages by priority, age and fairness, and the copies of those in transmission."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Final

from sonarpost.errors import FrameError
from sonarpost.link.frames.v1.frame import Segment, SegmentKind
from sonarpost.link.state import SEPARATE, Bounds, Byte, PartReader, SavedCount, pack_part

LOWEST_PRIORITY: Final = 7
FILLER_PRIORITY: Final = 6
"""From this priority on a message only fills the rest of frames, until it has aged."""
MAX_MESSAGE_BYTES: Final = 4096
_MAX_KNOWN_IDS: Final = 1024
_MAX_SEGMENT_DATA_BYTES: Final = 254


@dataclass(frozen=True, slots=True)
class QueuedMessage:
    """A message of a program that waits.

    Attributes:
        key: Position in the order of arrival.
        message_id: Identifier, unique in the program.
        source: Name of the program.
        priority: 1 first to 7 last.
        added_s: Time of arrival, UTC in seconds.
        expires_s: Time when the message becomes useless.
        data: Content.
        once: Whether it is sent once, without copies against loss.
    """

    key: SavedCount
    message_id: str
    source: str
    priority: Annotated[int, Bounds(1, LOWEST_PRIORITY)]
    added_s: float
    expires_s: float
    data: bytes
    once: bool = False

    def level(self, now: float, aging_s: float) -> int:
        """Return the priority after aging: one level more urgent every `aging_s`, up to 2."""
        aged = self.priority - int(max(0.0, now - self.added_s) / aging_s)
        return max(min(self.priority, 2), aged)


@dataclass(frozen=True, slots=True)
class MessageIdentifier:
    """Identifier of a message that was accepted.

    Attributes:
        order: Rises with every message.
        name: Program and identifier.
    """

    order: SavedCount
    name: str


@dataclass(eq=False)
class MessageQueue:
    """The messages that wait.

    Attributes:
        next_key: Key of the next message.
        served: Bytes sent for each program. A program without waiting messages starts at the least value of the others.
        expired: Number of messages that expired.
        waiting: By key.
        known: Order of the recently accepted identifiers, to reject a message that arrives twice.
    """

    next_key: SavedCount = 0
    served: dict[str, SavedCount] = field(default_factory=dict)
    expired: SavedCount = 0
    waiting: dict[int, QueuedMessage] = field(default_factory=dict, metadata=SEPARATE)
    known: dict[str, int] = field(default_factory=dict, metadata=SEPARATE)

    @property
    def waiting_bytes(self) -> int:
        """Total length of the waiting messages."""
        return sum(len(message.data) for message in self.waiting.values())

    def add(
        self,
        message_id: str,
        source: str,
        priority: int,
        data: bytes,
        *,
        added_s: float,
        expires_s: float,
        once: bool = False,
    ) -> bool:
        """Add a message; return False if the program has used the identifier before."""
        name = f"{source}\0{message_id}"
        if name in self.known:
            return False
        self.known[name] = self.next_key
        while len(self.known) > _MAX_KNOWN_IDS:
            del self.known[next(iter(self.known))]
        active = {m.source for m in self.waiting.values()}
        if source not in active:
            # A program that was silent has no credit: with it, the program could block all others.
            floor = min((self.served.get(name, 0) for name in active), default=0)
            self.served[source] = max(self.served.get(source, 0), floor)
        message = QueuedMessage(self.next_key, message_id, source, priority, added_s, expires_s, data, once)
        self.waiting[message.key] = message
        self.next_key += 1
        return True

    def prune(self, now: float) -> None:
        """Delete expired messages, and the counters of `served` when nothing waits."""
        for message in [m for m in self.waiting.values() if m.expires_s <= now]:
            del self.waiting[message.key]
            self.expired += 1
        if not self.waiting:
            self.served.clear()

    def next(self, now: float, aging_s: float) -> QueuedMessage | None:
        """Return the message to send next: most urgent level, then least served program, then oldest."""
        return min(
            self.waiting.values(),
            key=lambda m: (m.level(now, aging_s), self.served.get(m.source, 0), m.key),
            default=None,
        )

    def remove(self, message: QueuedMessage) -> None:
        """Remove a message that is being sent, and count its bytes for the program."""
        del self.waiting[message.key]
        self.served[message.source] = self.served.get(message.source, 0) + len(message.data)

    def parts(self) -> dict[str, bytes]:
        """Return the state to save, see `sonarpost.link.state`."""
        waiting = {f"message/{key}": pack_part(message) for key, message in self.waiting.items()}
        known = {f"message-id/{n}": pack_part(MessageIdentifier(n, name)) for name, n in self.known.items()}
        return {"messages": pack_part(self), **waiting, **known}

    @classmethod
    def restored(cls, reader: PartReader) -> MessageQueue:
        """Return the queue that was saved."""
        waiting = sorted(reader.read_group("message", QueuedMessage), key=lambda m: m.key)
        known = sorted(reader.read_group("message-id", MessageIdentifier), key=lambda m: m.order)
        keys = [*(m.key for m in waiting), *(m.order for m in known)]
        queue = reader.read("messages", cls) or cls(next_key=1 + max(keys, default=-1))
        queue.waiting = {m.key: m for m in waiting}
        queue.known = {m.name: m.order for m in known}
        return queue


@dataclass(eq=False)
class MessageCopies:
    """A message in transmission: the copies still to send.

    Attributes:
        number: 0..255.
        data: Content.
        priority: The greater goes first. From 0 on before images, below 0 only in the rest of frames.
        expires_s: Time when the message becomes useless.
        copies: Copies still to send.
        after_frame: Number of the first frame for the next copy, so that one burst does not destroy all copies.
        rises_s: Time when a priority below 0 becomes 0, None for never.
        extra: Additional copies for the case that copies follow one another and one burst can destroy several.
    """

    number: Byte
    data: bytes
    priority: int
    expires_s: float
    copies: int
    after_frame: int = 0
    rises_s: float | None = None
    extra: Annotated[int, Bounds(0, 9)] = 2


@dataclass(eq=False)
class MessageSender:
    """The messages in transmission.

    Attributes:
        waiting: Those with copies to send, the most urgent first.
        next_number: Number of the next message.
    """

    waiting: list[MessageCopies] = field(default_factory=list)
    next_number: Byte = 0

    def add(
        self,
        data: bytes,
        priority: int,
        expires_s: float,
        copies: int,
        rises_s: float | None = None,
        *,
        once: bool = False,
    ) -> int:
        """Add a message; return its number. With `once` it is sent once, whatever the number of `copies`.

        Raises:
            FrameError: It is empty or longer than 4096 bytes.
        """
        if not 1 <= len(data) <= MAX_MESSAGE_BYTES:
            raise FrameError("acoustic link v1", "message", f"{len(data)} bytes", f"1..{MAX_MESSAGE_BYTES}")
        number = self.next_number
        self.next_number = (number + 1) % 256
        added = MessageCopies(number, data, priority, expires_s, copies, 0, rises_s)
        if once:
            added.copies, added.extra = 1, 0
        self.waiting.append(added)
        self.waiting.sort(key=lambda m: -m.priority)
        return number

    def prune(self, now: float) -> None:
        """Delete messages without copies to send and expired ones; raise the priority of those that are due."""
        self.waiting = [m for m in self.waiting if m.copies > 0 and m.expires_s > now]
        for message in self.waiting:
            if message.priority < 0 and message.rises_s is not None and message.rises_s <= now:
                message.priority = 0
        self.waiting.sort(key=lambda m: -m.priority)

    def take_long(self, room: int) -> MessageCopies | None:
        """Remove and return a message that is longer than a segment of `room` bytes can hold, None if there is none."""
        found = next((m for m in self.waiting if len(m.data) > min(room, _MAX_SEGMENT_DATA_BYTES)), None)
        if found is not None:
            self.waiting.remove(found)
        return found

    def release(self, frame: int) -> None:
        """Allow all copies from frame number `frame` on: there is nothing to send between them."""
        for message in self.waiting:
            if message.after_frame > frame:
                message.after_frame = frame
                message.copies += message.extra > 0
                message.extra = max(0, message.extra - 1)

    def has_ready(self, min_priority: int, frame: int) -> bool:
        """Whether a message of at least a priority may go into frame number `frame`."""
        return any(m.priority >= min_priority and m.after_frame <= frame for m in self.waiting)

    def segments(self, room: int, frame: int, spacing: int) -> list[Segment]:
        """Return the most urgent messages that fit into `room` bytes; their next copies wait `spacing` frames."""
        found: list[Segment] = []
        for message in self.waiting:
            segment = Segment(SegmentKind.MESSAGE, bytes([message.number]) + message.data)
            if message.after_frame <= frame and segment.size <= room and message.copies > 0:
                found.append(segment)
                room -= segment.size
                message.copies -= 1
                message.after_frame = frame + 1 + spacing
        return found
