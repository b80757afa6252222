"""The sender of the v1 format: contacts and messages in, frames out, in the order of their value.

Pure: `now` in, frames out; the state can be saved and taken up by another process. Previews of all contacts go before
the detail of any; messages share frames with each other and with contact records.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from sonarpost.errors import FrameError, StreamError
from sonarpost.link.coding.block_builder import group_limit, make_group, numbers_needed, whole_blocks
from sonarpost.link.coding.blocks import OutgoingImage, SendBlock
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.coding.delivery_ledger import forgettable, missing, record_delivered, revived, within_window
from sonarpost.link.coding.rate_distortion import Values, quality_curve
from sonarpost.link.coding.redundancy_plan import copies, symbols_to_send
from sonarpost.link.config import SenderConfig
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.feedback import WINDOW, Feedback, FeedbackRequest
from sonarpost.link.frames.v1.frame import (
    BLOCKS,
    HEADER_BYTES,
    FrameProtection,
    Segment,
    SegmentKind,
    Symbol,
    SymbolKind,
    pack_segments,
    pack_symbol,
    segments_room,
)
from sonarpost.link.frames.v1.payload_objects import MESSAGE_OVERHEAD_BYTES, MessageObject
from sonarpost.link.frames.v1.preview import ENTRY_HEAD_BYTES, MAX_NUMBER
from sonarpost.link.sender_feedback import FeedbackTracker
from sonarpost.link.sender_messages import MessageQueue

_LEAST_PREFIX_BYTES: Final = 16
_MOST_SENT: Final = 4
"""So many times its symbols are sent of a block without a report, where others wait for it."""
_MESSAGE_URGENCY: Final = 8.0
_SAFE: Final = -2.5
"""Caution (see `symbols_to_send`) of blocks that go without feedback: so many deviations more than the average."""


class LinkSender:
    """Sends contacts, their pictures and messages.

    With feedback a picture is settled when reports have told that all of it arrived. Whatever was given up before, sent
    while nobody reported or in blocks that had to make room, is sent again when nothing new is due, for as long as the
    picture is kept.

    Attributes:
        waiting: Pictures that no block holds yet.
        blocks: Blocks under way, the oldest first.
        past: Blocks that were sent while nobody reported, and that a report may still tell of.
        kept: Pictures by number, the oldest first, those that wait too.
        owing: Whether there may be pictures of which something was given up.

    Args:
        config: How it behaves.
        first_block: Number of the first block, 0..31; a restarted vehicle that has lost its state should draw it.
        seal: Authenticates frames.
    """

    def __init__(self, config: SenderConfig, *, first_block: int = 0, seal: FrameProtection | None = None) -> None:
        self.config = config
        self._seal = seal
        self.waiting: list[OutgoingImage] = []
        self.blocks: list[SendBlock] = []
        self.past: list[SendBlock] = []
        self.owing = True
        self.messages = MessageQueue()
        self.kept: dict[int, OutgoingImage] = {}
        self.next_block = first_block % BLOCKS
        self.frames_sent = 0
        self.announced: set[int] = set()
        self.book = FeedbackTracker()
        self.reports: list[Segment] = []

    @property
    def symbol_bytes(self) -> int:
        """Bytes of a symbol that fills a frame."""
        return self.config.frame_bytes - HEADER_BYTES - (0 if self._seal is None else self._seal.size)

    @property
    def is_idle(self) -> bool:
        """Whether nothing is left to send or to be asked for."""
        return not (self.waiting or self.blocks or self.messages.waiting or self.reports)

    @property
    def measured_loss(self) -> float | None:
        """Share of frames lost, as the reports of the worst receiver tell; None before the second."""
        return self.book.loss

    def add_picture(
        self,
        number: int,
        contact: ContactSummary,
        stream: bytes,
        now: float,
        mean_square_error: Sequence[float] | Values | None = None,
    ) -> None:
        """Take a contact and its picture.

        Args:
            number: Of the contact, 1..65535, counted on from contact to contact (`v1_objects.next_number`).
            contact: The record.
            stream: Header and body, as much as may ever be sent.
            now: Seconds.
            mean_square_error: See `v1_gain.quality_curve`.

        Raises:
            FrameError: The number is out of range or still in use here.
            StreamError: As `quality_curve`, or the stream is empty.
        """
        if not 1 <= number <= MAX_NUMBER or any(p.number == number for p in self.waiting):
            raise FrameError("acoustic link v1", "contact number", number, f"1..{MAX_NUMBER}, not one that waits")
        if not stream:
            raise StreamError("picture", "stream", stream, "at least one byte")
        picture = OutgoingImage(number, contact.rounded(), stream, quality_curve(len(stream), mean_square_error), now)
        self.waiting.append(picture)
        self.kept.pop(number, None)
        self.kept[number] = picture
        self._forget_kept()

    def _forget_kept(self) -> None:
        """Forget pictures beyond the limit, settled ones first, the oldest first; none that is still to be sent."""
        excess = len(self.kept) - self.config.kept_pictures
        if excess <= 0:
            return
        needed = {p.number for p in self.waiting} | {n for block in self.blocks for n in block.contacts}
        for number in forgettable(self.kept, self.config, needed)[:excess]:
            del self.kept[number]

    def add_message(
        self,
        data: bytes,
        now: float,
        *,
        priority: int = 0,
        lifetime_s: float = 3600.0,
        times: int | None = None,
        rises_at: float = math.inf,
    ) -> int:
        """Take a message; return its number.

        Args:
            data: 1..4096 bytes. Longer than fits a frame, it goes as a block of its own.
            now: Seconds.
            priority: See `WaitingMessage`.
            lifetime_s: How long it is worth sending.
            times: How often to send it; from the measured loss if not given.
            rises_at: See `WaitingMessage`.

        Raises:
            FrameError: Empty or too long.
        """
        often = copies(self.config.worst) if times is None else max(1, times)
        return self.messages.add(data, priority, now + lifetime_s, often, rises_at)

    def add_report(self, report: Feedback | FeedbackRequest) -> None:
        """Send a report or request in the next frame (a receiver's reports go through its own sender)."""
        kind = SegmentKind.FEEDBACK if isinstance(report, Feedback) else SegmentKind.REQUEST
        self.reports.append(Segment(kind, report.pack()))

    def plan_for(self, channels: tuple[LossChannel, ...]) -> None:
        """Plan with another measured loss from now on; what is under way stays as it was planned."""
        self.config = replace(self.config, channels=channels)

    def expect_feedback(self, *, expected: bool) -> None:
        """Plan with or without a receiver that reports from now on; what is under way is sent to its end."""
        if expected == self.config.feedback:
            return
        self.config = replace(self.config, feedback=expected)
        self.owing = True
        if not expected:
            # Nobody will say any more that these are complete.
            for block in [b for b in self.blocks if b.lacks <= 0]:
                self._give_up(block)

    def _give_up(self, block: SendBlock) -> None:
        self.blocks.remove(block)
        self.past += [block] if block.spans else []
        self.owing = True

    def resize(self, frame_bytes: int) -> None:
        """Fill frames of another size from now on.

        Blocks whose symbols are too long for it are given up: their pictures wait again.
        """
        self.config = replace(self.config, frame_bytes=frame_bytes)
        room = segments_room(frame_bytes, self._seal)
        lost = [b for b in self.blocks if b.symbol_bytes != self.symbol_bytes and b.symbol_bytes + 5 > room]
        self.blocks = [b for b in self.blocks if b not in lost]
        self.past = [b for b in self.past if b.symbol_bytes == self.symbol_bytes or b.symbol_bytes + 5 <= room]
        self.owing = True
        waiting = {p.number for p in self.waiting}
        again = {n for block in lost for n in block.contacts} - waiting
        self.waiting = [p for n, p in self.kept.items() if n in again] + self.waiting

    def next_packet(self, frames: int, now: float) -> tuple[bytes, ...]:
        """Return up to so many frames, none when there is nothing to send."""
        packet: list[bytes] = []
        while len(packet) < frames and (frame := self.next_frame(now)) is not None:
            packet.append(frame)
        return tuple(packet)

    def next_frame(self, now: float, *, pictures_first: bool = False) -> bytes | None:
        """Return the frame to send next, None when there is nothing to send.

        Args:
            now: Seconds.
            pictures_first: Let pictures go before messages, so that no flood of messages keeps them out.
        """
        self._begin_groups(now)
        self._begin_repairs(now)
        self.messages.prune(now)
        self._long_messages(now)
        ahead = self._pictures_frame(now) if pictures_first else self._segments_frame(now, least=0)
        frame = ahead or self._pictures_frame(now) or self._segments_frame(now, least=-(2**31))
        if frame is not None:
            self.frames_sent += 1
        return frame

    def _pictures_frame(self, now: float) -> bytes | None:
        if self.config.announce and not any(b.is_fresh_preview and b.lacks > 0 for b in self.blocks):
            announced = self._announcement()
            if announced is not None:
                return announced
        return self._symbol_frame(now)

    def _announcement(self) -> bytes | None:
        """Return a frame of contacts whose group is not under way, so that none waits behind another's detail."""
        found = self._announced(segments_room(self.config.frame_bytes, self._seal))
        return pack_segments(found, self.config.frame_bytes, self._seal) if found else None

    def _begin_groups(self, now: float) -> None:
        symbol_bytes = self.symbol_bytes
        while self.waiting:
            limit = group_limit(self.config, symbol_bytes)
            due = len(self.waiting) >= limit or now - self.waiting[0].added_at >= self.config.group_delay_s
            group = self.waiting[:limit]
            if not due or not self._may_begin(group):
                return
            self.waiting = self.waiting[limit:]
            self.announced -= {p.number for p in group}
            self.blocks += make_group(group, self.config, symbol_bytes, self._take_number, now)

    def _may_begin(self, group: Sequence[OutgoingImage]) -> bool:
        fresh = sum(1 for b in self.blocks if b.kind == SymbolKind.PREVIEW and b.lacks > 0)
        busy = sum(1 for b in self.blocks if b.kind != SymbolKind.PREVIEW and b.lacks > 0)
        if max(fresh, busy) >= self.config.depth:
            return False
        # Only an empty window may be too small: then there is nothing to wait for.
        return not self.blocks or self._free_numbers() >= numbers_needed(group, self.config, self.symbol_bytes)

    def _begin_repairs(self, now: float) -> None:
        """With feedback: send again what was given up, when no new group is due."""
        if not (self.config.feedback and self.owing):
            return
        waiting = {p.number for p in self.waiting}
        kept = {n: p for n, p in self.kept.items() if n not in waiting}
        found = missing(kept, self.config, self.blocks, group_limit(self.config, self.symbol_bytes))
        if not found:
            self.owing = False
            return
        group = [picture for picture, _ in found]
        if not self._may_begin(group):
            return
        for picture, start in found:
            picture.goal, picture.sent = picture.goal_bytes(self.config.stream_bytes), start
        make = make_group if found[0][1] == 0 else whole_blocks
        self.blocks += make(group, self.config, self.symbol_bytes, self._take_number, now)

    def _free_numbers(self) -> int:
        if not self.blocks:
            return WINDOW
        return WINDOW - (self.next_block - self.blocks[0].number) % BLOCKS

    def _take_number(self) -> int:
        # A block beyond the window pushes the oldest out: receivers forget it too.
        while self._free_numbers() < 1:
            self.blocks.pop(0)
            self.owing = True
        number = self.next_block
        self.next_block = (number + 1) % BLOCKS
        # A number must never be taken for that of the block which had it before.
        self.past = within_window(self.past, self.next_block)
        return number

    def _long_messages(self, now: float) -> None:
        room = segments_room(self.config.frame_bytes, self._seal) - 2
        while self._free_numbers() >= 1 and (message := self.messages.take_long(room)) is not None:
            size = self.symbol_bytes
            source = -(-(len(message.data) + MESSAGE_OVERHEAD_BYTES) // size)
            data = MessageObject(message.number, message.data).pack(source * size)
            planned = min(255, symbols_to_send(source, self.config.worst, _SAFE))
            number = self._take_number()
            self.blocks.append(
                SendBlock(SymbolKind.OBJECT, number, size, (data,), None, (), _MESSAGE_URGENCY, planned, asked_at=now)
            )

    def _segments_frame(self, now: float, least: int) -> bytes | None:
        """Return a frame of reports and messages of at least a priority, filled up; None where there is none."""
        room = segments_room(self.config.frame_bytes, self._seal)
        chosen: list[Segment] = []
        while self.reports and self.reports[0].size <= room:
            chosen.append(self.reports.pop(0))
            room -= chosen[-1].size
        if not chosen and not self.messages.has_ready(least, self.frames_sent):
            return None
        messages = self.messages.segments(room, self.frames_sent, spacing=round(4 * self.config.worst.burst))
        room -= sum(segment.size for segment in messages)
        chosen += messages
        if not chosen:
            return None
        chosen += self._fillers(room)
        return pack_segments(chosen, self.config.frame_bytes, self._seal)

    def _fillers(self, room: int) -> list[Segment]:
        """Return what else is of use in a frame that is sent anyway: a symbol, contacts that wait, previews."""
        found: list[Segment] = []
        while room > 0:
            symbol = self._symbol(most_bytes=room - 5)
            if symbol is None:
                break
            found.append(Segment(SegmentKind.SYMBOL, symbol.head() + symbol.data))
            room -= found[-1].size
        return found + self._announced(room)

    def _announced(self, room: int) -> list[Segment]:
        """Return contacts that wait and were not sent yet, as many as there is room for."""
        found: list[Segment] = []
        for picture in self.waiting:
            if room < ENTRY_HEAD_BYTES + 1:
                break
            if picture.number in self.announced:
                continue
            self.announced.add(picture.number)
            prefix = min(room - 2 - ENTRY_HEAD_BYTES, 255 - ENTRY_HEAD_BYTES)
            if prefix >= _LEAST_PREFIX_BYTES:
                preview = picture.preview(min(prefix, len(picture.stream)))
                found.append(Segment(SegmentKind.PREVIEW, preview.pack(ENTRY_HEAD_BYTES + len(preview.prefix))))
            else:
                found.append(Segment(SegmentKind.CONTACT, picture.preview(0).pack(ENTRY_HEAD_BYTES)))
            room -= found[-1].size
        return found

    def _symbol_frame(self, now: float) -> bytes | None:
        symbol = self._symbol(most_bytes=self.symbol_bytes)
        if symbol is None:
            self._remind(now)
            self._go_on()
            symbol = self._symbol(most_bytes=self.symbol_bytes)
        if symbol is None:
            return None
        if len(symbol.data) == self.symbol_bytes:
            return pack_symbol(symbol, self._seal)
        first = Segment(SegmentKind.SYMBOL, symbol.head() + symbol.data)
        room = segments_room(self.config.frame_bytes, self._seal) - first.size
        return pack_segments([first, *self._fillers(room)], self.config.frame_bytes, self._seal)

    def _symbol(self, most_bytes: int) -> Symbol | None:
        """Return the most valuable symbol that fits."""
        open_blocks = [b for b in self.blocks if b.lacks > 0 and b.symbol_bytes <= most_bytes]
        if not open_blocks:
            return None
        # What was asked for goes before what nobody has missed yet, the oldest first: it completes something.
        block = min(
            open_blocks, key=lambda b: (not b.is_fresh_preview, not b.reported, 0.0 if b.reported else b.progress)
        )
        symbol = block.next_symbol()
        if block.lacks <= 0 and not self.config.feedback:
            self._give_up(block)
        return symbol

    def _remind(self, now: float) -> None:
        """With feedback: where no report came for long, send a little more, which makes the receiver report."""
        for block in self._forgotten(now):
            block.asked_at = now
            block.planned += max(1, block.source_symbols // 16)

    def _forgotten(self, now: float) -> list[SendBlock]:
        return [b for b in self.blocks if b.lacks <= 0 and now - b.asked_at >= self.config.max_defer_s]

    def pictures_are_due(self, now: float) -> bool:
        """Whether something of pictures is to be sent, be it a reminder of what nobody has reported of."""
        return bool(self.waiting) or any(b.lacks > 0 for b in self.blocks) or bool(self._forgotten(now))

    def _go_on(self) -> None:
        """With feedback: where the next group waits for room among the blocks, send more of the one least likely there.

        Plans stay below what is likely needed, so this is seldom wasted; silence always is.
        """
        if not self.waiting or any(b.lacks > 0 for b in self.blocks) or not self.config.feedback:
            return
        unsure = [b for b in self.blocks if b.sent < _MOST_SENT * b.source_symbols]
        if self._free_numbers() < WINDOW and unsure:
            min(unsure, key=lambda b: b.sent / b.source_symbols).planned += 1

    def on_report(self, report: Feedback | FeedbackRequest, now: float, receiver: int = 0) -> None:
        """Take what a receiver reports or asks for.

        Args:
            report: What it says.
            now: Seconds.
            receiver: Its modem's address.

        Raises:
            FrameError: It asks for a picture that is not remembered.
        """
        if isinstance(report, FeedbackRequest):
            self.refine(report, now)
        else:
            self.on_feedback(report, now, receiver)

    def on_feedback(self, report: Feedback, now: float, receiver: int = 0) -> None:
        """Take what a receiver reports of the blocks under way.

        A block is done when every receiver that has reported of late has all of it.
        """
        self._revive(report)
        self.blocks, done = self.book.take(report, self.blocks, self.config, now, receiver, self.frames_sent)
        record_delivered(self.kept, done)

    def _revive(self, report: Feedback) -> None:
        """Go on with blocks that were sent before anybody reported, where a receiver has some of them."""
        if self.config.feedback and (found := revived(self.past, report)):
            self.blocks = sorted([*self.blocks, *found], key=lambda b: (b.number - self.next_block) % BLOCKS)

    def on_mini(self, block_number: int, needed: int, now: float, receiver: int = 0) -> None:
        """Take the least form of feedback, from a mini-packet."""
        report = Feedback(block_number, 0, (needed,))
        self._revive(report)
        self.blocks, done = self.book.apply(report, self.blocks, self.config, now, receiver)
        record_delivered(self.kept, done)

    def refine(self, request: FeedbackRequest, now: float) -> bool:
        """Send more detail of a picture than was planned; return whether there is any.

        Raises:
            FrameError: The picture is not remembered.
        """
        picture = self.kept.get(request.number)
        if picture is None:
            raise FrameError("acoustic link v1", "contact number", request.number, "a contact that was sent of late")
        picture.goal = max(picture.goal, picture.sent, min(request.stream_bytes, len(picture.stream)))
        if any(p.number == picture.number for p in self.waiting):
            return True
        made = list(whole_blocks([picture], self.config, self.symbol_bytes, self._take_number, now))
        for block in made:
            if not self.config.feedback:
                block.planned = min(255, symbols_to_send(block.source_symbols, self.config.worst, _SAFE))
        self.blocks += made
        return bool(made)
