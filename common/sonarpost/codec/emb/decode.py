"""The decoder: from a body to coefficients, and to the image before and after the enhancer.

The enhancer is a small convolutional network. From the decoded image it estimates the mean of the images that give the
same bytes, with slightly more contrast than that mean (see docs/explanation/codecs.md). It works in integers at half
the resolution on blocks of 2 x 2 pixels, and changes no pixel by more than `LIMIT_GREY`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sonarpost.codec.emb import transform
from sonarpost.codec.emb.bitplanes import code_planes, image_features, reconstructed_coefficients
from sonarpost.codec.emb.coder import Coder, CoefficientState
from sonarpost.codec.emb.kernel import I32, I64
from sonarpost.codec.emb.model import DILATIONS, Model
from sonarpost.codec.emb.side_info import SideInfo, code_side_info
from sonarpost.codec.emb.transform import UNIT, Layout
from sonarpost.codec.interface import Image
from sonarpost.codec.jit import jit

LIMIT_GREY: Final = 48
_MAX_ACTIVATION: Final = 4095  # activations are 1/256


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
