"""What the decoder knows about sonar pictures that the bytes do not say: a small convolutional network.

It estimates, from the decoded picture, the mean of the pictures that would have given these bytes, with a little more
contrast than the mean has (see docs/explanation/codecs.md). It works at half resolution on blocks of 2 x 2 pixels, in
integers, and changes no pixel by more than `LIMIT_GREY`.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb._jit import jit
from sonarpost.codec.emb.model import Model
from sonarpost.codec.emb.transform import UNIT

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]

LIMIT_GREY: Final = 48
_ACTIVE_MAX: Final = 4095  # activations are 1/256


@jit
def _layer(source: I32, weights: I32, bias: I32, dilation: int, out: I32, rectify: int) -> None:
    """A layer of 3 x 3 taps; outside the picture its edge repeats.

    Args:
        source: Shape (rows, columns, channels in), int32, at most 4095 in size.
        weights: Shape (9, channels in, channels out), 1/4096.
        bias: Shape (channels out,), 1/2^20.
        dilation: Distance of the taps.
        out: Shape (rows, columns, channels out).
        rectify: 1: take an eighth of what is negative, and limit to +-4095 in 1/256; else keep the sum in 1/256.
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
                    value = min(max(value, value >> 3), _ACTIVE_MAX)
                    value = max(value, -_ACTIVE_MAX)
                out[y, x, j] = value


def enhanced(plane: I64, mean: int, situation: tuple[int, int, int], model: Model) -> I64:
    """Return the corrected picture, without its mean, 1/64 grey.

    Args:
        plane: Shape (height_px, width_px), int64: the decoded picture without its mean, 1/64 grey.
        mean: Grey.
        situation: Features of the whole picture, each about -64..64; see `planes.situation`.
        model: Its `situation` and `layers`.
    """
    height, width = plane.shape
    padded = np.pad(plane, ((0, height % 2), (0, width % 2)), mode="edge")
    grey = np.clip(padded, -mean * UNIT, (255 - mean) * UNIT)
    active = blocks_of(grey >> 4)
    rows, columns, _ = active.shape
    for i, ((taps, bias), dilation) in enumerate(zip(model.layers, model.dilations, strict=True)):
        total = bias
        if i == 0:
            total = (bias + np.array(situation, np.int32) @ model.situation).astype(np.int32)
        out = np.zeros((rows, columns, bias.shape[0]), np.int32)
        _layer(active, taps, total, dilation, out, int(i < len(model.layers) - 1))
        active = out
    # The network's output is 1/256 of 16 grey.
    change = np.clip(pixels_of(active).astype(np.int64) * (UNIT // 16), -UNIT * LIMIT_GREY, UNIT * LIMIT_GREY)
    return np.asarray(grey + change, np.int64)[:height, :width]


def blocks_of(grey: I64) -> I32:
    """Shape (2 r, 2 c) to (r, c, 4)."""
    rows, columns = grey.shape[0] // 2, grey.shape[1] // 2
    return np.ascontiguousarray(
        grey.reshape(rows, 2, columns, 2).transpose(0, 2, 1, 3).reshape(rows, columns, 4).astype(np.int32)
    )


def pixels_of(blocks: I32) -> I32:
    """Undo `blocks_of`."""
    rows, columns, _ = blocks.shape
    return blocks.reshape(rows, columns, 2, 2).transpose(0, 2, 1, 3).reshape(2 * rows, 2 * columns)
