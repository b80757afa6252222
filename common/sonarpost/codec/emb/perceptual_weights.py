"""Perceptual weights: how a model for structural similarity scales coefficients before coding.

Structural similarity divides an error by the local contrast, and the image at a half and a quarter of its size decides
it. A perceptual model therefore codes every coefficient with a scale. The scale depends on the level and, at the levels
that carry objects, on the local contrast that encoder and decoder know from the coefficients coded before. Integer
arithmetic only.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np

from sonarpost.codec.emb import transform
from sonarpost.codec.emb.coder import UNIT_SCALE, CoefficientState
from sonarpost.codec.emb.kernel import I32, I64
from sonarpost.codec.emb.model import CONTRASTS, PerceptualWeights
from sonarpost.codec.emb.transform import HEIGHT, LEVEL, LL, OFFSET, ORIENT, STRIDE, WIDTH, Layout, cells_of
from sonarpost.codec.jit import jit

ADAPTIVE_LEVELS: Final = (3, 2)
"""Levels whose scale depends on the contrast. Coarser levels gain little; of the finest level little is coded."""
VARIANCE_OFFSET: Final = 150
"""Added to the local variance, in grey squared: limits the weight of a seabed without contrast."""
# Radius and rounds of the box filter of the variance, by level minus the level of the image: a standard deviation of 4
# to 5 px at levels 2 and 3.
_WINDOWS: Final = ((1, 1), (1, 2), (2, 2))


@lru_cache(maxsize=8)
def initial_scales(weights: PerceptualWeights, layout: Layout) -> I32:
    """Return the scales of all coefficients by their level only, flat, int32. Do not modify the result."""
    out = np.full(layout.cells, UNIT_SCALE, np.int32)
    for band in layout.bands.tolist():
        out[cells_of(band)] = weights.levels[0 if band[ORIENT] == LL else band[LEVEL]]
    return out


def apply_initial_scales(weights: PerceptualWeights, state: CoefficientState, targets: I32) -> I32:
    """Set the initial scales in the state; return the scaled targets."""
    state.scale[:] = initial_scales(weights, state.layout)
    return (np.abs(targets.astype(np.int64)) * state.scale // UNIT_SCALE * np.sign(targets)).astype(np.int32)


def adapt_scales(
    weights: PerceptualWeights,
    state: CoefficientState,
    row: int,
    lows: I32,
    finest: int,
    targets: I32,
    scaled: I32,
) -> None:
    """Adapt the scales of the bands of a level to the local contrast.

    Args:
        weights: Perceptual weights of the model.
        state: Scales and intervals; modified.
        row: First band of the level.
        lows: Low-pass images, see `bitplanes.low_pass_images`.
        finest: Finest level of these.
        targets: Coefficients to code, not scaled.
        scaled: Scaled coefficients; modified.
    """
    layout = state.layout
    level = int(layout.bands[row, LEVEL])
    variance = local_variance(lows, layout, finest, level)
    _rescale(
        layout.bands, row, int(weights.levels[level]), level - finest, weights.contrast, variance, state.scale,
        state.lower, state.widths, targets, scaled,
    )  # fmt: skip


def expected_scales(weights: PerceptualWeights, coefficients: I32, layout: Layout) -> I32:
    """Return the scales after coding of these coefficients (flat, int32); flat, int32."""
    state = CoefficientState(layout)
    apply_initial_scales(weights, state, coefficients)
    _, lows = transform.inverse(transform.from_flat(coefficients, layout), layout, 1)
    for row in range(1, layout.bands.shape[0], 3):
        if layout.bands[row, LEVEL] in ADAPTIVE_LEVELS:
            adapt_scales(weights, state, row, lows, 1, coefficients, coefficients.copy())
    return state.scale


def local_variance(lows: I32, layout: Layout, finest: int, level: int) -> I64:
    """Return the local variance of the low-pass image of level `finest`, in grey squared, for scales of `level`."""
    height, width = (int(n) for n in layout.sides[finest])
    radius, rounds = _WINDOWS[min(level - finest, len(_WINDOWS) - 1)]
    moments = np.zeros((2, height, width), np.int64)
    _variance(lows, int(layout.low_offsets[finest]), finest + 3, radius, rounds, moments, np.zeros_like(moments[0]))
    return np.asarray(moments[0], np.int64)


@jit
def _variance(  # noqa: C901, PLR0912  one function compiles faster than several
    lows: I32, start: int, shift: int, radius: int, rounds: int, moments: I64, across: I64
) -> None:
    """Compute the local variance in grey squared.

    Args:
        lows: Low-pass images.
        start: Index of the image in `lows`.
        shift: Converts its values to 1/8 grey.
        radius: Radius of the box filter. Outside the image its edge repeats.
        rounds: Number of times that the filter is applied.
        moments: Shape (2, height, width); `moments[0]` receives the result.
        across: Shape (height, width), overwritten.
    """
    _, height, width = moments.shape
    for y in range(height):
        for x in range(width):
            value = np.int64(lows[start + (y + 1) * (width + 2) + x + 1]) >> shift
            moments[0, y, x], moments[1, y, x] = value, value * value
    count = 1
    for _ in range(rounds):
        count *= (2 * radius + 1) ** 2
        for m in range(2):
            for y in range(height):
                for x in range(width):
                    total = 0
                    for k in range(x - radius, x + radius + 1):
                        total += moments[m, y, min(max(k, 0), width - 1)]
                    across[y, x] = total
            for y in range(height):
                for x in range(width):
                    moments[m, y, x] = 0
                for k in range(y - radius, y + radius + 1):
                    line = min(max(k, 0), height - 1)
                    for x in range(width):
                        moments[m, y, x] += across[line, x]
    for y in range(height):
        for x in range(width):
            total = moments[0, y, x]
            moments[0, y, x] = (moments[1, y, x] * count - total * total) // (count * count * 64)


@jit
def _rescale(
    bands: I32,
    row: int,
    level_scale: int,
    halvings: int,
    contrast: I32,
    variance: I64,
    scale: I32,
    lower: I32,
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
                total = variance[place_y, place_x] + VARIANCE_OFFSET
                power = np.int64(0)
                while total >> (power + 1):
                    power += 1
                eighth = 8 * power + ((total << 3) >> power) - 8
                new = max((np.int64(level_scale) * contrast[min(eighth, CONTRASTS - 1)]) >> 8, 1)
                old = np.int64(scale[at])
                if lower[at] > 0:
                    lower[at] = max((lower[at] * new + (old >> 1)) // old, 1)
                    widths[at] = max((widths[at] * new + (old >> 1)) // old, 1)
                scale[at] = new
                size = (abs(np.int64(targets[at])) * new) >> 8
                scaled[at] = size if targets[at] > 0 else -size
