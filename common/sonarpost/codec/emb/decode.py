"""The decoder: from a body to coefficients, to the image before and after the enhancer, and to synthetic speckle.

The enhancer is a small convolutional network. From the decoded image it estimates the mean of the images that give the
same bytes, with slightly more contrast than that mean (see docs/explanation/codecs.md). It works in integers at half
the resolution on blocks of 2 x 2 pixels, and changes no pixel by more than `LIMIT_GREY`.

Speckle: at a hundred bytes, the seabed between targets decodes as a smooth surface, and its few coefficients look like
small objects. A stream can carry the strength of the original texture in eight bands, in four bytes. The decoder then
synthesises the speckle that the decoded image lacks. This speckle is **not measured**: it is a separate layer, never
part of the decoded image, and must not be used for measurements. Integer arithmetic only, so the same stream gives the
same speckle on all machines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import transform
from sonarpost.codec.emb.bitplanes import code_planes, image_features, reconstructed_coefficients
from sonarpost.codec.emb.coder import Coder, CoefficientState
from sonarpost.codec.emb.kernel import I32, I64
from sonarpost.codec.emb.model import DILATIONS, Model
from sonarpost.codec.emb.side_info import TEXTURE_BANDS, SideInfo, code_side_info
from sonarpost.codec.emb.transform import HH, LEVEL, LL, ORIENT, UNIT, Layout, cells_of
from sonarpost.codec.interface import Image
from sonarpost.codec.jit import jit

LIMIT_GREY: Final = 48
_MAX_ACTIVATION: Final = 4095  # activations are 1/256
_ONE: Final = 4096
"""The mean level, in units of relative coefficients."""
_LEVELS: Final = 16
_DARKEST: Final = 12  # grey level below which the speckle does not become weaker


@dataclass(frozen=True, eq=False)
class DecodedCoefficients:
    """An image before the enhancer.

    Attributes:
        plane: Shape (height_px, width_px), int64, 1/64 grey, minus the mean level.
        mean: Mean grey level.
        features: See `bitplanes.image_features`.
    """

    plane: I64
    mean: int
    features: tuple[int, int, int]


def read_body(body: bytes, layout: Layout, model: Model) -> tuple[CoefficientState, SideInfo]:
    """Return the coefficients and the side information of a body.

    The body may be truncated or damaged.
    """
    coder, state = Coder.reader(body), CoefficientState(layout)
    side = code_side_info(coder, model, SideInfo(0, 0))
    if side.start_step >= 0:
        code_planes(coder, state, model, np.zeros(layout.cells, np.int32), side)
    return state, side


def image_before_enhancer(state: CoefficientState, side: SideInfo, model: Model) -> DecodedCoefficients:
    """Return the image of the coefficients."""
    plane, _ = transform.inverse(reconstructed_coefficients(state, model, side.region), state.layout)
    return DecodedCoefficients(plane, side.mean, image_features(state, side.mean))


def decoded_image(state: CoefficientState, side: SideInfo, model: Model) -> Image:
    """Return the image of the coefficients after the enhancer."""
    decoded = image_before_enhancer(state, side, model)
    return grey_of(enhance(decoded, model), decoded.mean)


def grey_of(plane: I64, mean: int) -> Image:
    """Convert a plane in 1/64 grey minus the mean level to an image."""
    return np.clip((plane + UNIT // 2) // UNIT + mean, 0, 255).astype(np.uint8)


def enhance(decoded: DecodedCoefficients, model: Model) -> I64:
    """Return the enhanced image minus the mean level, 1/64 grey."""
    height, width = decoded.plane.shape
    padded = np.pad(decoded.plane, ((0, height % 2), (0, width % 2)), mode="edge")
    grey = np.clip(padded, -decoded.mean * UNIT, (255 - decoded.mean) * UNIT)
    activations = to_blocks(grey >> 4)
    rows, columns, _ = activations.shape
    for i, ((taps, bias), dilation) in enumerate(zip(model.layers, DILATIONS, strict=True)):
        total = bias
        if i == 0:
            total = (bias + np.array(decoded.features, np.int32) @ model.image_weights).astype(np.int32)
        out = np.zeros((rows, columns, bias.shape[0]), np.int32)
        _convolve(activations, taps, total, dilation, out, int(i < len(model.layers) - 1))
        activations = out
    # The network's output is 1/256 of 16 grey.
    change = from_blocks(activations).astype(np.int64) * (UNIT // 16)
    return np.asarray(grey + np.clip(change, -UNIT * LIMIT_GREY, UNIT * LIMIT_GREY), np.int64)[:height, :width]


def to_blocks(grey: I64) -> I32:
    """Convert shape (2 r, 2 c) to blocks of 2 x 2 pixels, shape (r, c, 4)."""
    rows, columns = grey.shape[0] // 2, grey.shape[1] // 2
    blocks = grey.reshape(rows, 2, columns, 2).transpose(0, 2, 1, 3).reshape(rows, columns, 4)
    return np.ascontiguousarray(blocks.astype(np.int32))


def from_blocks(blocks: I32) -> I32:
    """Invert `to_blocks`."""
    rows, columns, _ = blocks.shape
    return blocks.reshape(rows, columns, 2, 2).transpose(0, 2, 1, 3).reshape(2 * rows, 2 * columns)


@jit
def _convolve(source: I32, weights: I32, bias: I32, dilation: int, out: I32, rectify: int) -> None:
    """Apply a layer of 3 x 3 taps. Outside the image its edge repeats.

    Args:
        source: Shape (rows, columns, channels in), int32, at most 4095 in magnitude.
        weights: Shape (9, channels in, channels out), 1/4096.
        bias: Shape (channels out,), 1/2^20.
        dilation: Distance of the taps.
        out: Shape (rows, columns, channels out).
        rectify: 1: multiply negative sums by 1/8 and clip to +-4095 in 1/256. 0: store the sum in 1/256.
    """
    rows, columns, inputs = source.shape
    outputs = out.shape[2]
    total = np.zeros(outputs, np.int32)
    for y in range(rows):
        for x in range(columns):
            for j in range(outputs):
                total[j] = bias[j]
            for tap in range(9):
                from_y = min(max(y + (tap // 3 - 1) * dilation, 0), rows - 1)
                from_x = min(max(x + (tap % 3 - 1) * dilation, 0), columns - 1)
                for i in range(inputs):
                    value = source[from_y, from_x, i]
                    if value != 0:
                        for j in range(outputs):
                            total[j] += value * weights[tap, i, j]
            for j in range(outputs):
                value = (total[j] + 2048) >> 12
                if rectify == 1:
                    value = min(max(value, value >> 3), _MAX_ACTIVATION)
                    value = max(value, -_MAX_ACTIVATION)
                out[y, x, j] = value


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
