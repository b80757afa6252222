"""A sender, a receiver and a channel between them, for the tests of the v1 format."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.coding.redundancy_plan import copies
from sonarpost.link.config import QueueConfig, ReceiverConfig, SenderConfig
from sonarpost.link.downlink.messages import number_of_image
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, pack_segments
from sonarpost.link.frames.v1.payload_objects import Feedback
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import Event, FeedbackReceived, FrameRejected, ImageUpdate, MessageReceived
from sonarpost.link.sender import ImageSender
from sonarpost.modem.micromodem import RATES

VEHICLE = 3
VESSEL = 1


def contact(number: int) -> ContactSummary:
    return ContactSummary(lat_deg=44.0 + number * 1e-4, lon_deg=-63.0, confidence=1.0).rounded()


def stream(number: int, length: int) -> bytes:
    return np.random.default_rng(number).integers(0, 256, length, dtype=np.uint8).tobytes()


def take_packet(queue: ImageSender, now: float) -> tuple[bytes, ...]:
    """Return the frames of the next packet and count it as sent; none if there is no packet."""
    packet = queue.next_packet(now)
    frames = () if packet is None else packet.frames
    queue.sent(frames, queue.packet_interval_s)
    return frames


def next_frames(sender: V1Sender, count: int, now: float) -> tuple[bytes, ...]:
    """Return the next frames of a sender, at most `count`."""
    frames = (sender.next_frame(now) for _ in range(count))
    return tuple(frame for frame in frames if frame is not None)


def feedback_frame(feedback: Feedback, protection: FrameAuthenticator | None = None) -> bytes:
    """Return the frame of 32 bytes that carries a feedback."""
    return pack_segments([Segment(SegmentKind.FEEDBACK, feedback.pack())], 32, protection)


def add_message(
    sender: V1Sender,
    data: bytes,
    now: float,
    *,
    priority: int = 0,
    lifetime_s: float = 3600.0,
    times: int | None = None,
) -> int:
    """Add a message, with as many copies as the loss needs by default; return its number."""
    times = copies(sender.config.worst) if times is None else times
    return sender.state.messages.add(data, priority, now + lifetime_s, times)


@dataclass
class World:
    """Sends a frame every second through a channel that loses some.

    Attributes:
        passes: Decides whether a frame arrives.
    """

    sender: V1Sender
    receiver: V1Receiver
    passes: Callable[[], bool]
    feedback: bool = False
    now: float = 0.0
    frames: int = 0
    feedback_frames: int = 0
    events: list[Event] = field(default_factory=list)
    sent: dict[int, bytes] = field(default_factory=dict)

    @classmethod
    def make(cls, loss: float, seed: int = 0, *, receiver: ReceiverConfig | None = None, **config: object) -> World:
        rng = np.random.default_rng(seed)
        made = SenderConfig(**config)  # type: ignore[arg-type]
        return cls(V1Sender(made), V1Receiver(receiver), lambda: bool(rng.random() >= loss), feedback=made.feedback)

    def add(self, count: int, length: int, first: int = 1) -> None:
        for number in range(first, first + count):
            self.sent[number] = stream(number, length)
            self.sender.add_image(number, contact(number), self.sent[number], self.now)

    def run(self, most_frames: int = 100_000) -> None:
        back = V1Receiver()
        stop = self.now + most_frames
        while not self.sender.is_idle and self.now < stop:
            self.now += 1.0
            frame = self.sender.next_frame(self.now)
            if frame is not None:
                assert len(frame) == self.sender.config.frame_bytes
                self.frames += 1
                if self.passes():
                    self.take(frame)
            if not (self.feedback and self.receiver.feedback_is_due(VEHICLE, self.now)):
                continue
            feedback = self.receiver.feedback(VEHICLE, self.now)
            assert feedback is not None
            self.feedback_frames += 1
            if self.passes():
                (event,) = back.accept(VESSEL, feedback_frame(feedback), self.now)
                assert isinstance(event, FeedbackReceived)
                self.sender.on_feedback(event.feedback, self.now)

    def take(self, frame: bytes) -> None:
        found = self.receiver.accept(VEHICLE, frame, self.now)
        for event in found:
            assert not isinstance(event, FrameRejected), event.reason
            if isinstance(event, ImageUpdate):
                self.check(event)
        self.events += found

    def check(self, event: ImageUpdate) -> None:
        number = number_of_image(event.image_id)
        assert self.sent[number].startswith(event.stream)
        assert event.contact == contact(number)

    @property
    def latest(self) -> dict[int, ImageUpdate]:
        return {number_of_image(e.image_id): e for e in self.events if isinstance(e, ImageUpdate)}

    @property
    def messages(self) -> list[bytes]:
        return [e.data for e in self.events if isinstance(e, MessageReceived)]


def queue_config(
    rates: Sequence[int] = (1,), first_rate: int = 1, expected_loss: float = 0.2, **more: Any
) -> QueueConfig:
    """Return a configuration of the transmit queue with rates of the Micro-Modem."""
    return QueueConfig(tuple(RATES[number] for number in rates), first_rate, expected_loss, **more)
