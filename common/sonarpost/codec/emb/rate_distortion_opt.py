"""Rate-distortion optimisation: target coefficients that give a smaller error in the image than the original ones.

The 9/7 wavelet is not orthonormal, least of all at the borders of the image. The coefficients that are sent can
therefore represent a part of those that are not sent. The decoder does not depend on this. Integer arithmetic only, so
that all machines write the same stream.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from sonarpost.codec.emb import transform
from sonarpost.codec.emb.coder import UNIT_SCALE
from sonarpost.codec.emb.kernel import I32
from sonarpost.codec.emb.model import PerceptualWeights
from sonarpost.codec.emb.perceptual_weights import expected_scales, initial_scales
from sonarpost.codec.emb.side_info import UNIT_WEIGHT
from sonarpost.codec.emb.transform import HEIGHT, HH, HL, LEVEL, LH, LL, ORIENT, WIDTH, Layout, Plane, cells_of

_BITS_A_COEFFICIENT: Final = 5
"""Approximate cost of a coefficient that is sent, with sign, refinement and its share of zeros."""
_ROUNDS: Final = 3
_MIN_THRESHOLD: Final = transform.UNIT
_STEP_BITS: Final = 14
_HALF: Final = 1 << (transform.FRACTION_BITS - 1)
_SQUARE_BITS: Final = 2 * transform.FRACTION_BITS


@dataclass(frozen=True, eq=False)
class TargetCoefficients:
    """The coefficients to encode.

    Attributes:
        layout: Layout of the image.
        plane: Shape (height_px, width_px), int64: the image in 1/64 grey, minus the mean level.
        originals: Shape (layout.cells,), int32: its coefficients, flat, with the weights of the region of interest.
        targets: Coefficients to code instead of them.
    """

    layout: Layout
    plane: Plane
    originals: I32
    targets: I32


def target_coefficients(
    plane: Plane, layout: Layout, weights: Plane, body_bytes: int, perceptual: PerceptualWeights | None = None
) -> TargetCoefficients:
    """Return the coefficients to encode for a budget.

    Args:
        plane: See `TargetCoefficients`.
        layout: Layout of the image.
        weights: Weight of each coefficient in 1/256, flat; see `side_info.region_weights`.
        body_bytes: The budget of the body.
        perceptual: Perceptual weights of the model.
    """
    originals = transform.to_flat(transform.forward(plane, layout), layout)
    coding_weights = weights
    if perceptual is not None:
        coding_weights = _with_perceptual(perceptual, originals, weights, layout, body_bytes)
    targets = optimised_targets(plane, originals, coding_weights, layout, body_bytes)
    originals, targets = ((c.astype(np.int64) * weights // UNIT_WEIGHT).astype(np.int32) for c in (originals, targets))
    return TargetCoefficients(layout, plane, originals, targets)


def _with_perceptual(
    perceptual: PerceptualWeights, originals: I32, weights: Plane, layout: Layout, body_bytes: int
) -> Plane:
    """Return the weights times the perceptual scales expected at the end of the budget."""
    scaled = originals.astype(np.int64) * initial_scales(perceptual, layout) // UNIT_SCALE
    coded = np.where(np.abs(scaled) >= _threshold(scaled, body_bytes), originals, 0).astype(np.int32)
    return np.asarray(np.maximum(weights * expected_scales(perceptual, coded, layout) // UNIT_SCALE, 1), np.int64)


def optimised_targets(plane: Plane, originals: I32, weights: Plane, layout: Layout, body_bytes: int) -> I32:
    """Return the coefficients to code instead of the original ones.

    A few rounds of iterated thresholding (Blumensath and Davies, 2008). Coefficients within the budget move half way to
    the value that alone minimises the error of the image. Those below the threshold show what they could contribute.
    `originals` are the coefficients of the plane, flat, int32; the other arguments are those of `target_coefficients`.

    Returns:
        Shape (layout.cells,), int32, without weights.
    """
    threshold = _threshold(originals.astype(np.int64) * weights // UNIT_WEIGHT, body_bytes)
    minimum = threshold * UNIT_WEIGHT // weights
    targets = originals.astype(np.int64)
    for _ in range(_ROUNDS):
        sent = np.where(np.abs(targets) >= minimum, targets, 0)
        targets = sent + (_optimal_step(plane, sent, layout) >> 1)
    sent = np.where(np.abs(targets) >= minimum, targets, 0)
    step = _optimal_step(plane, sent, layout)
    # Three quarters: a coefficient slightly below the threshold is better not sent.
    return np.where(sent != 0, sent + (step >> 1), step - (step >> 2)).astype(np.int32)


def _threshold(coefficients: Plane, body_bytes: int) -> int:
    """Return about the smallest coefficient within the budget: 4/5 of the one at that rank by size."""
    count = min(8 * body_bytes // _BITS_A_COEFFICIENT, coefficients.size - 1)
    place = coefficients.size - 1 - count
    return max(int(np.partition(np.abs(coefficients), place)[place]) * 4 // 5, _MIN_THRESHOLD)


def _optimal_step(plane: Plane, coefficients: Plane, layout: Layout) -> Plane:
    """Return the change of each coefficient that alone minimises the error of the image; flat, int64."""
    decoded, _ = transform.inverse(transform.from_flat(coefficients.astype(np.int32), layout), layout)
    gradient = np.zeros(layout.cells, np.int64)
    gradient[layout.position] = transform.correlate(plane - decoded, layout)
    return (gradient * _step_sizes(layout) + (1 << (_STEP_BITS - 1))) >> _STEP_BITS


@lru_cache(maxsize=8)
def _step_sizes(layout: Layout) -> Plane:
    """Return the gain of each coefficient divided by the squared norm of its wavelet, in 1/2^14; flat.

    A wavelet of the plane is the product of one along the column and one along the row, and so is its norm.
    """
    columns, rows = (_squared_norms(side, layout.levels) for side in (layout.height_px, layout.width_px))
    out, gains = np.zeros(layout.cells, np.int64), transform.gain_map(layout)
    for band in layout.bands.tolist():
        if not band[HEIGHT] or not band[WIDTH]:
            continue
        level, orient = (band[LEVEL] - 1, band[ORIENT]) if band[ORIENT] != LL else (layout.levels, LL)
        down, across = columns[level][int(orient in (LH, HH))], rows[level][int(orient in (HL, HH))]
        norms = (down[:, None] * across) >> _SQUARE_BITS
        at = cells_of(band)
        out[at] = (gains[at] << (_SQUARE_BITS + _STEP_BITS - 10)) // norms
    return out


@lru_cache(maxsize=16)
def _squared_norms(side: int, levels: int) -> tuple[tuple[Plane, ...], ...]:
    """Return squared norms of the wavelets of a line, 1/2^28: low and high of each level from 1; last, the cosines."""
    sides = [side]
    for _ in range(levels):
        sides.append((sides[-1] + 1) // 2)
    synthesis = np.eye(side, dtype=np.int64) << transform.FRACTION_BITS  # response of each value of the previous level
    out: list[tuple[Plane, ...]] = []
    for level in range(1, levels + 1):
        n, low = sides[level - 1], sides[level]
        single = np.eye(n, dtype=np.int64) << transform.FRACTION_BITS
        transform.synthesise_rows(single)
        synthesis = (single @ synthesis + _HALF) >> transform.FRACTION_BITS
        norms = (synthesis**2).sum(1)
        out.append((norms[:low], norms[low:]))
        synthesis = synthesis[:low]
    cosines = (transform.cosine_matrix(sides[levels]) @ synthesis + _HALF) >> transform.FRACTION_BITS
    return (*out, ((cosines**2).sum(1),))
