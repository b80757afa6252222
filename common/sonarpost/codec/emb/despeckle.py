"""Despeckling: an estimate of the scene without speckle, which the encoder codes in place of the noisy image.

Under a squared error, the best description of a scene that is seen only through noise is the best description of its
conditional mean given the noisy image (Dobrushin and Tsybakov, 1962; Wolf and Ziv, 1970). A convolutional network
estimates this mean. It works on blocks of 2 x 2 and 4 x 4 pixels and adds a correction to the image.
`research.training.despeckle` trains it. The decoder does not use it.

All machines give the same result: activations and weights are integers, and their sums of products are int32. All
other operations are on single elements.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.resources import files
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.interface import Image
from sonarpost.codec.jit import jit
from sonarpost.errors import ConfigError

Floats = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]

WEIGHTS_FILE: Final = "despeckle-1.npz"
STRENGTH_STEPS: Final = 16
"""Strengths are multiples of 1/16."""
ACTIVATION_LIMIT: Final = 4095
"""Largest activation after the first layer."""
INPUT_LIMIT: Final = 255
"""Largest magnitude of the input: grey minus the mean grey."""
_BLOCK_PX: Final = 8
"""Images are padded to multiples of this: the columns at a quarter of the size are then even in number."""


@dataclass(frozen=True, eq=False)
class Convolution:
    """A convolution of integer activations.

    Attributes:
        weights: Shape (side, side, inputs, outputs), int32; side 1 or 3, inputs a multiple of 4.
        scale: Shape (outputs,), float64: the sum of products times this, plus `bias`, is the layer's result.
        bias: Shape (outputs,), float64.
        dilation: Distance of the taps in cells.
        activation_scale: Size of one activation of the layer's result, in the units of `scale`.
    """

    weights: I32
    scale: Floats
    bias: Floats
    dilation: int
    activation_scale: np.float64

    def __call__(self, cells: I32) -> Floats:
        """Apply it to cells of shape (rows, columns, inputs), columns even; cells outside are 0."""
        rows, columns, _ = cells.shape
        reach = self.dilation * (self.weights.shape[0] // 2)
        sums = np.zeros((rows, columns, self.weights.shape[3]), np.int32)
        _add_products(sums, np.pad(cells, ((reach, reach), (reach, reach), (0, 0))), self.weights, self.dilation)
        return sums * self.scale + self.bias

    def integers(self, values: Floats) -> I32:
        """Return values in the units of `scale` as activations: multiples of `activation_scale`."""
        activations = np.rint(values / self.activation_scale)
        return np.clip(activations, -ACTIVATION_LIMIT, ACTIVATION_LIMIT).astype(np.int32)

    def rectified(self, values: Floats) -> I32:
        """Return values in the units of `scale` as activations, 0 for negative ones."""
        return self.integers(np.maximum(values, 0))


@jit
def _add_products(sums: I32, cells: I32, weights: I32, dilation: int) -> None:
    """Add the products of cells and weights; two columns and four inputs at a time share loads."""
    side, _, inputs, outputs = weights.shape
    for y in range(sums.shape[0]):
        for x in range(0, sums.shape[1], 2):
            left, right = sums[y, x], sums[y, x + 1]
            for row in range(side):
                for column in range(side):
                    p = cells[y + row * dilation, x + column * dilation]
                    q = cells[y + row * dilation, x + 1 + column * dilation]
                    tap = weights[row, column]
                    for i in range(0, inputs, 4):
                        p0, p1, p2, p3 = p[i], p[i + 1], p[i + 2], p[i + 3]
                        q0, q1, q2, q3 = q[i], q[i + 1], q[i + 2], q[i + 3]
                        for o in range(outputs):
                            w0, w1, w2, w3 = tap[i, o], tap[i + 1, o], tap[i + 2, o], tap[i + 3, o]
                            left[o] += p0 * w0 + p1 * w1 + p2 * w2 + p3 * w3
                            right[o] += q0 * w0 + q1 * w1 + q2 * w2 + q3 * w3


DILATIONS: Final = (1, 1, 1, 1, 2, 1, 2, 1, 1, 1, 1, 1, 1)
"""Dilation of each layer: two at half the size, one to and six at a quarter, one back, and three at half the size."""


@cache
def network() -> tuple[Convolution, ...]:
    """Return the shipped network."""
    path = files("sonarpost.codec.emb").joinpath("data", WEIGHTS_FILE)
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        return tuple(
            Convolution(
                np.ascontiguousarray(arrays[f"weights{n}"], np.int32),  # one layout: one compiled function
                arrays[f"scale{n}"],
                arrays[f"bias{n}"],
                dilation,
                arrays["activation_scales"][n],
            )
            for n, dilation in enumerate(DILATIONS)
        )


def check_strength(strength: float) -> float:
    """Return the multiple of 1/16 next to a strength; at least 1/16 if the strength is not 0.

    Raises:
        ConfigError: It is outside 0..1 or not a number.
    """
    if not 0 <= strength <= 1:
        raise ConfigError("codec emb", "strength", strength, "0..1")
    return max(round(strength * STRENGTH_STEPS), int(strength > 0)) / STRENGTH_STEPS


def despeckled(image: Image, strength: float = 1.0) -> Image:
    """Return the image with the share `strength` of its estimated speckle removed.

    Args:
        image: Shape (height_px, width_px), uint8.
        strength: 0 returns the image unchanged, 1 the estimate of the scene.

    Raises:
        ConfigError: As `check_strength`.
    """
    strength = check_strength(strength)
    if strength == 0:
        return image
    correction = _correction(image.tobytes(), image.shape)
    return np.clip(np.rint(image + strength * correction), 0, 255).astype(np.uint8)


@lru_cache(maxsize=1)  # an image is often encoded and then extended
def _correction(pixels: bytes, shape: tuple[int, int]) -> Floats:
    """Return the estimated scene minus the image, in grey levels."""
    height, width = shape
    image = np.frombuffer(pixels, np.uint8).reshape(shape)
    padded = np.pad(image, ((0, -height % _BLOCK_PX), (0, -width % _BLOCK_PX)), mode="edge")
    mean = round(float(padded.mean(dtype=np.float64)))
    first, second, down, *pairs, up, third, fourth, last = network()
    half = first.rectified(first(_blocks(padded[:, :, None].astype(np.int32) - mean)))
    half = second.rectified(second(half))
    quarter, scale = down.integers(down(_blocks(half))), down.activation_scale
    for inner, outer in zip(pairs[::2], pairs[1::2], strict=True):
        hidden = inner.rectified(inner(quarter))
        quarter, scale = outer.integers(outer(hidden) + quarter * scale), outer.activation_scale
    half = up.rectified(_pixels(up(quarter)) + half * second.activation_scale)
    half = third.rectified(np.maximum(third(half), 0) + half * up.activation_scale)
    half = fourth.rectified(fourth(half))
    return _pixels(last(half))[:height, :width, 0]


def _blocks(cells: I32) -> I32:
    """Combine blocks of 2 x 2 cells into one with four times the channels."""
    rows, columns, channels = cells.shape
    split = cells.reshape(rows // 2, 2, columns // 2, 2, channels).transpose(0, 2, 1, 3, 4)
    return split.reshape(rows // 2, columns // 2, 4 * channels)


def _pixels(cells: Floats) -> Floats:
    """Split cells into blocks of 2 x 2 with a quarter of the channels: the reverse of `_blocks`."""
    rows, columns, channels = cells.shape
    split = cells.reshape(rows, columns, 2, 2, channels // 4).transpose(0, 2, 1, 3, 4)
    return split.reshape(2 * rows, 2 * columns, channels // 4)
