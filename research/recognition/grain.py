"""Grain: the strength of an image's texture in its stream, and synthetic speckle of that strength.

At a hundred bytes, the seabed between targets decodes as a smooth surface, and its few coefficients look like small
objects. A stream of `emb` can carry the strength of the original texture in eight bands, in four bytes. A viewer can
then add the speckle that the decoded image lacks. This speckle is **not measured**: it is a separate layer, never part
of the decoded image, and must not be used for measurements. Integer arithmetic only, so the same stream gives the same
speckle on all machines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from typing_extensions import override

from sonarpost.codec.emb import transform
from sonarpost.codec.emb.codec import EmbCodec, model_of_stream
from sonarpost.codec.emb.decode import decoded_image, read_body
from sonarpost.codec.emb.kernel import I64
from sonarpost.codec.emb.side_info import TEXTURE_BANDS
from sonarpost.codec.emb.transform import HH, LEVEL, LL, ORIENT, Layout, cells_of, layout_of
from sonarpost.codec.interface import Image, SnippetPixels, encoder_input
from sonarpost.errors import StreamError

_ONE: Final = 4096
"""The mean level, in units of relative coefficients."""
_LEVELS: Final = 16
_DARKEST: Final = 12  # grey level below which the speckle does not become weaker


@dataclass(frozen=True)
class GrainCodec(EmbCodec):
    """The embedded codec with the strength of the image's texture in its streams (4 bytes)."""

    @override
    def encode(self, image: SnippetPixels, budget_bytes: int | None = None) -> bytes:
        grey, _ = encoder_input(self, image)
        texture = measure_speckle(grey, layout_of(*grey.shape))
        header, best = self.best_trial(image, budget_bytes, texture=texture)
        return header.pack() + best.body

    def speckle_layer(self, stream: bytes) -> npt.NDArray[np.int16]:
        """Return the synthetic speckle that the decoded image lacks, as grey levels to add, shape of the image, int16.

        For viewing, add half of it and clip. Do not measure on the result.

        Raises:
            StreamError: As for `decode`, or the stream carries no texture levels.
        """
        model, header = model_of_stream(stream, self.network)
        state, side = read_body(stream[header.size :], layout_of(header.height_px, header.width_px), model)
        if side.texture is None:
            raise StreamError("stream", "texture", None, "a stream with the strength of the texture")
        return synthesise_speckle(decoded_image(state, side, model), state.layout, side.texture)


def _band_number(level: int, orient: int) -> int:
    """Return 0..5 for levels 1 to 3, each HL with LH, and HH; 6 for level 4; 7 for all above."""
    if level <= 3:
        return 2 * (level - 1) + (orient == HH)
    return 6 if level == 4 else 7


def _mean_squares(image: Image, layout: Layout) -> list[int]:
    """Return the mean square of the coefficients relative to the image mean, by band, 1/4096^2."""
    mean = max(int(image.astype(np.int64).sum()) // image.size, _DARKEST)
    relative = (image.astype(np.int64) - mean) * transform.UNIT
    flat = transform.to_flat(transform.forward(relative, layout), layout).astype(np.int64)
    flat = flat * (_ONE // transform.UNIT) // mean
    squares, counts = [0] * TEXTURE_BANDS, [0] * TEXTURE_BANDS
    for band in layout.bands.tolist():
        if band[ORIENT] == LL:
            continue
        cells = np.asarray(flat[cells_of(band)], np.int64)
        number = _band_number(band[LEVEL], band[ORIENT])
        squares[number] += int((cells * cells).sum())
        counts[number] += cells.size
    return [square // max(count, 1) for square, count in zip(squares, counts, strict=True)]


def _mean_square_of(level: int) -> int:
    """Return the mean square of a level: 3 dB a level, from 1/90 of the mean up to 1.4 of it; 0 for level 0."""
    return 0 if level == 0 else 1024 << level


def measure_speckle(image: Image, layout: Layout) -> tuple[int, ...]:
    """Return the strength of the image's texture in each band, 0 (none) to 15, 3 dB a level."""
    levels = []
    for square in _mean_squares(image, layout):
        level = (square * 181 // 256).bit_length() - 10  # rounds in the logarithm: 181/256 is 2^-0.5
        levels.append(min(max(level, 0), _LEVELS - 1))
    return tuple(levels)


def synthesise_speckle(image: Image, layout: Layout, levels: tuple[int, ...], seed: int = 0) -> npt.NDArray[np.int16]:
    """Return the speckle that a decoded image lacks, as grey levels to add.

    Args:
        image: Shape (height_px, width_px), uint8, decoded.
        layout: Layout of the image.
        levels: Levels of the original, from `measure_speckle`.
        seed: Selects one of many equivalent results.

    Returns:
        Shape (height_px, width_px), int16. Add it, at half strength for a natural look, and clip.
    """
    noise = _normal_noise(layout.cells, seed)
    present = _mean_squares(image, layout)
    flat = np.zeros(layout.cells, np.int64)
    for band in layout.bands.tolist():
        if band[ORIENT] == LL:
            continue
        number = _band_number(band[LEVEL], band[ORIENT])
        strength = math.isqrt(max(_mean_square_of(levels[number]) - present[number], 0))
        cells = cells_of(band)
        flat[cells] = noise[cells] * strength >> 8
    relative, _ = transform.inverse(transform.from_flat(flat.astype(np.int32), layout), layout)
    return (relative * np.maximum(image, _DARKEST) // _ONE).clip(-255, 255).astype(np.int16)


def _normal_noise(count: int, seed: int) -> I64:
    """Return approximately normal noise of mean 0 and standard deviation 256.

    Each value is the sum of eight bytes of the hash of a counter (splitmix64).
    """
    with np.errstate(over="ignore"):
        state = (np.arange(1, count + 1, dtype=np.uint64) + np.uint64(seed << 32)) * np.uint64(0x9E3779B97F4A7C15)
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        state ^= state >> np.uint64(31)
    total = np.zeros(count, np.int64)
    for place in range(8):
        total += ((state >> np.uint64(8 * place)) & np.uint64(255)).astype(np.int64)
    # The sum of eight uniform values 0..255 has a standard deviation of 209.0.
    return (total - 1020) * 256 // 209
