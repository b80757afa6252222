"""Texture for the eye: speckle of the right strength where the bytes were too few to send any.

At a hundred bytes the seabed between targets decodes as a smooth surface, on which the few coefficients that were worth
sending look like small objects. The stream can carry how strong the original's texture is, in eight bands, in four
bytes; the decoder makes speckle that adds what its picture lacks. It is **invented**: a layer of its own, never part of
the decoded picture, not to be measured on.

Everything is integer arithmetic, so the same stream gives the same grain everywhere.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import transform
from sonarpost.codec.emb.layout import HH, LEVEL, LL, ORIENT, Layout, cells_of
from sonarpost.codec.emb.side_info import GRAIN_BANDS
from sonarpost.codec.interface import Image

Flat = npt.NDArray[np.int32]

_ONE: Final = 4096
"""The mean level in the units of relative coefficients."""
_LEVELS: Final = 16
_DARKEST: Final = 12  # grey below which speckle does not get fainter


def _band_number(level: int, orient: int) -> int:
    """Bands 0..5: levels 1 to 3, each HL with LH, and HH; 6: level 4; 7: all above."""
    if level <= 3:
        return 2 * (level - 1) + (orient == HH)
    return 6 if level == 4 else 7


def _strengths_square(picture: Image, lay: Layout) -> list[int]:
    """Mean square of the coefficients relative to the picture's mean, by band, 1/4096^2."""
    mean = max(int(picture.astype(np.int64).sum()) // picture.size, _DARKEST)
    relative = (picture.astype(np.int64) - mean) * transform.UNIT
    flat = transform.to_flat(transform.forward(relative, lay), lay).astype(np.int64)
    flat = flat * (_ONE // transform.UNIT) // mean
    square, count = [0] * GRAIN_BANDS, [0] * GRAIN_BANDS
    for band in lay.bands.tolist():
        if band[ORIENT] == LL:
            continue
        cells = _cells(flat, band)
        number = _band_number(band[LEVEL], band[ORIENT])
        square[number] += int((cells * cells).sum())
        count[number] += cells.size
    return [s // max(n, 1) for s, n in zip(square, count, strict=True)]


def _cells(flat: npt.NDArray[np.int64], band: list[int]) -> npt.NDArray[np.int64]:
    return np.asarray(flat[cells_of(band)], np.int64)


def _square_of(level: int) -> int:
    """Mean square that a level stands for: 3 dB a level, from 1/90 of the mean up to 1.4 of it."""
    return 0 if level == 0 else 1024 << level


def measure_speckle(picture: Image, lay: Layout) -> tuple[int, ...]:
    """Return the strength of a picture's texture in each band, 0 (none) to 15, 3 dB a step."""
    levels = []
    for square in _strengths_square(picture, lay):
        level = (square * 181 // 256).bit_length() - 10  # rounds in the logarithm: 181/256 is 2^-0.5
        levels.append(min(max(level, 0), _LEVELS - 1))
    return tuple(levels)


def synthesise_speckle(picture: Image, lay: Layout, levels: tuple[int, ...], seed: int = 0) -> npt.NDArray[np.int16]:
    """Return the layer of speckle that a decoded picture lacks, in grey to be added.

    Args:
        picture: Shape (height_px, width_px), uint8, as decoded.
        lay: Its layout.
        levels: The original's, as `measure_speckle` gives them.
        seed: Which of the equally good speckles.

    Returns:
        Shape (height_px, width_px), int16. Add it, at half strength for a natural look, and clip.
    """
    noise = _bell(lay.cells, seed)
    have = _strengths_square(picture, lay)
    flat = np.zeros(lay.cells, np.int64)
    for band in lay.bands.tolist():
        if band[ORIENT] == LL:
            continue
        number = _band_number(band[LEVEL], band[ORIENT])
        strength = _root(max(_square_of(levels[number]) - have[number], 0))
        rows = cells_of(band)
        flat[rows] = noise[rows] * strength >> 8
    relative, _ = transform.inverse(transform.from_flat(flat.astype(np.int32), lay), lay)
    return (relative * np.maximum(picture, _DARKEST) // _ONE).clip(-255, 255).astype(np.int16)


def _bell(count: int, seed: int) -> npt.NDArray[np.int64]:
    """Bell-shaped chance of mean 0 and spread 256: the sum of eight bytes of a counter's hash (splitmix64)."""
    with np.errstate(over="ignore"):
        state = (np.arange(1, count + 1, dtype=np.uint64) + np.uint64(seed << 32)) * np.uint64(0x9E3779B97F4A7C15)
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        state ^= state >> np.uint64(31)
    total = np.zeros(count, np.int64)
    for place in range(8):
        total += ((state >> np.uint64(8 * place)) & np.uint64(255)).astype(np.int64)
    # Eight even chances of 0..255 have spread 209.0.
    return (total - 1020) * 256 // 209


def _root(square: int) -> int:
    """Integer square root."""
    root = 0
    for place in range(square.bit_length() // 2, -1, -1):
        if (root | 1 << place) ** 2 <= square:
            root |= 1 << place
    return root
