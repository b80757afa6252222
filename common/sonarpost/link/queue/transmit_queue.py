"""Transmit queue of a vehicle with the `v1` format: an `ImageSender`.

It adds to `V1Sender`, which plans images: messages of several programs with priority, lifetime and fairness; a share of
the airtime for images; redundancy and rate by the measured loss; expected delivery times. It selects one packet at a
time, so that urgent content waits for one packet at most.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Final

from typing_extensions import override

from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.coding.block_window import FIRST_URGENCY, LAST_URGENCY
from sonarpost.link.coding.blocks import OutgoingImage, SendBlock
from sonarpost.link.coding.channel_capacity import LossChannel, RateSelector
from sonarpost.link.coding.redundancy_plan import copies, usual_curve
from sonarpost.link.config import QueueConfig, SenderConfig
from sonarpost.link.downlink.messages import number_of_image
from sonarpost.link.frames.v1.frame import SymbolKind
from sonarpost.link.frames.v1.payload_objects import MAX_STREAM_BYTES, Feedback, RefineRequest
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.queue.messages import FILLER_PRIORITY, MessageQueue
from sonarpost.link.sender import ExpectedDelivery, ImageSender, ImageToSend, OutgoingPacket, SavedRate, SentImage
from sonarpost.link.state import Bounds, Errors, PartReader, Parts, SavedCount, pack_part

_SEGMENTS: Final = 2
_MIN_LOSS_CHANGE: Final = 0.02
_FRAMES_WITHOUT_FEEDBACK: Final = 64
"""After so many frames and a long time without feedback, no receiver is assumed to send any."""
_MISSED: Final = 0.01
"""Acceptable probability that all copies of a message are lost."""
_URGENT: Final = 2
"""Messages up to this priority may be lost with a tenth of the usual probability."""
_FRAMES_LOADED: Final = 8
"""Messages for so many frames are passed to the sender at a time; more urgent ones can still overtake the rest."""
_MAX_LOSS: Final = 0.95


@dataclass(frozen=True, slots=True)
class TransmitState:
    """The small state of the queue, which changes with every packet.

    Attributes:
        rate: The rate in use.
        losses: See `RateSelector`.
        packet_interval_s: Smoothed time from one packet to the next.
        image_credit: Frames that images may send before messages.
        last_feedback_s: Time of the last feedback, None before the first or after a long time without.
        frames_at_feedback: Frames sent at the last feedback.
        feedback: Whether feedback is expected.
        planned_loss: Loss that plans use.
    """

    rate: SavedRate
    losses: dict[SavedRate, tuple[Annotated[float, Bounds(0, 1)], float]]
    packet_interval_s: Annotated[float, Bounds(0, 1e9)]
    image_credit: float
    last_feedback_s: float | None
    frames_at_feedback: SavedCount
    feedback: bool
    planned_loss: Annotated[float, Bounds(0, _MAX_LOSS)]


class TransmitQueue(ImageSender):
    """The queue of one vehicle; see `ImageSender`.

    Args:
        config: The configuration.
        first_block: See `V1Sender`.
        protection: See `V1Sender`.
    """

    def __init__(
        self, config: QueueConfig, *, first_block: int = 0, protection: FrameAuthenticator | None = None
    ) -> None:
        super().__init__(config.rate(config.first_rate).airtime_s)
        self.config = config
        self.max_messages = config.max_messages
        self.rate_selector = RateSelector(config.rates, config.first_rate)
        self.sender = V1Sender(
            SenderConfig(
                frame_bytes=config.rate(config.first_rate).frame_bytes,
                channels=(LossChannel(config.expected_loss, config.burst_frames),),
                frames_per_image=config.frames_per_image,
                stream_bytes=config.stream_bytes,
                group_delay_s=config.group_delay_s,
                max_defer_s=config.max_defer_s,
                kept_images=config.kept_images,
                announce=True,
            ),
            first_block=first_block,
            protection=protection,
        )
        self.last_feedback_s: float | None = None
        self._frames_at_feedback = 0
        self._image_credit = 0.0
        self._open_before_packet: set[int] = set()

    @property
    @override
    def rate(self) -> int:
        return self.rate_selector.current

    @property
    @override
    def measured_loss(self) -> float | None:
        return self.sender.state.tracker.loss

    @property
    def planned_loss(self) -> float:
        """Share of frames lost that plans use."""
        return self.sender.config.worst.loss

    @property
    @override
    def images_waiting(self) -> int:
        return len(self.open_numbers())

    @property
    @override
    def is_idle(self) -> bool:
        return self.sender.is_idle and not self.messages.waiting and self.in_flight is None

    @override
    def gauges(self) -> Mapping[str, float]:
        return {
            **super().gauges(),
            "messages_waiting": float(len(self.messages.waiting)),
            "messages_expired": float(self.messages.expired),
            "frame_loss": self.planned_loss,
        }

    @override
    def add_image(self, image: ImageToSend, now: float) -> bool:
        """Add an image; return False if nothing has to be sent for it.

        A known image is sent again from its beginning, unless it still waits. If its stream has become longer and
        begins with what was sent, only the new part is sent; if it does not begin so, nothing.

        An image of a contact of which one is kept answers a request: it goes before the detail of the other images, and
        does not wait for a group.

        Raises:
            FrameError: The identifier is invalid, or another image that waits has its number.
            StreamError: See `V1Sender.add_image`.
        """
        answers = any(kept.contact_id == image.contact_id for kept in self.sender.kept.values())
        is_sent = self._add_image(image, now)
        if answers and is_sent:
            self.sender.prioritise(number_of_image(image.image_id), now, first=True)
        return is_sent

    def _add_image(self, image: ImageToSend, now: float) -> bool:
        number = number_of_image(image.image_id)
        known = self.sender.kept.get(number)
        if known is not None and known.contact == image.contact.rounded():
            if len(image.stream) > len(known.stream) and known.sent:
                # Receivers keep what they have: another beginning would give them a wrong image.
                return image.stream[: known.sent] == known.stream[: known.sent] and self._extend(known, image, now)
            if image.stream == known.stream and number in self.open_numbers():
                return False
        self.sender.add_image(
            number,
            image.contact,
            image.stream,
            now,
            image_id=image.image_id,
            contact_id=image.contact_id,
        )
        return True

    def _extend(self, known: OutgoingImage, image: ImageToSend, now: float) -> bool:
        known.curve = usual_curve(len(image.stream))
        known.stream = image.stream
        return self.sender.refine(RefineRequest(known.number, min(len(image.stream), MAX_STREAM_BYTES)), now)

    @override
    def image_id_of(self, number: int) -> str | None:
        image = self.sender.kept.get(number)
        return None if image is None else image.image_id

    @override
    def refine(self, number: int, stream_bytes: int, now: float) -> bool:
        known = self.sender.kept.get(number)
        if known is None:
            return False
        goal = stream_bytes or min(len(known.stream), MAX_STREAM_BYTES)
        if not known.sent < goal <= len(known.stream):
            return False
        return self.sender.refine(RefineRequest(number, goal), now) and self.prioritise(number, now, first=True)

    @override
    def stop(self, number: int) -> bool:
        return self.sender.stop(number)

    @override
    def resume(self, number: int, now: float) -> bool:
        return self.sender.resume(number, now)

    @override
    def prioritise(self, number: int, now: float, *, first: bool) -> bool:
        return self.sender.prioritise(number, now, first=first)

    @override
    def add_message(
        self,
        message_id: str,
        source: str,
        data: bytes,
        now: float,
        *,
        priority: int = 4,
        lifetime_s: float = 3600.0,
        once: bool = False,
    ) -> bool:
        if lifetime_s <= 0:
            self.messages.expired += 1
            return False
        return self.messages.add(
            message_id, source, priority, data, added_s=float(now), expires_s=float(now + lifetime_s), once=once
        )

    @override
    def on_feedback(self, feedback: Feedback | RefineRequest, now: float, receiver: int) -> None:
        """Process feedback or a request of a receiver.

        Raises:
            FrameError: A request for an image that is not kept.
        """
        if isinstance(feedback, Feedback):
            self.last_feedback_s = now
            self._frames_at_feedback = self.sender.state.frames_sent
            if self.config.feedback == "auto":
                self.sender.expect_feedback(expected=True)
        self.sender.on_feedback(feedback, now, receiver)
        loss = self.measured_loss
        if isinstance(feedback, Feedback) and feedback.frames is not None and loss is not None:
            self.rate_selector.record_loss(loss, now)
            if abs(self.planned_loss - loss) >= _MIN_LOSS_CHANGE:
                self.sender.plan_for((LossChannel(min(loss, _MAX_LOSS), self.config.burst_frames),))

    @override
    def _select_packet(self, now: float) -> OutgoingPacket | None:
        self._open_before_packet = self.open_numbers()
        self._update(now)
        self.sender.begin_packet()
        frames: list[bytes] = []
        while len(frames) < self.config.rate(self.rate).frames:
            self._load_messages(now)
            frame = self._next_frame(now)
            if frame is None and not frames and self.sender.state.messages.waiting:
                # There is nothing to send between two copies of a message.
                self.sender.state.messages.release(self.sender.state.frames_sent)
                frame = self._next_frame(now)
            if frame is None and frames:
                frame = self.sender.spare_frame(now)
            if frame is None:
                break
            frames.append(frame)
        return OutgoingPacket(self.rate, tuple(frames)) if frames else None

    def _next_frame(self, now: float) -> bytes | None:
        images_due = self.sender.images_are_due(now)
        images_first = images_due and self._image_credit >= 1.0
        frame = self.sender.next_frame(now, images_first=images_first)
        if frame is not None and images_due:
            has_messages = frame[2] >> 5 & 3 == _SEGMENTS and not images_first
            share = self.config.image_airtime_share
            self._image_credit = min(4.0, self._image_credit + share) if has_messages else 0.0
        return frame

    def _update(self, now: float) -> None:
        """Delete expired messages, stop to expect feedback that does not arrive, and select the rate."""
        self.messages.prune(now)
        last_s = self.last_feedback_s
        if not self.sender.window.blocks:
            self._frames_at_feedback = self.sender.state.frames_sent  # receivers have nothing to report
        frames = self.sender.state.frames_sent - self._frames_at_feedback
        late = last_s is not None and not 0 <= now - last_s <= self.config.feedback_memory_s
        if late and frames >= _FRAMES_WITHOUT_FEEDBACK:
            self.last_feedback_s = None
            self.sender.expect_feedback(expected=False)
            # No frame arrives, or the downlink is broken: the slowest rate has the greatest range.
            self.rate_selector.record_loss(1.0, now)
        before = self.rate
        if self.rate_selector.select(now) != before:
            self.sender.state.tracker.meters.clear()
            self.sender.resize(self.config.rate(self.rate).frame_bytes)

    def _load_messages(self, now: float) -> None:
        """Pass the next messages to the sender; the others wait here, where more urgent ones can overtake them."""
        room = _FRAMES_LOADED * self.sender.symbol_bytes
        loaded = sum(len(m.data) for m in self.sender.state.messages.waiting)
        worst = self.sender.config.worst
        while loaded < room and (message := self.messages.next(now, self.config.aging_s)) is not None:
            level = message.level(now, self.config.aging_s)
            self.messages.remove(message)
            self.sender.state.messages.add(
                message.data,
                -level if level >= FILLER_PRIORITY else FILLER_PRIORITY - level,
                message.expires_s,
                copies(worst, _MISSED / 10 if message.priority <= _URGENT else _MISSED),
                message.added_s + (message.priority - FILLER_PRIORITY + 1) * self.config.aging_s,
                once=message.once,
            )
            loaded += len(message.data)

    @override
    def _packet_sent(self) -> tuple[SentImage, ...]:
        ended = sorted(self._open_before_packet - self.open_numbers())
        kept = [image for number in ended if (image := self.sender.kept.get(number)) is not None]
        return tuple(SentImage(image.image_id, image.contact_id) for image in kept)

    def open_numbers(self) -> set[int]:
        """Return the contact numbers of the images of which something is still to be sent."""
        waiting = {image.number for image in self.sender.waiting}
        return waiting | {n for block in self.sender.window.open_blocks for n in self._live_contacts(block)}

    def _live_contacts(self, block: SendBlock) -> list[int]:
        """Return the contact numbers of a block without those of stopped images, which it still holds."""
        kept = self.sender.kept
        return [n for n in block.contacts if n not in kept or not kept[n].stopped]

    @override
    def expected(self, now: float) -> list[ExpectedDelivery]:
        """Return when each image is expected to be sent, the first to end first.

        Detail of the blocks in transmission is sent in turns, so all of it ends at about the same time; groups follow
        one another. Messages that arrive later are not included.
        """
        frame_s = self.packet_interval_s / self.config.rate(self.rate).frames
        frames_of = dict.fromkeys(self.open_numbers(), 0.0)
        previews: dict[int, float] = {}
        ahead = len(self.sender.state.messages.waiting) / 2
        for block in [b for b in self.sender.window.open_blocks if b.is_fresh_preview]:
            ahead += block.source_symbols - block.sent
            previews.update(dict.fromkeys(block.contacts, now + ahead * frame_s))
        for image in self.sender.waiting:
            ahead += not image.announced
            previews[image.number] = now + ahead * frame_s
        open_blocks = self.sender.window.open_blocks
        for block in open_blocks:
            live = self._live_contacts(block)
            for number in live:
                frames_of[number] += block.left / len(live)
        total = ahead
        done: dict[int, float] = {}
        for first, last in ((True, False), (False, False), (False, True)):
            level = [b for b in open_blocks if (b.urgency == FIRST_URGENCY, b.urgency == LAST_URGENCY) == (first, last)]
            total += sum(b.left for b in level)
            for block in sorted(level, key=lambda b: b.kind != SymbolKind.PREVIEW):
                is_preview = block.kind == SymbolKind.PREVIEW
                ends = dict.fromkeys(block.contacts, now + total * frame_s)
                done = {**ends, **done} if is_preview else {**done, **ends}
        announced = {image.number for image in self.sender.waiting if image.announced}
        for image in self.sender.waiting:
            frames_of[image.number] = self._planned_frames(len(image.stream))
            total += frames_of[image.number]
            done[image.number] = now + total * frame_s
        found: list[ExpectedDelivery] = []
        for number, frames in frames_of.items():
            kept = self.sender.kept.get(number)
            found.append(
                ExpectedDelivery(
                    "0000" if kept is None else kept.image_id,
                    "?" if kept is None else kept.contact_id,
                    round(frames * self.sender.config.frame_bytes),
                    None if number in announced else previews.get(number),
                    done[number],
                )
            )
        return sorted(found, key=lambda e: (e.done_s, e.image_id))

    def _planned_frames(self, stream_bytes: int) -> float:
        config = self.sender.config
        if not config.feedback:
            return config.frames_per_image
        planned_bytes = min(stream_bytes, config.stream_bytes) + 32
        return planned_bytes / self.sender.symbol_bytes / (1 - min(config.worst.loss, 0.9))

    @override
    def parts(self) -> dict[str, bytes]:
        state = TransmitState(
            rate=self.rate,
            losses=self.rate_selector.losses,
            packet_interval_s=self.packet_interval_s,
            image_credit=self._image_credit,
            last_feedback_s=self.last_feedback_s,
            frames_at_feedback=self._frames_at_feedback,
            feedback=self.sender.config.feedback,
            planned_loss=min(self.planned_loss, _MAX_LOSS),
        )
        parts = {"queue": pack_part(state), **self.messages.parts(), **self.sender.parts()}
        return parts if self.in_flight is None else {**parts, "packet": pack_part(self.in_flight)}

    @override
    def restore(self, parts: Parts) -> Errors:
        """Replace the state of a new queue by saved parts; the configuration stays. Return why parts were skipped.

        If the rate in use is not configured any more, the queue continues with the first rate. The packet in flight
        then counts as lost: the modem may not have its rate, or may be another one.
        """
        reader = PartReader(parts, "queue state")
        state = reader.read("queue", TransmitState)
        self.in_flight = reader.read("packet", OutgoingPacket)
        self.messages = MessageQueue.restored(reader)
        if state is not None:
            self._restore_plan(state)
        errors = {**reader.errors, **self.sender.restore(parts)}
        if self.in_flight is not None and self.in_flight.rate not in self.config.rate_numbers:
            self.in_flight = None
        if state is not None and state.rate not in self.config.rate_numbers:
            self.sender.resize(self.config.rate(self.rate).frame_bytes)
        return errors

    def _restore_plan(self, state: TransmitState) -> None:
        self.sender.config = replace(
            self.sender.config,
            frame_bytes=self.config.rate(state.rate).frame_bytes,
            feedback=state.feedback,
            channels=(LossChannel(state.planned_loss, self.config.burst_frames),),
        )
        self.rate_selector.losses = dict(state.losses)
        if state.rate in self.config.rate_numbers:
            self.rate_selector.current = state.rate
        self.packet_interval_s = state.packet_interval_s
        self._image_credit = state.image_credit
        self.last_feedback_s, self._frames_at_feedback = state.last_feedback_s, state.frames_at_feedback
