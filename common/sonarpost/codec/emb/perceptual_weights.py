"""What a model aims at when that is not the least squared error: likeness of structure (`emb-structure`).

Structural similarity divides an error by the contrast around it, and two and four times reduced pictures decide it.
So a model with an aim codes every coefficient as if it were larger or smaller: by its level, and at the levels that
carry objects by the contrast around it, as far as both ends know it from what was coded before. Integers throughout.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import transform
from sonarpost.codec.emb._jit import jit
from sonarpost.codec.emb.coder import PLAIN_SCALE, State
from sonarpost.codec.emb.layout import HEIGHT, LEVEL, LL, OFFSET, ORIENT, STRIDE, WIDTH, Layout, cells_of

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]

LEVELS: Final = 7
"""Scales of the lowest band and of levels 1 to 6."""
CONTRASTS: Final = 128
"""Places of the table of contrast: eighths of octaves."""
FOLLOWING: Final = (3, 2)
"""Levels whose scale follows the contrast; coarser ones hardly profit, of the finest little is coded."""
STILL_GREY2: Final = 150
"""Added to the local variance: a seabed without any contrast is not worth everything."""
# Radius and rounds of the box that the variance is taken in, by level less the level of the picture it is taken of:
# standard deviation of 4 to 5 px at levels 2 and 3.
_WINDOWS: Final = ((1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, eq=False)
class PerceptualWeights:
    """How a model scales coefficients before it codes them, in 1/256.

    Attributes:
        levels: Shape (LEVELS,), int32: scale of the lowest band, then of the other bands of level 1 to 6.
        contrast: Shape (CONTRASTS,), int32: scale by 8 log2 of the local variance in grey squared and `STILL_GREY2`.
    """

    levels: I32
    contrast: I32


@lru_cache(maxsize=8)
def _first_scales(levels: tuple[int, ...], lay: Layout) -> I32:
    out = np.full(lay.cells, PLAIN_SCALE, np.int32)
    for band in lay.bands.tolist():
        out[cells_of(band)] = levels[0 if band[ORIENT] == LL else band[LEVEL]]
    return out


def start_scales(aim: PerceptualWeights, lay: Layout) -> I32:
    """Return the scales of all coefficients by their level alone; flat, int32, not to be written to."""
    return _first_scales(tuple(aim.levels.tolist()), lay)


def begin(aim: PerceptualWeights, state: State, targets: I32) -> I32:
    """Scale every coefficient by its level, before anything is known; returns the targets so scaled."""
    state.scale[:] = start_scales(aim, state.lay)
    return (np.abs(targets.astype(np.int64)) * state.scale // PLAIN_SCALE * np.sign(targets)).astype(np.int32)


def follow(aim: PerceptualWeights, state: State, row: int, lows: I32, finest: int, targets: I32, scaled: I32) -> None:
    """Scale the bands of a level anew by the contrast that is known around each coefficient.

    Args:
        aim: The model's.
        state: Brought forward: scales, and what is known in them.
        row: The level's first band.
        lows: Low-pass pictures known so far, see `planes.low_pictures`.
        finest: The finest level of these.
        targets: Coefficients to tell, not scaled.
        scaled: The same scaled; brought forward.
    """
    lay = state.lay
    level = int(lay.bands[row, LEVEL])
    variance = _variance(lows, lay, finest, level)
    _apply(
        lay.bands, row, int(aim.levels[level]), level - finest, aim.contrast, variance, state.scale, state.values,
        state.widths, targets, scaled,
    )  # fmt: skip


def expected(aim: PerceptualWeights, shown: I32, lay: Layout) -> I32:
    """Return the scales that a picture will have once its coefficients `shown` (flat, int32) are coded; flat, int32."""
    state = State(lay)
    begin(aim, state, shown)
    _, lows = transform.inverse(transform.from_flat(shown, lay), lay, 1)
    for row in range(1, lay.bands.shape[0], 3):
        if lay.bands[row, LEVEL] in FOLLOWING:
            follow(aim, state, row, lows, 1, shown, shown.copy())
    return state.scale


def _variance(lows: I32, lay: Layout, finest: int, level: int) -> I64:
    """Local variance, in grey squared, of the low-pass picture of level `finest`, as wide as suits `level`."""
    height, width = (int(n) for n in lay.sides[finest])
    radius, rounds = _WINDOWS[min(level - finest, len(_WINDOWS) - 1)]
    return np.asarray(_spread(lows, int(lay.low_offsets[finest]), height, width, finest + 3, radius, rounds))


@jit
def _sum_around(plane: I64, radius: int) -> I64:
    """Sum over a square around each place; outside the picture its edge repeats."""
    height, width = plane.shape
    across, out = np.zeros_like(plane), np.zeros_like(plane)
    for y in range(height):
        for x in range(width):
            for k in range(-radius, radius + 1):
                across[y, x] += plane[y, min(max(x + k, 0), width - 1)]
    for y in range(height):
        for k in range(-radius, radius + 1):
            line = min(max(y + k, 0), height - 1)
            for x in range(width):
                out[y, x] += across[line, x]
    return out


@jit
def _spread(lows: I32, at: int, height: int, width: int, shift: int, radius: int, rounds: int) -> I64:
    """Local variance in grey squared; `shift` makes eighths of grey of the values."""
    sums, squares = np.zeros((height, width), np.int64), np.zeros((height, width), np.int64)
    for y in range(height):
        for x in range(width):
            value = np.int64(lows[at + (y + 1) * (width + 2) + x + 1]) >> shift
            sums[y, x], squares[y, x] = value, value * value
    count = np.int64(1)
    for _ in range(rounds):
        sums, squares = _sum_around(sums, radius), _sum_around(squares, radius)
        count *= (2 * radius + 1) ** 2
    return (squares * count - sums * sums) // (count * count * 64)


@jit
def _apply(
    bands: I32,
    row: int,
    level_scale: int,
    halvings: int,
    contrast: I32,
    variance: I64,
    scale: I32,
    values: I32,
    widths: I32,
    targets: I32,
    scaled: I32,
) -> None:
    height, width = variance.shape
    middle = (1 << halvings) >> 1
    for band in range(row, row + 3):
        for y in range(bands[band, HEIGHT]):
            for x in range(bands[band, WIDTH]):
                at = bands[band, OFFSET] + y * bands[band, STRIDE] + x
                place_y, place_x = min((y << halvings) + middle, height - 1), min((x << halvings) + middle, width - 1)
                rest = variance[place_y, place_x] + STILL_GREY2
                power = np.int64(0)
                while rest >> (power + 1):
                    power += 1
                eighth = 8 * power + ((rest << 3) >> power) - 8
                new = max((np.int64(level_scale) * contrast[min(eighth, CONTRASTS - 1)]) >> 8, 1)
                old = np.int64(scale[at])
                if values[at] > 0:
                    values[at] = max((values[at] * new + (old >> 1)) // old, 1)
                    widths[at] = max((widths[at] * new + (old >> 1)) // old, 1)
                scale[at] = new
                size = (abs(np.int64(targets[at])) * new) >> 8
                scaled[at] = size if targets[at] > 0 else -size
