"""State of the delivery according to feedback: complete blocks, missing parts of images, and the loss.

A complete block means that its parts of images are delivered. A block that the sender gave up delivers nothing: it was
sent without feedback, left the window, or has another frame length. Its parts are missing until another block delivers
them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Final

from sonarpost.link.coding.blocks import OutgoingImage, SendBlock
from sonarpost.link.coding.byte_ranges import Ranges, add_range, gaps_within
from sonarpost.link.coding.redundancy_plan import symbols_to_send
from sonarpost.link.config import SenderConfig
from sonarpost.link.frames.v1.frame import BLOCKS
from sonarpost.link.frames.v1.payload_objects import NEVER_RECEIVED, WINDOW, Feedback
from sonarpost.link.state import Bounds, SavedCount

_MIN_FRAMES_TO_MEASURE: Final = 16
_RECEIVER_MEMORY_S: Final = 3600.0
"""How long after its last feedback a receiver counts."""


@dataclass(eq=False)
class LossMeter:
    """Measures the loss from the frames sent and received between two feedback messages.

    Attributes:
        loss: Share of frames lost, None before the second feedback.
        last_counts: Frames sent and frames received at the last feedback that was used.
    """

    loss: Annotated[float, Bounds(0, 1)] | None = None
    last_counts: tuple[SavedCount, SavedCount] | None = None

    def update(self, frames_received: int, frames_sent: int) -> None:
        """Add a feedback with a weight of a quarter. Intervals of fewer than 16 frames are joined."""
        if self.last_counts is not None:
            sent = frames_sent - self.last_counts[0]
            if sent < _MIN_FRAMES_TO_MEASURE:
                return
            received = (frames_received - self.last_counts[1]) % 65536
            loss = min(max(1.0 - received / sent, 0.0), 1.0)
            self.loss = loss if self.loss is None else 0.75 * self.loss + 0.25 * loss
        self.last_counts = (frames_sent, frames_received)


@dataclass(eq=False)
class FeedbackTracker:
    """The receivers that send feedback.

    Attributes:
        receivers: Time of the last feedback, by modem address.
        meters: Loss to each, by modem address.
    """

    receivers: dict[int, float] = field(default_factory=dict)
    meters: dict[int, LossMeter] = field(default_factory=dict)

    @property
    def loss(self) -> float | None:
        """Share of frames lost to the worst receiver; None before the second feedback of any."""
        known = [m.loss for r, m in self.meters.items() if m.loss is not None and r in self.receivers]
        return max(known, default=None)

    def measure(self, feedback: Feedback, receiver: int, frames_sent: int) -> None:
        """Update the loss to a receiver."""
        if feedback.frames is not None:
            self.meters.setdefault(receiver, LossMeter()).update(feedback.frames, frames_sent)

    def apply(
        self, feedback: Feedback, blocks: Sequence[SendBlock], config: SenderConfig, now: float, receiver: int
    ) -> tuple[list[SendBlock], list[SendBlock]]:
        """Plan the blocks according to a feedback; return the blocks to continue, and those that all receivers have."""
        self.receivers[receiver] = now
        self.receivers = {r: at for r, at in self.receivers.items() if at + _RECEIVER_MEMORY_S >= now}
        self.meters = {r: meter for r, meter in self.meters.items() if r in self.receivers}
        done = [block for block in blocks if self._is_done(block, feedback, config, now, receiver)]
        return [block for block in blocks if block not in done], done

    def _is_done(self, block: SendBlock, feedback: Feedback, config: SenderConfig, now: float, receiver: int) -> bool:
        need = feedback.missing_of(block.number)
        if need is None:
            behind = (feedback.newest - block.number) % BLOCKS
            if behind >= WINDOW or block.reported or len(feedback.missing) < 2:
                return False  # newer than all received blocks, reported before, or feedback on one block only
            need = NEVER_RECEIVED
        block.reported = block.reported or need != NEVER_RECEIVED
        block.last_activity_s = now
        # A count that is older than a reduction of the block can exceed the block.
        block.missing[receiver] = min(need, block.source_symbols)
        if max(block.missing.get(known, block.source_symbols) for known in self.receivers) == 0:
            return True
        if need > 0:
            more = symbols_to_send(block.missing[receiver], config.worst)
            block.planned = max(block.sent + more, block.planned if len(self.receivers) > 1 else 0)
        return False


def record_delivered(images: Mapping[int, OutgoingImage], done: Iterable[SendBlock]) -> None:
    """Record that receivers have all of these blocks."""
    for block in done:
        for number, link, start, stop in block.spans:
            image = images.get(number)
            if image is not None and image.link == link:
                image.delivered = add_range(image.delivered, start, min(stop, len(image.stream)))


def missing_start(image: OutgoingImage, config: SenderConfig, blocks: Sequence[SendBlock]) -> int | None:
    """Return the first byte of an image that is neither delivered nor in a block, None if there is none.

    A stopped image has none.
    """
    if image.stopped:
        return None
    covered: Ranges = image.delivered
    for block in blocks:
        for number, link, start, stop in block.spans:
            if number == image.number and link == image.link:
                covered = add_range(covered, start, stop)
    gaps = gaps_within(covered, 0, image.goal_bytes(config.stream_bytes))
    return gaps[0][0] if gaps else None


def missing_images(
    images: Iterable[OutgoingImage], config: SenderConfig, blocks: Sequence[SendBlock], limit: int
) -> list[tuple[OutgoingImage, int]]:
    """Return images with missing parts, at most `limit`, the oldest first, and the first missing byte of each.

    Images without a delivered record do not mix with those that lack only detail: if there are any, all are of the
    first kind.
    """
    found = [(image, start) for image in images if (start := missing_start(image, config, blocks)) is not None]
    without_record = [(image, start) for image, start in found if start == 0]
    return (without_record or found)[:limit]


def deletion_order(images: Mapping[int, OutgoingImage], config: SenderConfig, needed: Iterable[int]) -> list[int]:
    """Return the numbers of the images that are not needed, those that are completely delivered first."""
    keep = set(needed)
    free = [image for number, image in images.items() if number not in keep]
    return [image.number for image in sorted(free, key=lambda i: missing_start(i, config, ()) is not None)]
