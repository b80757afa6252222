"""Messages that wait to be sent: in the order of their priority, each as often as the loss demands."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from sonarpost.errors import FrameError
from sonarpost.link.frames.v1.frame import Segment, SegmentKind

MAX_MESSAGE_BYTES: Final = 4096
_LONGEST_SEGMENT: Final = 254


@dataclass(eq=False)
class WaitingMessage:
    """A message to send.

    Attributes:
        number: 0..255.
        data: The bytes.
        priority: The greater goes first; from 0 on before pictures, below 0 only in what is left of frames.
        expires_at: When it is worth nothing any more.
        copies: How often it is still to be sent.
        after_frame: Frame count before which it is not repeated, so that one burst does not take all copies.
        rises_at: When a priority below 0 becomes 0, so that what only fills frames does not wait for ever.
        extra: Copies it gets more where copies follow one another and one burst may take several.
    """

    number: int
    data: bytes
    priority: int
    expires_at: float
    copies: int
    after_frame: int = 0
    rises_at: float = math.inf
    extra: int = 2


@dataclass(eq=False)
class MessageQueue:
    """The messages of a sender.

    Attributes:
        waiting: The most urgent first.
        next_number: Of the next message.
    """

    waiting: list[WaitingMessage] = field(default_factory=list)
    next_number: int = 0

    def add(self, data: bytes, priority: int, expires_at: float, copies: int, rises_at: float = math.inf) -> int:
        """Take a message; return its number.

        Raises:
            FrameError: It is empty or longer than 4096 bytes.
        """
        if not 1 <= len(data) <= MAX_MESSAGE_BYTES:
            raise FrameError("acoustic link v1", "message", f"{len(data)} bytes", f"1..{MAX_MESSAGE_BYTES}")
        number = self.next_number
        self.next_number = (number + 1) % 256
        self.waiting.append(WaitingMessage(number, data, priority, expires_at, copies, 0, rises_at))
        self.waiting.sort(key=lambda m: -m.priority)
        return number

    def prune(self, now: float) -> None:
        """Drop what was sent often enough or has expired; let rise what has waited long enough."""
        self.waiting = [m for m in self.waiting if m.copies > 0 and m.expires_at > now]
        rising = [m for m in self.waiting if m.priority < 0 and m.rises_at <= now]
        for message in rising:
            message.priority = 0
        if rising:
            self.waiting.sort(key=lambda m: -m.priority)

    def take_long(self, room: int) -> WaitingMessage | None:
        """Return a message that no segment of `room` bytes holds, and drop it; None when there is none."""
        found = next((m for m in self.waiting if len(m.data) > min(room, _LONGEST_SEGMENT)), None)
        if found is not None:
            self.waiting.remove(found)
        return found

    def release(self, frame: int) -> None:
        """Let copies go from this frame on that keep a distance from those before, as there is nothing else to send."""
        for message in self.waiting:
            if message.after_frame > frame:
                message.after_frame = frame
                message.copies += message.extra > 0
                message.extra = max(0, message.extra - 1)

    def has_ready(self, least: int, frame: int) -> bool:
        """Whether a message of at least a priority may go into this frame."""
        return any(m.priority >= least and m.after_frame <= frame for m in self.waiting)

    def segments(self, room: int, frame: int, spacing: int) -> list[Segment]:
        """Return the most urgent messages that fit; each counts as sent once and waits for `spacing` frames."""
        found: list[Segment] = []
        for message in self.waiting:
            segment = Segment(SegmentKind.MESSAGE, bytes([message.number]) + message.data)
            if message.after_frame <= frame and segment.size <= room and message.copies > 0:
                found.append(segment)
                room -= segment.size
                message.copies -= 1
                message.after_frame = frame + 1 + spacing
        return found
