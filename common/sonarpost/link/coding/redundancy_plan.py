"""Redundancy plan: the gain of the bytes of images, the layers of a group of images, and the number of symbols.

Inputs are the measured loss and the quality of images by the number of bytes. Nothing here is part of the wire format:
receivers decode the frames of any plan.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations, pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.errors import StreamError
from sonarpost.link.coding.channel_capacity import LossChannel, Values, received_distribution
from sonarpost.link.coding.erasure_code import DESCRIPTOR_SYMBOLS, MAX_LAYERS, MAX_STEP, SHARES, Layering
from sonarpost.link.frames.v1.payload_objects import MAX_STREAM_BYTES

Counts = npt.NDArray[np.int64]

_STEPS: Final = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 26, 34, 44, 63)
_FIRST_TRIES: Final = 24
_MAX_COPIES: Final = 8
_SURE: Final = 0.999


def usual_curve(stream_bytes: int) -> Values:
    """Return the PSNR in dB by the number of bytes received, shape (stream_bytes + 1,).

    1.2 dB for every doubling is typical of codecs at these rates.

    Raises:
        StreamError: The stream is too long.
    """
    if stream_bytes > MAX_STREAM_BYTES:
        raise StreamError("image", "stream", f"{stream_bytes} bytes", f"at most {MAX_STREAM_BYTES}")
    return 13.0 + 1.2 * np.log2(1.0 + np.arange(stream_bytes + 1) / 4.0)


def _hull(curve: Values, start: int) -> tuple[list[int], list[float]]:
    """Return positions and values of the corners of the upper concave hull of `curve[start:]`."""
    # Only a rise of the curve can end in a corner.
    rises = np.flatnonzero(np.diff(curve[start:]) > 0) + start + 1
    places, values = [start], [float(curve[start])]
    for place in rises.tolist():
        value = float(curve[place])
        while len(places) > 1 and (values[-1] - values[-2]) * (place - places[-1]) <= (value - values[-1]) * (
            places[-1] - places[-2]
        ):
            places.pop()
            values.pop()
        places.append(place)
        values.append(value)
    return places, values


@dataclass(frozen=True, eq=False)
class GroupDistortion:
    """Gain of the bytes of a group of images, steepest first.

    The concave hull replaces the PSNR curve of each image, so that spending bytes at the steepest slope is optimal
    (Shoham and Gersho, "Efficient bit allocation for an arbitrary set of quantizers", IEEE Trans. ASSP 36, 1988).

    Attributes:
        starts: Shape (images,): bytes of each image that are sent elsewhere.
        owners: Shape (steps,): image of each step.
        step_bytes: Shape (steps,): bytes of each step.
        bytes_by_step: Shape (steps + 1,): bytes of the group after each step, 0 first.
        gain_by_step: Shape (steps + 1,): summed dB after each step, 0 first.
    """

    starts: Counts
    owners: Counts
    step_bytes: Counts
    bytes_by_step: Counts
    gain_by_step: Values

    @classmethod
    def of(cls, curves: Sequence[Values], starts: Sequence[int]) -> GroupDistortion:
        """Merge the hulls of images, each from its start on."""
        owners, sizes, gains = [], [], []
        for owner, (curve, start) in enumerate(zip(curves, starts, strict=True)):
            places, values = _hull(curve, min(start, len(curve) - 1))
            owners += [owner] * (len(places) - 1)
            sizes += [b - a for a, b in pairwise(places)]
            gains += [b - a for a, b in pairwise(values)]
        size, gain = np.array(sizes, np.int64), np.array(gains, np.float64)
        order = np.argsort(-gain / np.maximum(size, 1), kind="stable") if size.size else np.zeros(0, np.int64)
        return cls(
            np.array(starts, np.int64),
            np.array(owners, np.int64)[order],
            size[order],
            np.concatenate([[0], np.cumsum(size[order])]).astype(np.int64),
            np.concatenate([[0.0], np.cumsum(gain[order])]),
        )

    @property
    def total_bytes(self) -> int:
        """Number of bytes with a gain."""
        return int(self.bytes_by_step[-1])

    def gains(self, group_bytes: Counts) -> Values:
        """Return the summed dB for numbers of bytes, any shape."""
        return np.interp(group_bytes, self.bytes_by_step, self.gain_by_step)

    def stops(self, group_bytes: int) -> list[int]:
        """Return the end of the part of each stream if the group has `group_bytes` bytes."""
        step = int(np.searchsorted(self.bytes_by_step, group_bytes, side="right")) - 1
        more = np.bincount(self.owners[:step], self.step_bytes[:step], self.starts.size).astype(np.int64)
        if step < self.owners.size:
            more[self.owners[step]] += group_bytes - self.bytes_by_step[step]
        return [int(stop) for stop in self.starts + more]


@cache
def _compositions(layers: int) -> Counts:
    """Return all ways to write 16 as a sum of `layers` positive numbers, shape (ways, layers)."""
    cuts = list(combinations(range(1, SHARES), layers - 1))
    edges = np.array([(0, *cut, SHARES) for cut in cuts], np.int64)
    return np.diff(edges, axis=1)


def plan_layers(
    distortion: GroupDistortion, symbol_bytes: int, arrive: Values, first_overhead: int, next_overhead: int
) -> tuple[Layering, float] | None:
    """Return the layers with the greatest expected gain, and this gain; None if the frames are too few.

    Tries all divisions of a symbol into one to four layers in steps of a sixteenth, with the thresholds on a grid over
    the number of frames that may arrive. The expected gain, in dB over the previews and summed over the images, is the
    sum over layers of (gain(bytes up to l) - gain(bytes up to l - 1)) P(at least k_l frames arrive).

    Args:
        distortion: Of the group's images.
        symbol_bytes: Length of a symbol.
        arrive: Shape (frames + 1,), at most 255 frames: the probability that 0, 1, ... of them arrive. For several
            receivers or an uncertain loss, the mean of several `received_distribution`.
        first_overhead: Bytes of the lowest layer's object that are not image data.
        next_overhead: The same of every other layer.
    """
    frames = arrive.size - 1
    at_least = np.concatenate([np.cumsum(arrive[::-1])[::-1], np.zeros(1)])
    useful = np.flatnonzero(at_least[: frames + 1] > 1 - _SURE)
    low = max(DESCRIPTOR_SYMBOLS, int(np.searchsorted(-at_least[: frames + 1], -_SURE)) - 1)
    high = min(int(useful[-1]), frames)
    if low > high or symbol_bytes < SHARES:
        return None
    best: tuple[Layering, float] | None = None
    for first in sorted({int(n) for n in np.linspace(low, high, min(_FIRST_TRIES, high - low + 1))}):
        for layers in range(1, MAX_LAYERS + 1):
            for step in _STEPS if layers > 1 else (0,):
                if step > MAX_STEP or first + (layers - 1) * step > high:
                    break
                needs = first + step * np.arange(layers)
                value, place = _best_shares(
                    distortion, symbol_bytes, needs, at_least[needs], first_overhead, next_overhead
                )
                if best is None or value > best[1]:
                    shares = tuple(int(s) for s in _compositions(layers)[place])
                    best = Layering(first, step, shares), value
    return best


def plan_unlayered(
    distortion: GroupDistortion, symbol_bytes: int, arrive: Values, overhead: int
) -> tuple[int, float] | None:
    """Return k and the expected gain of a block without layers (for groups that are too small for layers), or None.

    Args:
        distortion: Of the group's images.
        symbol_bytes: Length of a symbol.
        arrive: See `plan_layers`.
        overhead: Bytes of the object that are not image data.
    """
    needs = np.arange(1, arrive.size)
    at_least = np.cumsum(arrive[::-1])[::-1][1:]
    room = needs * symbol_bytes - overhead
    expected = np.where(room > 0, distortion.gains(np.maximum(room, 0)) * at_least, 0.0)
    if not expected.size or expected.max() <= 0:
        return None
    best = int(np.argmax(expected))
    return int(needs[best]), float(expected[best])


def _best_shares(
    distortion: GroupDistortion,
    symbol_bytes: int,
    needs: Counts,
    reached: Values,
    first_overhead: int,
    next_overhead: int,
) -> tuple[float, int]:
    shares = _compositions(needs.size)
    edges = symbol_bytes * np.concatenate([np.zeros((len(shares), 1), np.int64), np.cumsum(shares, axis=1)], axis=1)
    overhead = np.where(np.arange(needs.size) == 0, first_overhead, next_overhead)
    room = np.diff(edges // SHARES, axis=1) * needs - overhead
    # A layer without room for its own overhead is impossible.
    values = distortion.gains(np.cumsum(np.maximum(room, 0), axis=1))
    steps = np.diff(values, axis=1, prepend=0.0)
    expected = np.where((room > 0).all(axis=1), steps @ reached, -1.0)
    place = int(np.argmax(expected))
    return float(expected[place]), place


def arrivals(frames: int, channels: Sequence[LossChannel], depth: int) -> Values:
    """Return the probability that 0, 1, ... of the frames of a block arrive, as the mean over all receivers.

    Args:
        frames: Frames to send.
        channels: Channel to each receiver.
        depth: Distance between the frames of a block, in frames.
    """
    distributions: list[Values] = [received_distribution(frames, channel.spread(depth)) for channel in channels]
    mean: Values = np.mean(distributions, axis=0)
    return mean


def copies(channel: LossChannel, missed: float = 0.01) -> int:
    """Return how many copies of a frame to send so that all are lost with a probability of at most `missed`."""
    if channel.loss <= missed:
        return 1
    return min(_MAX_COPIES, math.ceil(math.log(missed) / math.log(channel.loss)))


def symbols_to_send(missing_symbols: int, channel: LossChannel, caution: float | None = None) -> int:
    """Return how many symbols to send before the next feedback.

    For many symbols the number is below the average need: feedback requests the rest, and symbols beyond the need are
    wasted. Few symbols are sent as often as they are needed on average: a round of feedback takes longer.

    Args:
        missing_symbols: Symbols that are missing at the receiver.
        channel: The channel.
        caution: Standard deviations below the average; None for 1.5 from 24 symbols on, and less for fewer.
    """
    if missing_symbols <= 0:
        return 0
    if caution is None:
        caution = 1.5 * min(1.0, missing_symbols / 24)
    passed = 1.0 - channel.loss
    memory = channel.memory
    widening = (1 + memory) / (1 - memory)
    deviation = math.sqrt(missing_symbols * channel.loss * widening) / passed
    return max(missing_symbols, math.ceil(missing_symbols / passed - caution * deviation))
