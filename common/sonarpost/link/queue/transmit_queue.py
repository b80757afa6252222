"""The vehicle's acoustic queue: pictures and other traffic in, packets out, in the order of their value.

Pure: `now` in (UTC in seconds), packets out. It stands before the v1 `LinkSender`, which plans pictures, and adds what
makes it a queue of a vehicle: messages of several programs by priority, lifetime and fairness, a share of the water
that no flood of messages can take from pictures, redundancy and rate by the measured loss, and when everything is
expected to have gone. Packets are chosen one at a time, so that whatever is more urgent waits for one packet at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from sonarpost.errors import ConfigError
from sonarpost.link.coding.blocks import OutgoingImage
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.coding.rate_distortion import quality_curve
from sonarpost.link.coding.redundancy_plan import copies
from sonarpost.link.config import SenderConfig
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.feedback import Feedback, FeedbackRequest
from sonarpost.link.frames.v1.frame import FrameProtection
from sonarpost.link.frames.v1.payload_objects import MAX_STREAM_BYTES
from sonarpost.link.queue.messages import FILLS_FROM, WaitingMessages
from sonarpost.link.queue.rate_choice import RateSelector
from sonarpost.link.sender import LinkSender
from sonarpost.modem.micromodem import RATES

_SEGMENTS: Final = 2
_LEAST_CHANGE: Final = 0.02
_SMOOTHING: Final = 0.2
_SILENT_FRAMES: Final = 64
"""Without a report of so many frames, and for long, there is nobody who reports; a silent vehicle gets none."""
_URGENT: Final = 2
"""To this priority messages may be lost with a tenth of the usual probability."""
_FRAMES_LOADED: Final = 8
"""Messages for so many frames are given to the sender at a time: what is behind them may still be overtaken."""


@dataclass(frozen=True, slots=True)
class QueueConfig:
    """How the queue behaves.

    Attributes:
        rates: Numbers of the rates that may be used; the loss decides which.
        first_rate: The one to begin with.
        expected_loss: Share of frames lost, until it is measured.
        burst_frames: Mean length of a run of lost frames.
        feedback: "never", or "auto": with feedback as long as reports come.
        feedback_memory_s: How long after the last report another is expected, while frames are sent.
        max_defer_s: How long without a report before a few more symbols are sent, should all before be lost.
        image_airtime_share: Share of frames that pictures get however many messages wait.
        aging_s: A message becomes one level more urgent for each such time that it waits.
        message_missed: With what probability a message may be lost: it is sent as often as the loss demands.
        max_messages: Most that wait.
        frames_per_image: See `SenderConfig`.
        stream_bytes: See `SenderConfig`.
        group_delay_s: How long a picture, once announced, waits for others to be coded with.
        kept_pictures: See `SenderConfig`.

    Raises:
        ConfigError: A value out of range.
    """

    rates: tuple[int, ...] = (1,)
    first_rate: int = 1
    expected_loss: float = 0.2
    burst_frames: float = 1.0
    feedback: str = "auto"
    feedback_memory_s: float = 900.0
    max_defer_s: float = 120.0
    image_airtime_share: float = 0.25
    aging_s: float = 600.0
    message_missed: float = 0.01
    max_messages: int = 2000
    frames_per_image: float = 6.0
    stream_bytes: int = 512
    group_delay_s: float = 0.0
    kept_pictures: int = 256

    def __post_init__(self) -> None:
        for name, low, high in (
            ("expected_loss", 0.0, 0.95),
            ("burst_frames", 1.0, 1000.0),
            ("feedback_memory_s", 0.001, 86400.0),
            ("image_airtime_share", 0.0, 1.0),
            ("aging_s", 0.001, 86400.0),
            ("message_missed", 1e-6, 0.5),
            ("max_messages", 1, 100_000),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError("acoustic queue", name, value, f"{low}..{high}")
        if self.feedback not in ("auto", "never"):
            raise ConfigError("acoustic queue", "feedback", self.feedback, "auto, never")


@dataclass(frozen=True, slots=True)
class ImageName:
    """Which picture of the vehicle has a number on the link."""

    image_id: str
    contact_id: str


@dataclass(frozen=True, slots=True)
class ExpectedDelivery:
    """When a picture is expected to have gone.

    Attributes:
        name: The picture.
        bytes_left: Of frames still to be sent for it.
        preview_at: When its record and coarse picture have gone, None where they have.
        done_at: When all that is planned has.
    """

    name: ImageName
    bytes_left: int
    preview_at: float | None
    done_at: float


class TransmitQueue:
    """The queue of one vehicle.

    Args:
        config: How it behaves.
        first_block: See `LinkSender`.
        seal: See `LinkSender`.

    Raises:
        ConfigError: A rate that there is not.
    """

    def __init__(self, config: QueueConfig, *, first_block: int = 0, seal: FrameProtection | None = None) -> None:
        self.config = config
        self.rate_choice = RateSelector(config.rates, config.first_rate)
        self.sender = LinkSender(
            SenderConfig(
                frame_bytes=RATES[config.first_rate].frame_bytes,
                channels=(LossChannel(config.expected_loss, config.burst_frames),),
                frames_per_image=config.frames_per_image,
                stream_bytes=config.stream_bytes,
                group_delay_s=config.group_delay_s,
                max_defer_s=config.max_defer_s,
                kept_pictures=config.kept_pictures,
                announce=True,
            ),
            first_block=first_block,
            seal=seal,
        )
        self.messages = WaitingMessages()
        self.names: dict[int, ImageName] = {}
        self.packet_interval_s = RATES[config.first_rate].airtime_s
        self.last_report_at: float | None = None
        self.picture_credit = 0.0
        self.frames_at_report = 0

    @property
    def rate(self) -> int:
        """Number of the rate in use."""
        return self.rate_choice.current

    @property
    def loss(self) -> float | None:
        """Share of frames lost, as reports tell."""
        return self.sender.measured_loss

    @property
    def has_room(self) -> bool:
        """Whether another message may be taken."""
        return len(self.messages.waiting) < self.config.max_messages

    @property
    def is_idle(self) -> bool:
        """Whether there is nothing to send and nothing that a report may ask for."""
        return self.sender.is_idle and not self.messages.waiting

    def add_picture(
        self,
        number: int,
        name: ImageName,
        contact: ContactSummary,
        stream: bytes,
        now: float,
        mean_square_error: Sequence[float] | None = None,
    ) -> bool:
        """Take a picture; False where nothing is to be done.

        A picture that is known is sent again from its beginning, unless it still waits. Where its stream has become
        longer and begins with what was sent, only what is new is sent; where it does not, nothing.

        Args:
            number: See `Sender.add_picture`.
            name: Which picture it is.
            contact: Its record.
            stream: The codec's stream.
            now: UTC in seconds.
            mean_square_error: See `Sender.add_picture`.

        Raises:
            FrameError: The number is out of range, or another picture that waits has it.
            StreamError: See `Sender.add_picture`.
        """
        known = self.sender.kept.get(number)
        if known is not None and known.contact == contact.rounded():
            if len(stream) > len(known.stream) and known.sent:
                # Receivers keep what they have: what does not continue it would show a wrong picture.
                continues = stream[: known.sent] == known.stream[: known.sent]
                return continues and self._extend(known, stream, now, mean_square_error)
            if stream == known.stream and self._is_open(number):
                return False
        self.sender.add_picture(number, contact, stream, now, mean_square_error)
        self.names[number] = name
        for forgotten in [n for n in self.names if n not in self.sender.kept]:
            del self.names[forgotten]
        return True

    def _extend(
        self, picture: OutgoingImage, stream: bytes, now: float, mean_square_error: Sequence[float] | None
    ) -> bool:
        picture.curve = quality_curve(len(stream), mean_square_error)
        picture.stream = stream
        return self.sender.refine(FeedbackRequest(picture.number, min(len(stream), MAX_STREAM_BYTES)), now)

    def refine(self, number: int, stream_bytes: int, now: float) -> bool:
        """Send more of a picture, up to a length of its stream (0: all of it); False where no more of it is here.

        Raises:
            FrameError: A value out of range.
        """
        known = self.sender.kept.get(number)
        if known is None:
            return False
        wanted = stream_bytes or min(len(known.stream), MAX_STREAM_BYTES)
        if not known.sent < wanted <= len(known.stream):
            return False
        return self.sender.refine(FeedbackRequest(number, wanted), now)

    def _is_open(self, number: int) -> bool:
        return number in self.open_numbers()

    def add_message(
        self, message_id: str, source: str, data: bytes, now: float, *, priority: int = 4, lifetime_s: float = 3600.0
    ) -> bool:
        """Take a message; False where it is known, or has expired already.

        Args:
            message_id: The program's name for it.
            source: The program.
            data: 1..1025 bytes.
            now: UTC in seconds.
            priority: 1 first to 7 last.
            lifetime_s: How long from `now` on it is worth sending.
        """
        if lifetime_s <= 0:
            self.messages.expired += 1
            return False
        return self.messages.add(message_id, source, priority, data, added_at=now, expires_at=now + lifetime_s)

    def on_report(self, report: Feedback | FeedbackRequest, now: float, receiver: int) -> None:
        """Take a receiver's report or request.

        Raises:
            FrameError: A request for a picture that is not remembered.
        """
        if isinstance(report, FeedbackRequest):
            self.sender.refine(report, now)
            return
        self._reported(now)
        self.sender.on_feedback(report, now, receiver)
        loss = self.loss
        if loss is not None:
            self.rate_choice.measured(loss, now)
            self._plan_for(loss)

    def on_mini(self, block: int, needed: int, now: float, receiver: int) -> None:
        """Take the least form of a report, from a mini-packet."""
        self._reported(now)
        self.sender.on_mini(block, needed, now, receiver)

    def _reported(self, now: float) -> None:
        self.last_report_at = now
        self.frames_at_report = self.sender.frames_sent
        if self.config.feedback == "auto":
            self.sender.expect_feedback(expected=True)

    def _plan_for(self, loss: float) -> None:
        planned = self.sender.config.worst.loss
        if abs(planned - loss) >= _LEAST_CHANGE:
            self.sender.plan_for((LossChannel(min(loss, 0.95), self.config.burst_frames),))

    def next_packet(self, now: float, most_frames: int | None = None) -> tuple[bytes, ...]:
        """Return the frames of the next packet at `rate`, none when there is nothing to send.

        Args:
            now: UTC in seconds.
            most_frames: Fewer than the rate has, where whoever polls wants no more.
        """
        self._keep_up(now)
        rate = RATES[self.rate]
        frames: list[bytes] = []
        while len(frames) < min(rate.frames, most_frames or rate.frames):
            self._load_messages(now)
            frame = self._next_frame(now)
            if frame is None and not frames and self.sender.messages.waiting:
                # There is nothing to send between two copies of a message but time.
                self.sender.messages.release(self.sender.frames_sent)
                frame = self._next_frame(now)
            if frame is None:
                break
            frames.append(frame)
        return tuple(frames)

    def _next_frame(self, now: float) -> bytes | None:
        pictures_wait = self.sender.pictures_are_due(now)
        due = pictures_wait and self.picture_credit >= 1.0
        frame = self.sender.next_frame(now, pictures_first=due)
        if frame is not None and pictures_wait:
            is_messages = frame[2] >> 5 & 3 == _SEGMENTS and not due
            self.picture_credit = (
                min(4.0, self.picture_credit + self.config.image_airtime_share) if is_messages else 0.0
            )
        return frame

    def _keep_up(self, now: float) -> None:
        """Act on the time: what has expired, reports that no longer come, another rate."""
        self.messages.prune(now)
        heard = self.last_report_at
        if not self.sender.blocks:
            self.frames_at_report = self.sender.frames_sent  # there is nothing to report of
        unheard = self.sender.frames_sent - self.frames_at_report
        late = heard is not None and not 0 <= now - heard <= self.config.feedback_memory_s
        if late and unheard >= _SILENT_FRAMES:
            self.last_report_at = None
            self.sender.expect_feedback(expected=False)
            # Nothing gets through, or the way back is broken: the slowest rate reaches farthest.
            self.rate_choice.measured(1.0, now)
        before = self.rate
        if self.rate_choice.choose(now) != before:
            self.sender.book.meters.clear()
            self.sender.resize(RATES[self.rate].frame_bytes)

    def _load_messages(self, now: float) -> None:
        """Give the sender the next messages; the rest waits here, where it can be overtaken."""
        room = _FRAMES_LOADED * self.sender.symbol_bytes
        loaded = sum(len(m.data) for m in self.sender.messages.waiting)
        worst, missed = self.sender.config.worst, self.config.message_missed
        while loaded < room and (chosen := self.messages.next(now, self.config.aging_s)) is not None:
            level = chosen.level(now, self.config.aging_s)
            self.messages.take(chosen)
            priority = -level if level >= FILLS_FROM else FILLS_FROM - level
            self.sender.add_message(
                chosen.data,
                now,
                priority=priority,
                lifetime_s=chosen.expires_at - now,
                times=copies(worst, missed / 10 if chosen.priority <= _URGENT else missed),
                rises_at=chosen.added_at + (chosen.priority - FILLS_FROM + 1) * self.config.aging_s,
            )
            loaded += len(chosen.data)

    def sent(self, interval_s: float) -> None:
        """Note how long one packet took from the one before, or from its beginning after a silence."""
        self.packet_interval_s += _SMOOTHING * (interval_s - self.packet_interval_s)

    def open_numbers(self) -> set[int]:
        """Return the numbers of pictures of which something is still to be sent."""
        waiting = {picture.number for picture in self.sender.waiting}
        return waiting | {n for block in self.sender.blocks if block.lacks > 0 for n in block.contacts}

    def expected(self, now: float) -> list[ExpectedDelivery]:
        """Return when each picture is expected to have gone, the first to be finished first.

        Detail of the blocks under way is sent in turns, so all of it is finished at about the same time; groups follow
        one another. Messages that come meanwhile are not foreseen.
        """
        frame_s = self.packet_interval_s / RATES[self.rate].frames
        frames_of = dict.fromkeys(self.open_numbers(), 0.0)
        previews: dict[int, float] = {}
        ahead = len(self.sender.messages.waiting) / 2
        fresh = [b for b in self.sender.blocks if b.is_fresh_preview and b.lacks > 0]
        for block in fresh:
            ahead += block.source_symbols - block.sent
            previews.update(dict.fromkeys(block.contacts, now + ahead * frame_s))
        for picture in self.sender.waiting:
            if picture.number not in self.sender.announced:
                ahead += 1
            previews[picture.number] = now + ahead * frame_s
        open_blocks = [b for b in self.sender.blocks if b.lacks > 0]
        for block in open_blocks:
            for number in block.contacts:
                frames_of[number] += block.lacks / len(block.contacts)
        done = {n: now + (ahead + sum(b.lacks for b in open_blocks)) * frame_s for n in frames_of}
        total = ahead + sum(b.lacks for b in open_blocks)
        for picture in self.sender.waiting:
            frames_of[picture.number] = self._planned_frames(len(picture.stream))
            total += frames_of[picture.number]
            done[picture.number] = now + total * frame_s
        found = [
            ExpectedDelivery(
                self.names.get(n, ImageName("0000", "?")),
                round(frames_of[n] * self.sender.config.frame_bytes),
                None if n in self.sender.announced else previews.get(n),
                done[n],
            )
            for n in frames_of
        ]
        return sorted(found, key=lambda e: (e.done_at, e.name.image_id))

    def _planned_frames(self, stream_bytes: int) -> float:
        config = self.sender.config
        if not config.feedback:
            return config.frames_per_image
        wanted = min(stream_bytes, config.stream_bytes) + 32
        return wanted / self.sender.symbol_bytes / (1 - min(config.worst.loss, 0.9))
