"""Configuration of the link: sender and receiver of `v1`, and the transmit queue."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

from sonarpost.errors import ConfigError
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.frames.v1.frame import MAX_FRAME_BYTES, MIN_FRAME_BYTES
from sonarpost.link.frames.v1.payload_objects import WINDOW
from sonarpost.link.state import Bounds, check_bounds
from sonarpost.modem.interface import RateInfo

_LINK: Final = "acoustic link v1"
_QUEUE: Final = "acoustic queue"
_GROUP_FRAMES: Final = 144
_MAX_GROUP: Final = 60
_FEEDBACK_GROUP: Final = 24
_LOSS_ERROR: Final = 0.15
"""Relative error of a measured loss. Planning for it costs less than 0.01 dB if the measurement is right."""


@dataclass(frozen=True, slots=True)
class SenderConfig:
    """Configuration of the sender of `v1`.

    Attributes:
        frame_bytes: Length of a frame, 32..256.
        channels: Measured channel to each receiver; all receivers are equally important.
        feedback: Whether receivers send feedback. Without it each block is sent once, with layers.
        frames_per_image: Average number of frames for an image, previews included; only without feedback.
        stream_bytes: Bytes of a stream that are planned at first; only with feedback.
        group_images: Maximum number of images in a group; 0 for as many as fill about 144 frames (`group_size`).
        depth: Groups that are sent at a time; their frames are interleaved against bursts.
        group_delay_s: Maximum time that an image waits for others of its group.
        max_defer_s: With feedback, time without one after which a few more symbols are sent.
        kept_images: Images to keep after they were sent, to refine them on request.
        announce: Whether contacts whose group waits are sent once before the detail of others.

    Raises:
        ConfigError: A value out of range.
    """

    frame_bytes: Annotated[int, Bounds(MIN_FRAME_BYTES, MAX_FRAME_BYTES)] = 64
    channels: tuple[LossChannel, ...] = (LossChannel(0.3),)
    feedback: bool = False
    frames_per_image: Annotated[float, Bounds(1, 255)] = 6.0
    stream_bytes: Annotated[int, Bounds(16, 65535)] = 512
    group_images: Annotated[int, Bounds(0, 120)] = 0
    depth: Annotated[int, Bounds(1, WINDOW // 4)] = 2
    group_delay_s: Annotated[float, Bounds(0, 86400)] = 0.0
    max_defer_s: Annotated[float, Bounds(0.001, 86400)] = 600.0
    kept_images: Annotated[int, Bounds(1, 65535)] = 256
    announce: bool = False

    def __post_init__(self) -> None:
        check_bounds(self, _LINK, ConfigError)
        if not 1 <= len(self.channels) <= 64:
            raise ConfigError(_LINK, "channels", len(self.channels), "1..64")

    @property
    def planned_channels(self) -> tuple[LossChannel, ...]:
        """The channels that detail is planned for."""
        factors = (1 - _LOSS_ERROR, 1.0, 1 + _LOSS_ERROR)
        return tuple(LossChannel(min(c.loss * f, 0.99), c.burst) for c in self.channels for f in factors)

    @property
    def group_size(self) -> int:
        """Maximum number of images in a group.

        A large group averages out the random number of frames that arrive of each image; a small one waits less.
        """
        if self.group_images:
            return self.group_images
        if self.feedback:
            return _FEEDBACK_GROUP
        return min(_MAX_GROUP, max(1, round(_GROUP_FRAMES / self.frames_per_image)))

    @property
    def worst(self) -> LossChannel:
        """The channel with the greatest loss."""
        return max(self.channels, key=lambda c: (c.loss, c.burst))


@dataclass(frozen=True, slots=True)
class ReceiverConfig:
    """Configuration of the receiver of `v1`: bounds of its memory, and when feedback is due.

    Attributes:
        max_sources: Vehicles to keep; the one whose last frame is oldest is deleted first.
        max_contacts: Contacts to keep of each vehicle.
        block_memory_s: Time after its last symbol at which a block is deleted.
        contact_memory_s: Time after its last frame at which a contact is deleted.
        feedback_interval_frames: While something is missing, feedback is due this many frames after the last one.
        feedback_interval_s: While something is missing, feedback is also due this long after the last one.

    Raises:
        ConfigError: A value out of range.
    """

    max_sources: Annotated[int, Bounds(1, 128)] = 16
    max_contacts: Annotated[int, Bounds(1, 65535)] = 512
    block_memory_s: Annotated[float, Bounds(0.001, 1e9)] = 3600.0
    contact_memory_s: Annotated[float, Bounds(0.001, 1e9)] = 6 * 3600.0
    feedback_interval_frames: Annotated[int, Bounds(1, 65535)] = 48
    feedback_interval_s: Annotated[float, Bounds(0.001, 1e9)] = 60.0

    def __post_init__(self) -> None:
        check_bounds(self, _LINK, ConfigError)


@dataclass(frozen=True, slots=True)
class QueueConfig:
    """Configuration of the transmit queue.

    Attributes:
        rates: The allowed rates; the measured loss determines which one is used.
        first_rate: Number of the rate at the start.
        expected_loss: Share of frames lost until it is measured.
        burst_frames: Mean number of frames lost in a row.
        feedback: "never", or "auto": with feedback as long as it arrives.
        feedback_memory_s: How long after the last feedback another one is expected, while frames are sent.
        max_defer_s: Time without feedback after which a few more symbols are sent, in case all were lost.
        image_airtime_share: Share of frames for images, however many messages wait.
        aging_s: Waiting time that makes a message one level more urgent.
        max_messages: Maximum number of waiting messages.
        frames_per_image: See `SenderConfig`.
        stream_bytes: See `SenderConfig`.
        group_delay_s: Maximum time that an announced image waits for others of its group.
        kept_images: See `SenderConfig`.

    Raises:
        ConfigError: A value out of range.
    """

    rates: tuple[RateInfo, ...]
    first_rate: int
    expected_loss: Annotated[float, Bounds(0.0, 0.95)] = 0.2
    burst_frames: Annotated[float, Bounds(1.0, 1000.0)] = 1.0
    feedback: str = "auto"
    feedback_memory_s: Annotated[float, Bounds(0.001, 86400.0)] = 900.0
    max_defer_s: float = 120.0
    image_airtime_share: Annotated[float, Bounds(0.0, 1.0)] = 0.25
    aging_s: Annotated[float, Bounds(0.001, 86400.0)] = 600.0
    max_messages: Annotated[int, Bounds(1, 100_000)] = 2000
    frames_per_image: float = 6.0
    stream_bytes: int = 512
    group_delay_s: float = 0.0
    kept_images: int = 256

    def __post_init__(self) -> None:
        check_bounds(self, _QUEUE, ConfigError)
        if self.first_rate not in self.rate_numbers:
            raise ConfigError(_QUEUE, "first_rate", self.first_rate, f"one of {sorted(self.rate_numbers)}")
        for rate in self.rates:
            if not MIN_FRAME_BYTES <= rate.frame_bytes <= MAX_FRAME_BYTES:
                expected = f"frames of {MIN_FRAME_BYTES}..{MAX_FRAME_BYTES} bytes"
                raise ConfigError(_QUEUE, f"rate {rate.number}", rate.frame_bytes, expected)
        if self.feedback not in ("auto", "never"):
            raise ConfigError(_QUEUE, "feedback", self.feedback, "auto, never")

    @property
    def rate_numbers(self) -> frozenset[int]:
        """Numbers of the allowed rates."""
        return frozenset(rate.number for rate in self.rates)

    def rate(self, number: int) -> RateInfo:
        """Return the allowed rate with a number; the first rate if it is not allowed (any more)."""
        by_number = {rate.number: rate for rate in self.rates}
        return by_number.get(number, by_number[self.first_rate])
