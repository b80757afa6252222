"""Which parts of a picture matter more, and which are not there at all."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb.layout import HEIGHT, LEVEL, LL, OFFSET, ORIENT, STRIDE, WIDTH, Layout
from sonarpost.codec.emb.side_info import SIXTEENTHS, Box
from sonarpost.codec.interface import Image, Mask
from sonarpost.errors import StreamError

INSIDE: Final = 384
OUTSIDE: Final = 256
"""Coefficients inside the box are coded as if they were 3/2 as large: their error weighs 9/4 as much."""
_SMOOTHING_ROUNDS: Final = 24


def weights(lay: Layout, box: Box | None) -> npt.NDArray[np.int64]:
    """Return the weight of every coefficient in the flat layout, in 1/256 (256 is plain).

    The lowest band is the same for the whole picture and stays plain.
    """
    out = np.full(lay.cells, OUTSIDE, np.int64)
    if box is None:
        return out
    for band in lay.bands.tolist():
        if band[ORIENT] == LL:
            continue
        top, bottom = _span(box.top, box.bottom, band[HEIGHT], lay.height_px, band[LEVEL])
        left, right = _span(box.left, box.right, band[WIDTH], lay.width_px, band[LEVEL])
        for y in range(top, bottom):
            at = band[OFFSET] + y * band[STRIDE]
            out[at + left : at + right] = INSIDE
    return out


def _span(first: int, last: int, cells: int, side_px: int, level: int) -> tuple[int, int]:
    """Cells of a band that lie over a span of sixteenths of the picture's side."""
    start_px, stop_px = first * side_px // SIXTEENTHS, -(-(last + 1) * side_px // SIXTEENTHS)
    return min(start_px >> level, cells), min(-(-stop_px >> level), cells)


def fill_unknown(picture: Image, known: Mask) -> Image:
    """Return the picture with what is not known made smooth, so that it costs next to nothing to send.

    Each unknown pixel takes the mean of the smallest block (of sides 2, 4, 8, ...) that holds something known, and is
    then smoothed with its neighbours. The decoder is not told: it shows the fill.

    Args:
        picture: Shape (height_px, width_px), uint8.
        known: Same shape.

    Raises:
        StreamError: The shapes differ.
    """
    if known.shape != picture.shape:
        raise StreamError("image", "known.shape", known.shape, f"the picture's {picture.shape}")
    if known.all():
        return picture
    if not known.any():
        return np.full_like(picture, 128)
    filled = _from_blocks(np.where(known, picture, 0).astype(np.int64), known.astype(np.int64))
    hidden = ~known
    for _ in range(_SMOOTHING_ROUNDS):
        padded = np.pad(filled, 1, mode="edge")
        around = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
        filled[hidden] = ((around + 2) >> 2)[hidden]
    return filled.astype(np.uint8)


def _from_blocks(total: npt.NDArray[np.int64], count: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Mean of each cell, or of the block around it where it has none."""
    if total.size == 1:
        return total // np.maximum(count, 1)
    height, width = total.shape
    pad = ((0, height % 2), (0, width % 2))
    halves = [np.pad(a, pad).reshape((height + 1) // 2, 2, (width + 1) // 2, 2).sum((1, 3)) for a in (total, count)]
    coarse = _from_blocks(halves[0], halves[1])
    spread = coarse.repeat(2, 0).repeat(2, 1)[:height, :width]
    return np.where(count > 0, total // np.maximum(count, 1), spread)
