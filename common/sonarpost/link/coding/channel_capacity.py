"""How many frames of a block arrive, and what no scheme can do better than.

Losses are those of a two-state chain (Gilbert, "Capacity of a burst-noise channel", Bell System Technical Journal 39,
1960): a frame is lost or not, and what happened to the one before says how likely. `burst` is the mean number of frames
lost in a row; at 1 / (1 - loss) or below, losses are independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarpost.errors import ConfigError

Values = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LossChannel:
    """What a frame meets.

    Attributes:
        loss: Share of frames lost, 0..0.99.
        burst: Mean number of frames lost in a row, 1 or more; independent losses where it is below 1 / (1 - loss).

    Raises:
        ConfigError: A value out of range.
    """

    loss: float
    burst: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.loss <= 0.99:
            raise ConfigError("acoustic channel", "loss", self.loss, "0..0.99")
        if not 1.0 <= self.burst <= 1e6:
            raise ConfigError("acoustic channel", "burst", self.burst, "1..1000000 frames")

    @property
    def memory(self) -> float:
        """Correlation of the fates of two successive frames, 0..1."""
        return max(0.0, 1.0 - 1.0 / (self.burst * (1.0 - self.loss)))

    def spread(self, depth: int) -> LossChannel:
        """Return what frames see that are sent `depth` frames apart."""
        memory = self.memory**depth
        return (
            LossChannel(self.loss, max(1.0, 1.0 / ((1.0 - self.loss) * (1.0 - memory)))) if memory > 0 else self.plain
        )

    @property
    def plain(self) -> LossChannel:
        """The same share of losses, independent of each other."""
        return LossChannel(self.loss)


def received_distribution(frames: int, channel: LossChannel) -> Values:
    """Return shape (frames + 1,): the probability that 0, 1, ... of successive frames arrive."""
    loss, memory = channel.loss, channel.memory
    stay_lost, become_lost = loss + (1 - loss) * memory, loss - loss * memory
    lost, good = np.zeros(frames + 2), np.zeros(frames + 2)
    lost[0], good[1] = loss, 1 - loss  # after the first frame
    if frames == 0:
        return np.ones(1)
    for _ in range(frames - 1):
        next_lost = lost * stay_lost + good * become_lost
        arriving = lost * (1 - stay_lost) + good * (1 - become_lost)
        lost, good = next_lost, np.concatenate([[0.0], arriving[:-1]])
    return (lost + good)[: frames + 1]


def erasure_bound_frames(payload_bytes: float, frame_bytes: int, loss: float) -> float:
    """Return how many frames any scheme must send on average: the payload over what gets through of a frame.

    The capacity of an erasure channel (Elias, "Coding for two noisy channels", 1955) is 1 - loss; headers, checksums
    and feedback are not in it.
    """
    return payload_bytes / (frame_bytes * (1.0 - loss))


def unseen_share(source_frames: int, sent_frames: int, channel: LossChannel) -> float:
    """Return the share of source symbols that stay unknown when `sent_frames` of a systematic block are sent.

    With fewer than k received symbols those of the source that came are known all the same: given r received of n, each
    was received with probability r / n.
    """
    arrived = received_distribution(sent_frames, channel)
    counts = np.arange(sent_frames + 1)
    short = counts < source_frames
    return float((arrived * short * (1 - counts / max(sent_frames, 1))).sum())


def frames_for(source_frames: int, channel: LossChannel, unseen: float, limit: int) -> int:
    """Return the fewest frames of a systematic block with which at most `unseen` of the source stay unknown.

    At most `limit`, whatever that gives.
    """
    low, high = source_frames, max(limit, source_frames)
    while low < high:
        middle = (low + high) // 2
        if unseen_share(source_frames, middle, channel) <= unseen:
            high = middle
        else:
            low = middle + 1
    return low


def goodput_bps(frame_bytes: int, frames: int, airtime_s: float, loss: float, header_bytes: int) -> float:
    """Return payload bits a second that an ideal erasure code gets through."""
    return 8 * frames * (frame_bytes - header_bytes) * (1 - loss) / airtime_s
