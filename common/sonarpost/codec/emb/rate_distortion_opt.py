"""Targets of the encoder: coefficients whose coding comes nearer to the picture than that of the plain ones.

The 9/7 wavelet is not orthonormal, least of all at the picture's borders: what the coefficients that are left out would
have said can partly be said by those that are sent. The decoder knows nothing of this. Integers throughout, so that
every machine writes the same stream.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import transform
from sonarpost.codec.emb._jit import jit
from sonarpost.codec.emb.coder import PLAIN_SCALE
from sonarpost.codec.emb.layout import HEIGHT, HH, HL, LEVEL, LH, LL, ORIENT, WIDTH, Layout, cells_of
from sonarpost.codec.emb.perceptual_weights import PerceptualWeights, expected, start_scales
from sonarpost.codec.emb.region import OUTSIDE

Plane = npt.NDArray[np.int64]
I32 = npt.NDArray[np.int32]

_BITS_A_COEFFICIENT: Final = 5
"""About what the code spends on each coefficient that it sends, sign, refinement and its zeros included."""
_ROUNDS: Final = 3
_LEAST_THRESHOLD: Final = transform.UNIT
_STEP_BITS: Final = 14
_HALF: Final = 1 << (transform.FRACTION_BITS - 1)


@dataclass(frozen=True, eq=False)
class TargetCoefficients:
    """What to encode.

    Attributes:
        lay: The picture's layout.
        plane: Shape (height_px, width_px), int64, 1/64 grey, without the mean level.
        plain: Shape (lay.cells,), int32: its coefficients, flat, weighted by the region of interest.
        targets: What to code in their place.
    """

    lay: Layout
    plane: Plane
    plain: I32
    targets: I32


def target_coefficients(
    plane: Plane, lay: Layout, worth: Plane, body_bytes: int, aim: PerceptualWeights | None = None
) -> TargetCoefficients:
    """Return what to encode of a picture into so many bytes.

    Args:
        plane: See `TargetCoefficients`.
        lay: The picture's layout.
        worth: Weight of each coefficient in 1/256, flat; see `region.weights`.
        body_bytes: The budget.
        aim: The model's, if it has one.
    """
    plain = transform.to_flat(transform.forward(plane, lay), lay)
    worth_coded = worth if aim is None else _worth_with_aim(aim, plain, worth, lay, body_bytes)
    targets = optimised_targets(plane, plain, worth_coded, lay, body_bytes)
    plain, targets = ((c.astype(np.int64) * worth // OUTSIDE).astype(np.int32) for c in (plain, targets))
    return TargetCoefficients(lay, plane, plain, targets)


def _worth_with_aim(aim: PerceptualWeights, plain: I32, worth: Plane, lay: Layout, body_bytes: int) -> Plane:
    """Weight of each coefficient with the scale that it will about have once the budget is spent."""
    scaled = plain.astype(np.int64) * start_scales(aim, lay) // PLAIN_SCALE
    shown = np.where(np.abs(scaled) >= _threshold(scaled, body_bytes), plain, 0).astype(np.int32)
    return np.asarray(np.maximum(worth * expected(aim, shown, lay) // PLAIN_SCALE, 1), np.int64)


def optimised_targets(picture: Plane, plain: I32, worth: Plane, lay: Layout, body_bytes: int) -> I32:
    """Return what to code instead of the plain coefficients.

    A few rounds of iterated thresholding (Blumensath and Davies, 2008): those that the budget will reach move half way
    to where, by themselves, they would bring the picture nearest, and those left out show what they could bring.

    Args:
        picture: Shape (height_px, width_px), int64, 1/64 grey, without its mean level.
        plain: Its coefficients, flat, int32.
        worth: As `target_coefficients`.
        lay: The picture's layout.
        body_bytes: What they are coded into.

    Returns:
        Shape (lay.cells,), int32, not weighted.
    """
    threshold = _threshold(plain.astype(np.int64) * worth // OUTSIDE, body_bytes)
    least = threshold * OUTSIDE // worth
    near = plain.astype(np.int64)
    for _ in range(_ROUNDS):
        kept = np.where(np.abs(near) >= least, near, 0)
        near = kept + (_pull(picture, kept, lay) >> 1)
    kept = np.where(np.abs(near) >= least, near, 0)
    pull = _pull(picture, kept, lay)
    # Three quarters: what is below the threshold by a little is rather not sent.
    return np.where(kept != 0, kept + (pull >> 1), pull - (pull >> 2)).astype(np.int32)


def _threshold(coefficients: Plane, body_bytes: int) -> int:
    """About the least coefficient that so many bytes will show: four fifths of the one in that place by size."""
    count = min(8 * body_bytes // _BITS_A_COEFFICIENT, coefficients.size - 1)
    place = coefficients.size - 1 - count
    return max(int(np.partition(np.abs(coefficients), place)[place]) * 4 // 5, _LEAST_THRESHOLD)


def _pull(picture: Plane, coefficients: Plane, lay: Layout) -> Plane:
    """How far each coefficient alone would have to move to bring the picture nearest; flat, int64."""
    shown, _ = transform.inverse(transform.from_flat(coefficients.astype(np.int32), lay), lay)
    rest = picture - shown
    _gather(rest, lay.sides)
    height, width = (int(n) for n in lay.sides[lay.levels])
    low = (transform.cosine_matrix(height) @ rest[:height, :width] + _HALF) >> transform.FRACTION_BITS
    rest[:height, :width] = (low @ transform.cosine_matrix(width).T + _HALF) >> transform.FRACTION_BITS
    slope = np.zeros(lay.cells, np.int64)
    slope[lay.position] = rest
    return (slope * _reach(lay) + (1 << (_STEP_BITS - 1))) >> _STEP_BITS


@jit
def _lift_back(line: Plane, n: int, first: int, constant: int) -> None:
    """Undo the sides of a lifting step: every second value gives to its two neighbours what it would take of them."""
    for i in range(first, n, 2):
        part = (line[i] * constant + _HALF) >> transform.FRACTION_BITS
        line[i - 1 if i > 0 else i + 1] += part
        line[i + 1 if i + 1 < n else i - 1] += part


@jit
def _gather_line(line: Plane, n: int, scratch: Plane) -> None:
    """The transpose of `transform.synthesise_line`."""
    if n == 1:
        return
    _lift_back(line, n, 1, -transform.ALPHA)
    _lift_back(line, n, 0, -transform.BETA)
    _lift_back(line, n, 1, -transform.GAMMA)
    _lift_back(line, n, 0, -transform.DELTA)
    low = (n + 1) // 2
    for i in range(n):
        if i % 2 == 0:
            scratch[i // 2] = (line[i] * transform.GAIN_INVERSE + _HALF) >> transform.FRACTION_BITS
        else:
            scratch[low + i // 2] = (line[i] * transform.GAIN + _HALF) >> transform.FRACTION_BITS
    line[:n] = scratch[:n]


@jit
def _gather(plane: Plane, sides: I32) -> None:
    """In place: what each wavelet, as the decoder draws it, has in common with the picture (its scalar product)."""
    line = np.zeros(max(plane.shape), np.int64)
    scratch = np.zeros(max(plane.shape), np.int64)
    for level in range(sides.shape[0] - 1):
        height, width = sides[level, 0], sides[level, 1]
        for x in range(width):
            line[:height] = plane[:height, x]
            _gather_line(line, height, scratch)
            plane[:height, x] = line[:height]
        for y in range(height):
            line[:width] = plane[y, :width]
            _gather_line(line, width, scratch)
            plane[y, :width] = line[:width]


@lru_cache(maxsize=8)
def _reach(lay: Layout) -> Plane:
    """Weight of the transform times 1 / squared norm of the wavelet, for each coefficient, in 1/2^14; flat.

    A wavelet of the plane is one along the column times one along the row, and so is its norm.
    """
    columns, rows = (_squared_norms(side, lay.levels) for side in (lay.height_px, lay.width_px))
    out, strengths = np.zeros(lay.cells, np.int64), transform.strength_map(lay)
    for band in lay.bands.tolist():
        if not band[HEIGHT] or not band[WIDTH]:
            continue
        level, orient = band[LEVEL], band[ORIENT]
        down = columns[level - 1][int(orient in (LH, HH))] if orient != LL else columns[lay.levels][0]
        across = rows[level - 1][int(orient in (HL, HH))] if orient != LL else rows[lay.levels][0]
        norms = (down[:, None] * across) >> _SQUARE_BITS
        at = cells_of(band)
        out[at] = (strengths[at] << (_SQUARE_BITS + _STEP_BITS - 10)) // norms
    return out


_SQUARE_BITS: Final = 2 * transform.FRACTION_BITS


@lru_cache(maxsize=16)
def _squared_norms(side: int, levels: int) -> tuple[tuple[Plane, ...], ...]:
    """Squared norms of the wavelets of a line, 1/2^28: by level from 1, low then high; last those of the cosines."""
    sides = [side]
    for _ in range(levels):
        sides.append((sides[-1] + 1) // 2)
    drawn = np.eye(side, dtype=np.int64) << transform.FRACTION_BITS  # what a value of the level before draws
    out: list[tuple[Plane, ...]] = []
    scratch = np.zeros(side, np.int64)
    for level in range(1, levels + 1):
        n, low = sides[level - 1], sides[level]
        single = np.eye(n, dtype=np.int64) << transform.FRACTION_BITS
        for line in single:
            transform.synthesise_line(line, n, scratch)
        drawn = (single @ drawn + _HALF) >> transform.FRACTION_BITS
        norms = (drawn**2).sum(1)
        out.append((norms[:low], norms[low:]))
        drawn = drawn[:low]
    cosines = (transform.cosine_matrix(sides[levels]) @ drawn + _HALF) >> transform.FRACTION_BITS
    return (*out, ((cosines**2).sum(1),))
