"""How much of what to send: previews' redundancy, the layers of a group's pictures, the modem's rate.

All from the measured loss, the codec's estimates and the time that frames take. Nothing here is in the format: any
sender may plan otherwise and every receiver will understand it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.link.coding.channel_capacity import LossChannel, Values, frames_for, received_distribution
from sonarpost.link.coding.rate_distortion import GroupDistortion
from sonarpost.link.frames.v1.layers import DESCRIPTOR_SYMBOLS, MAX_LAYERS, MAX_STEP, SHARES, Layering

PREVIEWS_UNSEEN: Final = 0.004
"""Share of previews that may stay unseen at the loss that is planned for."""
_STEPS: Final = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 26, 34, 44, 63)
_FIRST_TRIES: Final = 24
_SURE: Final = 0.999


@dataclass(frozen=True, slots=True)
class LayerPlan:
    """Layers and what they are expected to be worth.

    Attributes:
        layering: Of the block.
        expected_db: Expected gain of the group over its previews, summed over its pictures.
    """

    layering: Layering
    expected_db: float


@cache
def _compositions(layers: int) -> npt.NDArray[np.int64]:
    """Return every way to write 16 as a sum of `layers` positive numbers, shape (ways, layers)."""
    cuts = list(combinations(range(1, SHARES), layers - 1))
    edges = np.array([(0, *cut, SHARES) for cut in cuts], np.int64)
    return np.diff(edges, axis=1)


def plan_layers(
    distortion: GroupDistortion, symbol_bytes: int, arrive: Values, first_overhead: int, next_overhead: int
) -> LayerPlan | None:
    """Return the layers with the greatest expected gain, None where the frames are too few for any.

    Tries every division of a symbol in sixteenths into one to four layers, with the thresholds on a grid over the
    frames that may arrive: all the format can say but for the grid. Of `expected = sum over layers of
    (gain(bytes up to l) - gain(bytes up to l - 1)) P(at least k_l frames arrive)` the greatest wins.

    Args:
        distortion: Of the group's images.
        symbol_bytes: Of a symbol.
        arrive: Shape (frames + 1,), at most 255 frames: the probability that 0, 1, ... of them arrive. For several
            receivers, or a loss that is not well known, the mean of several `received_distribution`.
        first_overhead: Bytes of the lowest layer's object that are not picture.
        next_overhead: Of every other layer's.
    """
    frames = arrive.size - 1
    at_least = np.concatenate([np.cumsum(arrive[::-1])[::-1], np.zeros(1)])
    useful = np.flatnonzero(at_least[: frames + 1] > 1 - _SURE)
    low = max(DESCRIPTOR_SYMBOLS, int(np.searchsorted(-at_least[: frames + 1], -_SURE)) - 1)
    high = min(int(useful[-1]), frames)
    if low > high or symbol_bytes < SHARES:
        return None
    best: tuple[float, Layering] | None = None
    for first in sorted({int(n) for n in np.linspace(low, high, min(_FIRST_TRIES, high - low + 1))}):
        for layers in range(1, MAX_LAYERS + 1):
            for step in _STEPS if layers > 1 else (0,):
                if step > MAX_STEP or first + (layers - 1) * step > high:
                    break
                needs = first + step * np.arange(layers)
                value, place = _best_shares(
                    distortion, symbol_bytes, needs, at_least[needs], first_overhead, next_overhead
                )
                if best is None or value > best[0]:
                    shares = tuple(int(s) for s in _compositions(layers)[place])
                    best = value, Layering(first, step, shares)
    return None if best is None else LayerPlan(best[1], best[0])


def plan_whole(
    distortion: GroupDistortion, symbol_bytes: int, arrive: Values, overhead: int
) -> tuple[int, float] | None:
    """Return k and the expected gain of a block without layers (for groups too small for any), or None.

    Args:
        distortion: Of the group's images.
        symbol_bytes: Of a symbol.
        arrive: See `plan_layers`.
        overhead: Bytes of the object that are not picture.
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
    needs: npt.NDArray[np.int64],
    reached: Values,
    first_overhead: int,
    next_overhead: int,
) -> tuple[float, int]:
    shares = _compositions(needs.size)
    edges = symbol_bytes * np.concatenate([np.zeros((len(shares), 1), np.int64), np.cumsum(shares, axis=1)], axis=1)
    overhead = np.where(np.arange(needs.size) == 0, first_overhead, next_overhead)
    room = np.diff(edges // SHARES, axis=1) * needs - overhead
    # A layer without room for its own head cannot be made.
    values = distortion.gains(np.cumsum(np.maximum(room, 0), axis=1))
    steps = np.diff(values, axis=1, prepend=0.0)
    expected = np.where((room > 0).all(axis=1), steps @ reached, -1.0)
    place = int(np.argmax(expected))
    return float(expected[place]), place


def arrivals(frames: int, channels: Sequence[LossChannel], depth: int) -> Values:
    """Return the probability that 0, 1, ... of a block's frames arrive, over receivers that are equally important.

    Args:
        frames: That are sent.
        channels: What each receiver's frames meet.
        depth: How far apart the block's frames are sent.
    """
    met: list[Values] = [received_distribution(frames, channel.spread(depth)) for channel in channels]
    mean: Values = np.mean(met, axis=0)
    return mean


def preview_frames(source_symbols: int, channel: LossChannel, unseen: float = PREVIEWS_UNSEEN, limit: int = 255) -> int:
    """Return how many frames of a preview block to send for at most `unseen` of its contacts to stay unseen.

    At most `limit`, but every source symbol once.
    """
    return frames_for(source_symbols, channel, unseen, limit=min(255, limit))


def copies(channel: LossChannel, missed: float = 0.01, most: int = 8) -> int:
    """Return how often to send what must arrive and fits one frame: missed at most with the given probability."""
    if channel.loss <= missed:
        return 1
    return min(most, math.ceil(math.log(missed) / math.log(channel.loss)))


def symbols_to_send(needed: int, channel: LossChannel, caution: float) -> int:
    """Return how many symbols to send before the next report when `needed` are lacking.

    Fewer than would arrive on average: what still lacks is asked for again, what arrives beyond the need is wasted.

    Args:
        needed: Symbols that the receiver lacks.
        channel: What they meet.
        caution: Standard deviations by which to stay below the average, 0 or more.
    """
    if needed <= 0:
        return 0
    passed = 1.0 - channel.loss
    memory = channel.memory
    widening = (1 + memory) / (1 - memory)
    deviation = math.sqrt(needed * channel.loss * widening) / passed
    return max(needed, math.ceil(needed / passed - caution * deviation))
