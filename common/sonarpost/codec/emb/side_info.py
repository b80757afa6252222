"""Side information at the start of a body: mean level, start step, region of interest, texture and strength."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Final

import numpy as np

from sonarpost.codec.emb.coder import Coder
from sonarpost.codec.emb.despeckle import STRENGTH_STEPS
from sonarpost.codec.emb.kernel import I64
from sonarpost.codec.emb.model import Model
from sonarpost.codec.emb.transform import HEIGHT, LEVEL, LL, OFFSET, ORIENT, STRIDE, WIDTH, Layout
from sonarpost.errors import StreamError

MEAN_STEP: Final = 4
TEXTURE_BANDS: Final = 8
MAX_EXTRA_PLANES: Final = 6
SIXTEENTHS: Final = 16
INSIDE_WEIGHT: Final = 384
UNIT_WEIGHT: Final = 256
"""Coefficients inside the region of interest are coded as if they were 3/2 as large: their error weighs 9/4 as much."""
_RARE: Final = 1024  # probability of 1, in 1/65536, of a flag that is rarely set
_ODD_STEP: Final = 4096  # probability of an odd start step, in 1/65536: the encoder usually tries the even ones


@dataclass(frozen=True, slots=True)
class RegionOfInterest:
    """A part of the image that gets more bits, in sixteenths of the sides.

    Attributes:
        top: First row, 0..15.
        left: First column, 0..15.
        bottom: Last row, `top`..15.
        right: Last column, `left`..15.

    Raises:
        StreamError: A value is out of range.
    """

    top: int
    left: int
    bottom: int
    right: int

    def __post_init__(self) -> None:
        limits = (("top", self.top, 0), ("left", self.left, 0), ("bottom", self.bottom, self.top))
        for name, value, low in (*limits, ("right", self.right, self.left)):
            if not low <= value < SIXTEENTHS:
                raise StreamError("region of interest", name, value, f"{low}..{SIXTEENTHS - 1} sixteenths")


def region_weights(layout: Layout, region: RegionOfInterest | None) -> I64:
    """Return the weight of every coefficient in the flat layout, in 1/256. The lowest band keeps unit weight."""
    out = np.full(layout.cells, UNIT_WEIGHT, np.int64)
    if region is None:
        return out
    for band in layout.bands.tolist():
        if band[ORIENT] == LL:
            continue
        top, bottom = _cells_over(region.top, region.bottom, band[HEIGHT], layout.height_px, band[LEVEL])
        left, right = _cells_over(region.left, region.right, band[WIDTH], layout.width_px, band[LEVEL])
        for y in range(top, bottom):
            at = band[OFFSET] + y * band[STRIDE]
            out[at + left : at + right] = INSIDE_WEIGHT
    return out


def _cells_over(first: int, last: int, cells: int, side_px: int, level: int) -> tuple[int, int]:
    """Return the first and last + 1 cell of a band over a range of sixteenths of the side."""
    start_px, stop_px = first * side_px // SIXTEENTHS, -(-(last + 1) * side_px // SIXTEENTHS)
    return min(start_px >> level, cells), min(-(-stop_px >> level), cells)


@dataclass(frozen=True, slots=True)
class SideInfo:
    """Side information.

    Attributes:
        mean_index: Mean grey / 4, 0..63; -1 if the stream is too short.
        start_step: 0..7; -1 if the stream is too short. Then nothing after it is known.
        region: Region of interest.
        texture: Strength of the image's texture in each band, 0..15; see `decode`.
        extra_planes: Planes above the usual first one, 0..6, for images that are half black and half white.
        strength: Strength of despeckling in sixteenths: 0 for models that do not send it, else 1..16.
    """

    mean_index: int
    start_step: int
    region: RegionOfInterest | None = None
    texture: tuple[int, ...] | None = None
    extra_planes: int = 0
    strength: int = 0

    @property
    def mean(self) -> int:
        """Mean grey level."""
        return self.mean_index * MEAN_STEP


_WHOLE_IMAGE: Final = RegionOfInterest(0, 0, 15, 15)


class _EndOfStreamError(Exception):
    """The bytes do not determine the next bit."""


def code_side_info(coder: Coder, model: Model, side: SideInfo) -> SideInfo:
    """Write side information, or read what the stream determines of it.

    If the budget ends within it, the coder stops. `side` is ignored when the coder reads.
    """
    mean_index = -1
    try:
        mean_index = _code_mean(coder, model, side.mean_index)
        start_step = 2 * _code_number(coder, 2, side.start_step >> 1) + _code_bit(coder, side.start_step & 1, _ODD_STEP)
        extra = 0
        while extra < MAX_EXTRA_PLANES and _code_bit(coder, int(extra < side.extra_planes), _RARE):
            extra += 1
        region = None
        if _code_bit(coder, int(side.region is not None), _RARE):
            top, left, bottom, right = (_code_number(coder, 4, n) for n in astuple(side.region or _WHOLE_IMAGE))
            region = RegionOfInterest(min(top, bottom), min(left, right), max(top, bottom), max(left, right))
        texture = None
        if _code_bit(coder, int(side.texture is not None), _RARE):
            texture = tuple(_code_number(coder, 4, n) for n in side.texture or (0,) * TEXTURE_BANDS)
        strength = STRENGTH_STEPS if model.sends_strength else 0
        if model.sends_strength and _code_bit(coder, int(side.strength < STRENGTH_STEPS), _RARE):
            strength = max(_code_number(coder, 4, side.strength), 1)
        return SideInfo(mean_index, start_step, region, texture, extra, strength)
    except _EndOfStreamError:
        return SideInfo(mean_index, -1)


def _code_bit(coder: Coder, bit: int, probability: int = 32768) -> int:
    coded = coder.code_bit(bit, probability)
    if coded < 0:
        raise _EndOfStreamError
    return coded


def _code_number(coder: Coder, bits: int, value: int) -> int:
    coded = 0
    for place in range(bits - 1, -1, -1):
        coded = 2 * coded + _code_bit(coder, value >> place & 1)
    return coded


def _code_mean(coder: Coder, model: Model, mean_index: int) -> int:
    node = 1
    for place in range(5, -1, -1):
        node = 2 * node + _code_bit(coder, mean_index >> place & 1, int(model.mean_tree[node]))
    return node - 64
