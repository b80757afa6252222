"""How like two pictures are, in integers: what the encoder of a model with an aim chooses its start step by.

Wang, Simoncelli, Bovik, "Multiscale structural similarity for image quality assessment" (2003), at half and a quarter
of the size, which have nearly all of the weight; with a binomial window in place of the Gaussian one. Integers, so
that every machine writes the same stream.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb._jit import jit

I64 = npt.NDArray[np.int64]

_FIRST: Final = 426148  # (0.01 * 255)^2 and (0.03 * 255)^2, times 2^16
_SECOND: Final = 3835331


@jit
def _blurred(plane: I64) -> I64:
    """Binomial window of 9 taps each way, standard deviation 1.4, 65536 times as large; edges repeat."""
    taps = (1, 8, 28, 56, 70, 56, 28, 8, 1)
    height, width = plane.shape
    across, out = np.zeros_like(plane), np.zeros_like(plane)
    for y in range(height):
        for x in range(width):
            for k in range(9):
                across[y, x] += taps[k] * plane[y, min(max(x + k - 4, 0), width - 1)]
    for y in range(height):
        for k in range(9):
            line = min(max(y + k - 4, 0), height - 1)
            for x in range(width):
                out[y, x] += taps[k] * across[line, x]
    return out


@jit
def _halved_sums(plane: I64) -> I64:
    height, width = plane.shape[0] // 2, plane.shape[1] // 2
    out = np.zeros((height, width), np.int64)
    for y in range(height):
        for x in range(width):
            out[y, x] = (
                plane[2 * y, 2 * x] + plane[2 * y, 2 * x + 1] + plane[2 * y + 1, 2 * x] + plane[2 * y + 1, 2 * x + 1]
            )
    return out


@jit
def _similar(a: I64, b: I64, unit: int, whole: int) -> int:
    """Mean structural similarity, times 2^14, of pictures in 1/`unit` grey; its luminance term too if `whole` is 1."""
    mean_a, mean_b = _blurred(a), _blurred(b)
    square, product = _blurred(a * a + b * b), _blurred(a * b)
    # In the units of a squared mean (weights of 2^16, see below) and of 2^32 times a variance.
    first = (np.int64(_FIRST) * unit * unit) >> 2
    second = (np.int64(_SECOND) * unit * unit) << 16
    total = np.int64(0)
    for y in range(a.shape[0]):
        for x in range(a.shape[1]):
            p, q = mean_a[y, x], mean_b[y, x]
            spread = (square[y, x] << 16) - p * p - q * q
            common = 2 * ((product[y, x] << 16) - p * q)
            like = (common + second) // (((spread + second) >> 14) + 1)
            if whole == 1:
                p, q = p >> 9, q >> 9
                like = like * ((2 * p * q + first) // (((p * p + q * q + first) >> 14) + 1)) >> 14
            total += like
    return int(total // (a.shape[0] * a.shape[1]))


def structural_similarity(picture: I64, shown: I64) -> int:
    """Return how like two pictures are at half and a quarter of their size, about as MS-SSIM weighs it.

    Args:
        picture: Shape (height_px, width_px), int64, grey 0..255.
        shown: The same shape.
    """
    a, b = _halved_sums(picture), _halved_sums(shown)
    half = int(_similar(a, b, 4, 0))
    a, b = _halved_sums(a), _halved_sums(b)
    return max(half, 1) * max(int(_similar(a, b, 16, 1)), 1)
