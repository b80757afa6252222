"""How the v1 sender and receiver behave."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sonarpost.errors import ConfigError
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.frames.v1.feedback import WINDOW
from sonarpost.link.frames.v1.frame import MAX_FRAME_BYTES, MIN_FRAME_BYTES

_WHERE = "acoustic link v1"
_GROUP_FRAMES = 144
_MOST_GROUP = 60
_FEEDBACK_GROUP = 24


@dataclass(frozen=True, slots=True)
class SenderConfig:
    """How the sender behaves.

    Attributes:
        frame_bytes: Bytes in a frame, 32..256.
        channels: What frames meet, as measured: one for each receiver, equally important.
        uncertainty: How far off a measured loss may be, as a share of it: detail is planned for losses that much
            smaller and greater too. 0.15 costs less than 0.01 dB where the measure is right.
        feedback: Whether a receiver reports what it lacks. Without, each block is sent once, with layers.
        frames_per_image: Frames a picture may cost on average, previews included; of use without feedback.
        stream_bytes: Most bytes of a stream that are planned at first; of use with feedback.
        group_pictures: Most pictures in a group; 0 for so many that a group has about 144 frames (`group_size`).
        depth: Groups under way at a time: their frames are interleaved, against bursts.
        group_delay_s: How long a picture waits for others to make a group with.
        max_defer_s: With feedback, how long without a report before a few more symbols are sent.
        receiver_memory_s: How long after its last report a receiver counts.
        block_symbols: With feedback, most source symbols of a block.
        caution: See `v1_plan.symbols_to_send`.
        kept_pictures: Pictures kept after they were sent, to refine them when asked.
        announce: Whether contacts whose group has to wait are sent once, before the detail of others.

    Raises:
        ConfigError: A value out of range.
    """

    frame_bytes: int = 64
    channels: tuple[LossChannel, ...] = (LossChannel(0.3),)
    uncertainty: float = 0.15
    feedback: bool = False
    frames_per_image: float = 6.0
    stream_bytes: int = 512
    group_pictures: int = 0
    depth: int = 2
    group_delay_s: float = 0.0
    max_defer_s: float = 600.0
    receiver_memory_s: float = 3600.0
    block_symbols: int = 96
    caution: float = 1.5
    kept_pictures: int = 256
    announce: bool = False

    def __post_init__(self) -> None:
        _check("frame_bytes", self.frame_bytes, MIN_FRAME_BYTES, MAX_FRAME_BYTES)
        _check("channels", len(self.channels), 1, 64)
        _check("uncertainty", self.uncertainty, 0, 0.9)
        _check("frames_per_image", self.frames_per_image, 1, 255)
        _check("stream_bytes", self.stream_bytes, 16, 65535)
        _check("group_pictures", self.group_pictures, 0, 120)
        _check("depth", self.depth, 1, WINDOW // 4)
        _check("group_delay_s", self.group_delay_s, 0, 86400)
        _check("max_defer_s", self.max_defer_s, 0.001, 86400)
        _check("receiver_memory_s", self.receiver_memory_s, 0.001, 1e9)
        _check("block_symbols", self.block_symbols, 1, 200)
        _check("caution", self.caution, 0, 10)
        _check("kept_pictures", self.kept_pictures, 1, 65535)

    @property
    def planned_channels(self) -> tuple[LossChannel, ...]:
        """The channels that detail is planned for."""
        factors = (1 - self.uncertainty, 1.0, 1 + self.uncertainty) if self.uncertainty else (1.0,)
        return tuple(LossChannel(min(c.loss * f, 0.99), c.burst) for c in self.channels for f in factors)

    @property
    def group_size(self) -> int:
        """Most pictures in a group: enough frames for luck to even out, few enough to wait for."""
        if self.group_pictures:
            return self.group_pictures
        return (
            _FEEDBACK_GROUP if self.feedback else min(_MOST_GROUP, max(1, round(_GROUP_FRAMES / self.frames_per_image)))
        )

    @property
    def worst(self) -> LossChannel:
        """The worst receiver's."""
        return max(self.channels, key=lambda c: (c.loss, c.burst))


@dataclass(frozen=True, slots=True)
class ReceiverConfig:
    """Bounds of the receiver's memory, and when it reports.

    Attributes:
        max_sources: Vehicles remembered; the least recently heard is forgotten first.
        max_contacts: Contacts remembered of each.
        block_memory_s: A block is forgotten after this long without a symbol of it.
        contact_memory_s: A contact, after this long without news of it.
        feedback_interval_frames: A report is due after so many frames ...
        feedback_interval_s: ... or this long without one, while something is lacking.
        presence_s: While frames come, a report goes after this long even where nothing is lacking.

    Raises:
        ConfigError: A value out of range.
    """

    max_sources: int = 16
    max_contacts: int = 512
    block_memory_s: float = 3600.0
    contact_memory_s: float = 6 * 3600.0
    feedback_interval_frames: int = 48
    feedback_interval_s: float = 60.0
    presence_s: float = 600.0

    def __post_init__(self) -> None:
        _check("max_sources", self.max_sources, 1, 128)
        _check("max_contacts", self.max_contacts, 1, 65535)
        for name in ("block_memory_s", "contact_memory_s", "feedback_interval_s", "presence_s"):
            _check(name, getattr(self, name), 0.001, 1e9)
        _check("feedback_interval_frames", self.feedback_interval_frames, 1, 65535)


def _check(name: str, value: float, low: float, high: float) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise ConfigError(_WHERE, name, value, f"{low}..{high}")
