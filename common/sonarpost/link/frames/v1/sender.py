"""Sender of the `v1` wire format: images and messages in, frames out, the most valuable content first.

Previews of all contacts precede the detail of any image. Messages share frames with each other and with contact
records.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Final

from sonarpost.errors import FrameError, StreamError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.coding.block_window import BlockWindow
from sonarpost.link.coding.blocks import BlockBuilder, OutgoingImage, SendBlock, group_limit
from sonarpost.link.coding.channel_capacity import LossChannel, Values
from sonarpost.link.coding.delivery_ledger import (
    FeedbackTracker,
    deletion_order,
    missing_images,
    record_delivered,
)
from sonarpost.link.coding.redundancy_plan import symbols_to_send, usual_curve
from sonarpost.link.config import SenderConfig
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.frame import (
    BLOCKS,
    HEADER_BYTES,
    Segment,
    SegmentKind,
    Symbol,
    pack_segments,
    pack_symbol,
    segments_room,
)
from sonarpost.link.frames.v1.payload_objects import (
    ENTRY_HEAD_BYTES,
    MAX_NUMBER,
    WINDOW,
    Feedback,
    ImageNumber,
    RefineRequest,
)
from sonarpost.link.queue.messages import MessageSender
from sonarpost.link.state import Bounds, Errors, PartReader, Parts, SavedCount, pack_part

_MIN_PREFIX_BYTES: Final = 16
_NO_FEEDBACK_CAUTION: Final = -2.5
"""Argument `caution` of `symbols_to_send` for a block without feedback: 2.5 standard deviations above the average."""
_ANY_PRIORITY: Final = -(2**31)


@dataclass(eq=False)
class SenderState:
    """The small state of a sender, which changes with every frame.

    Attributes:
        next_block: Number of the next block when the state was saved.
        frames_sent: Frames sent since the first start.
        messages: Messages in transmission.
        tracker: Receivers that send feedback.
    """

    next_block: Annotated[int, Bounds(0, BLOCKS - 1)]
    frames_sent: SavedCount = 0
    messages: MessageSender = field(default_factory=MessageSender)
    tracker: FeedbackTracker = field(default_factory=FeedbackTracker)


@dataclass(frozen=True, slots=True)
class WaitingImages:
    """Numbers of the images that no block holds yet, in the order of sending."""

    numbers: list[ImageNumber] = field(default_factory=list)


class V1Sender:
    """Sends contacts, their images and messages.

    With feedback, an image is delivered when feedback has confirmed all of its blocks. When no new group is due, the
    sender repairs kept images: it sends again the parts that it sent without feedback or gave up.

    Attributes:
        waiting: Images that no block holds yet.
        window: Blocks in transmission.
        kept: Images by number, the oldest first, including those that wait.
        state: The rest of the state.

    Args:
        config: The configuration.
        first_block: Number of the first block, 0..31. A vehicle that has lost its state should draw it at random.
        protection: Authenticates frames.
    """

    def __init__(
        self, config: SenderConfig, *, first_block: int = 0, protection: FrameAuthenticator | None = None
    ) -> None:
        self.config = config
        self._protection = protection
        self.waiting: list[OutgoingImage] = []
        self.window = BlockWindow(first_block)
        self.kept: dict[int, OutgoingImage] = {}
        self.state = SenderState(first_block % BLOCKS)
        self._packet_messages: list[Segment] = []

    @property
    def symbol_bytes(self) -> int:
        """Length of a symbol that fills a frame."""
        overhead = 0 if self._protection is None else self._protection.overhead_bytes
        return self.config.frame_bytes - HEADER_BYTES - overhead

    @property
    def _segments_room(self) -> int:
        return segments_room(self.config.frame_bytes, self._protection)

    def _builder(self, now: float) -> BlockBuilder:
        return BlockBuilder(self.config, self.symbol_bytes, self.window.take_number, now)

    @property
    def is_idle(self) -> bool:
        """Whether there is nothing to send, and nothing that feedback can request."""
        return not (self.waiting or self.window.blocks or self.state.messages.waiting)

    def add_image(
        self,
        number: int,
        contact: ContactSummary,
        stream: bytes,
        now: float,
        *,
        curve: Values | None = None,
        image_id: str = "0000",
        contact_id: str = "?",
    ) -> None:
        """Add a contact and its image.

        Args:
            number: Number of the contact, 1..65535; consecutive for consecutive contacts (`number_after`).
            contact: The contact record.
            stream: Header and body, as much as may ever be sent.
            now: Seconds.
            curve: PSNR in dB by the number of bytes received, shape (len(stream) + 1,); None: see `usual_curve`.
            image_id: Identifier on the vehicle.
            contact_id: Identifier of the contact on the vehicle.

        Raises:
            FrameError: The number is out of range, or an image that waits has it.
            StreamError: The stream is empty or too long.
        """
        if not 1 <= number <= MAX_NUMBER or any(image.number == number for image in self.waiting):
            raise FrameError("acoustic link v1", "contact number", number, f"1..{MAX_NUMBER}, not one that waits")
        if not stream:
            raise StreamError("image", "stream", stream, "at least one byte")
        order = 1 + max((image.order for image in self.kept.values()), default=0)
        curve = usual_curve(len(stream)) if curve is None else curve
        image = OutgoingImage(number, contact.rounded(), stream, curve, float(now), image_id, contact_id, order)
        self.waiting.append(image)
        self.kept.pop(number, None)
        self.kept[number] = image
        self._delete_excess_images()

    def _delete_excess_images(self) -> None:
        """Delete images beyond the limit, completely delivered ones first; none that is still to be sent."""
        excess = len(self.kept) - self.config.kept_images
        if excess > 0:
            needed = {image.number for image in self.waiting} | {
                n for block in self.window.blocks for n in block.contacts
            }
            for number in deletion_order(self.kept, self.config, needed)[:excess]:
                del self.kept[number]

    def plan_for(self, channels: tuple[LossChannel, ...]) -> None:
        """Use another measured loss for future plans; existing plans stay."""
        self.config = replace(self.config, channels=channels)

    def expect_feedback(self, *, expected: bool) -> None:
        """Plan for receivers that send feedback, or that do not; blocks that are being sent are completed."""
        if expected == self.config.feedback:
            return
        self.config = replace(self.config, feedback=expected)
        self.window.may_repair = True
        if not expected:
            self.window.retire_completed()

    def resize(self, frame_bytes: int) -> None:
        """Use another frame length.

        Blocks with symbols that are too long for it are given up; their images wait again.
        """
        self.config = replace(self.config, frame_bytes=frame_bytes)
        again = self.window.resize(self.symbol_bytes, self._segments_room) - {image.number for image in self.waiting}
        self.waiting = [image for number, image in self.kept.items() if number in again] + self.waiting

    def next_frame(self, now: float, *, images_first: bool = False) -> bytes | None:
        """Return the next frame, None if there is nothing to send.

        Args:
            now: Seconds.
            images_first: Whether images precede messages, so that many messages cannot block them.
        """
        self._begin_groups(now)
        self._begin_repairs(now)
        self.state.messages.prune(now)
        self._begin_long_messages(now)
        frame = self._images_frame(now) if images_first else self._segments_frame(now, min_priority=0)
        frame = frame or self._images_frame(now) or self._segments_frame(now, min_priority=_ANY_PRIORITY)
        if frame is not None:
            self.state.frames_sent += 1
        return frame

    def begin_packet(self) -> None:
        """Record that the next frame is the first of a packet."""
        self._packet_messages = []

    def spare_frame(self, now: float) -> bytes | None:
        """Return a frame that fills a packet, whose air time does not depend on the number of its frames.

        It has a further copy of the packet's messages, or with feedback another symbol of the least redundant
        unconfirmed block; None if there is neither.
        """
        if self._packet_messages:
            frame: bytes | None = pack_segments(self._packet_messages, self.config.frame_bytes, self._protection)
            self._packet_messages = []
        else:
            frame = self._symbol_frame(now) if self.config.feedback and self.window.extend_least_redundant() else None
        self.state.frames_sent += frame is not None
        return frame

    def _images_frame(self, now: float) -> bytes | None:
        if self.config.announce and not any(b.is_fresh_preview for b in self.window.open_blocks):
            # Contacts whose group waits precede the detail of others.
            announced = self._announcements(self._segments_room)
            if announced:
                return pack_segments(announced, self.config.frame_bytes, self._protection)
        return self._symbol_frame(now)

    def _begin_groups(self, now: float) -> None:
        symbol_bytes = self.symbol_bytes
        for image in self.waiting:
            image.added_s = min(image.added_s, now)  # later only after the clock was set back
        while self.waiting:
            limit = group_limit(self.config, symbol_bytes)
            oldest_s = min(image.added_s for image in self.waiting)
            due = len(self.waiting) >= limit or now - oldest_s >= self.config.group_delay_s
            group = self.waiting[:limit]
            if not due or not self.window.may_begin(group, self.config, self.symbol_bytes):
                return
            self.waiting = self.waiting[limit:]
            for image in group:
                image.announced = False
            self.window.blocks += self._builder(now).group(group)

    def _begin_repairs(self, now: float) -> None:
        """With feedback, send missing parts again when no new group is due."""
        if not (self.config.feedback and self.window.may_repair):
            return
        waiting = {image.number for image in self.waiting}
        kept = [image for number, image in self.kept.items() if number not in waiting]
        found = missing_images(kept, self.config, self.window.blocks, group_limit(self.config, self.symbol_bytes))
        if not found:
            self.window.may_repair = False
            return
        group = [image for image, _ in found]
        if not self.window.may_begin(group, self.config, self.symbol_bytes):
            return
        for image, start in found:
            image.goal, image.sent = image.goal_bytes(self.config.stream_bytes), start
        builder = self._builder(now)
        self.window.blocks += builder.group(group) if found[0][1] == 0 else builder.unlayered(group)

    def _begin_long_messages(self, now: float) -> None:
        room = self._segments_room - 2
        while self.window.free_numbers >= 1 and (message := self.state.messages.take_long(room)) is not None:
            block = self._builder(now).message(message.number, message.data)
            block.planned = self._planned_without_feedback(block)
            self.window.blocks.append(block)

    def _planned_without_feedback(self, block: SendBlock) -> int:
        return min(255, symbols_to_send(block.source_symbols, self.config.worst, _NO_FEEDBACK_CAUTION))

    def _segments_frame(self, now: float, min_priority: int) -> bytes | None:
        """Return a frame of messages of at least a priority, filled up; None if there are none."""
        room = self._segments_room
        messages, frame = self.state.messages, self.state.frames_sent
        if not messages.has_ready(min_priority, frame):
            return None
        chosen = messages.segments(room, frame, spacing=round(4 * self.config.worst.burst))
        if not chosen:
            return None
        self._packet_messages = chosen
        room -= sum(segment.size for segment in chosen)
        return pack_segments([*chosen, *self._fillers(room)], self.config.frame_bytes, self._protection)

    def _fillers(self, room: int) -> list[Segment]:
        """Return segments for the rest of a frame: symbols, then contacts that wait."""
        found: list[Segment] = []
        while room > 0 and (symbol := self._next_symbol(room - 5)) is not None:
            found.append(Segment(SegmentKind.SYMBOL, symbol.head() + symbol.data))
            room -= found[-1].size
        return found + self._announcements(room)

    def _announcements(self, room: int) -> list[Segment]:
        """Return as many contacts as fit of those that wait and are not announced yet."""
        found: list[Segment] = []
        for image in self.waiting:
            if room < ENTRY_HEAD_BYTES + 1:
                break
            if image.announced:
                continue
            image.announced = True
            prefix = min(room - 2 - ENTRY_HEAD_BYTES, 255 - ENTRY_HEAD_BYTES)
            if prefix >= _MIN_PREFIX_BYTES:
                preview = image.preview(min(prefix, len(image.stream)))
                found.append(Segment(SegmentKind.PREVIEW, preview.pack(ENTRY_HEAD_BYTES + len(preview.prefix))))
            else:
                found.append(Segment(SegmentKind.CONTACT, image.preview(0).pack(ENTRY_HEAD_BYTES)))
            room -= found[-1].size
        return found

    def _symbol_frame(self, now: float) -> bytes | None:
        symbol = self._next_symbol(self.symbol_bytes)
        if symbol is None:
            self.window.send_reminders(now, self.config.max_defer_s)
            self._extend_unconfirmed_block()
            symbol = self._next_symbol(self.symbol_bytes)
        if symbol is None:
            return None
        if len(symbol.data) == self.symbol_bytes:
            return pack_symbol(symbol, self._protection)
        first = Segment(SegmentKind.SYMBOL, symbol.head() + symbol.data)
        room = self._segments_room - first.size
        return pack_segments([first, *self._fillers(room)], self.config.frame_bytes, self._protection)

    def _next_symbol(self, max_bytes: int) -> Symbol | None:
        return self.window.next_symbol(max_bytes, feedback=self.config.feedback)

    def images_are_due(self, now: float) -> bool:
        """Whether there is something to send of images, including reminders."""
        return bool(self.waiting or self.window.open_blocks or self.window.overdue(now, self.config.max_defer_s))

    def _extend_unconfirmed_block(self) -> None:
        """With feedback, while the next group waits for block numbers, send more of the least redundant block.

        Plans stay below the expected need, so most of these symbols are useful.
        """
        if not self.waiting or self.window.open_blocks or not self.config.feedback:
            return
        if self.window.free_numbers < WINDOW:
            self.window.extend_least_redundant()

    def on_feedback(self, feedback: Feedback | RefineRequest, now: float, receiver: int = 0) -> None:
        """Process feedback or a request.

        A block is done when all receivers with recent feedback have all of it.

        Args:
            feedback: The content.
            now: Seconds.
            receiver: Modem address of the receiver.

        Raises:
            FrameError: A request for an image that is not kept.
        """
        if isinstance(feedback, RefineRequest):
            self.refine(feedback, now)
            return
        self.state.tracker.measure(feedback, receiver, self.state.frames_sent)
        window = self.window
        if self.config.feedback:
            window.resume_retired(feedback)
        window.blocks, done = self.state.tracker.apply(feedback, window.blocks, self.config, now, receiver)
        record_delivered(self.kept, done)
        self._drop_stopped()

    def refine(self, request: RefineRequest, now: float) -> bool:
        """Send more detail of an image than was planned; return whether there is any.

        Raises:
            FrameError: The image is not kept.
        """
        image = self.kept.get(request.number)
        if image is None:
            raise FrameError("acoustic link v1", "contact number", request.number, "a contact that was sent recently")
        image.stopped = False
        image.goal = max(image.goal, image.sent, min(request.stream_bytes, len(image.stream)))
        if any(waiting.number == image.number for waiting in self.waiting):
            return True
        made = list(self._builder(now).unlayered([image]))
        for block in made:
            if not self.config.feedback:
                block.planned = self._planned_without_feedback(block)
        self.window.blocks += made
        return bool(made)

    def stop(self, number: int) -> bool:
        """Send nothing more of an image until a command requests it; return whether the image is kept.

        Blocks that other images share are sent on without it where that ends sooner.
        """
        image = self.kept.get(number)
        if image is None:
            return False
        image.stopped = True
        self.waiting = [other for other in self.waiting if other.number != number]
        self._drop_stopped()
        return True

    def resume(self, number: int, now: float) -> bool:
        """Queue the rest of a stopped image; return False if the image is not stopped."""
        image = self.kept.get(number)
        if image is None or not image.stopped:
            return False
        image.stopped = False
        if image.sent:
            self.refine(RefineRequest(number, image.goal_bytes(self.config.stream_bytes)), now)
        else:
            self.waiting.append(image)
        return True

    def prioritise(self, number: int, now: float, *, first: bool) -> bool:
        """Send the rest of an image before or after everything else; return whether the image is kept.

        An image that shares a block continues in a block of its own, if that ends sooner than the shared one.
        """
        image = self.kept.get(number)
        if image is None:
            return False
        self.resume(number, now)
        has_numbers = self.window.has_numbers_for([image], self.config, self.symbol_bytes)
        if image in self.waiting:
            self.waiting.remove(image)
            if first and has_numbers:
                self.window.blocks += self._builder(now).group([image])
            else:
                self.waiting.insert(0 if first else len(self.waiting), image)
        elif has_numbers and self._leave_out({number}, shared_only=True):
            self.refine(RefineRequest(number, image.goal_bytes(self.config.stream_bytes)), now)
        self.window.move(number, first=first)
        return True

    def _drop_stopped(self) -> None:
        """Leave out stopped images from the blocks that are being sent."""
        stopped = {number for number, image in self.kept.items() if image.stopped}
        if stopped:
            self._leave_out(stopped)

    def _leave_out(self, numbers: set[int], *, shared_only: bool = False) -> bool:
        def unsent(number: int, link: int, start: int) -> None:
            image = self.kept.get(number)
            if image is not None and image.link == link:
                image.sent = min(image.sent, start)

        return self.window.leave_out(numbers, self.config.worst, unsent, shared_only=shared_only)

    def parts(self) -> dict[str, bytes]:
        """Return the state to save, see `sonarpost.link.state`."""
        waiting = WaitingImages([image.number for image in self.waiting])
        state = replace(self.state, next_block=self.window.next_block)
        parts = {"sender": pack_part(state), "waiting": pack_part(waiting)}
        for image in {image.number: image for image in (*self.kept.values(), *self.waiting)}.values():
            parts[f"image/{image.number}"] = pack_part(image)
            parts[f"image-progress/{image.number}"] = pack_part(image, "progress")
        for block in (*self.window.blocks, *self.window.retired):
            parts[f"block/{block.number}"] = pack_part(block)
            parts[f"block-progress/{block.number}"] = pack_part(block, "progress")
        return parts

    def restore(self, parts: Parts) -> Errors:
        """Replace the state by saved parts; the configuration stays. Return why parts were skipped.

        If a part other than an image cannot be read, the progress is unknown: the sender then starts again with all
        images that are not delivered.
        """
        reader = PartReader(parts, "sender state")
        images = reader.read_group("image", OutgoingImage, progress="image-progress")
        blocks = reader.read_group("block", SendBlock, progress="block-progress")
        waiting = reader.read("waiting", WaitingImages) or WaitingImages()
        state = reader.read("sender", SenderState) or self.state
        self.kept = {image.number: image for image in sorted(images, key=lambda image: image.order)}
        self.waiting = [self.kept[number] for number in waiting.numbers if number in self.kept]
        if "sender" not in reader or any(not name.startswith("image/") for name in reader.errors):
            # A receiver takes a block half the numbers away for a new one.
            state.next_block = (blocks[0].number + WINDOW) % BLOCKS if blocks else state.next_block
            blocks = []
            self.waiting = [image for image in self.kept.values() if missing_images([image], self.config, (), 1)]
            for image in self.waiting:
                image.sent = 0
        self.state, self.window.next_block = state, state.next_block
        self.window.restore(blocks)
        return reader.errors
