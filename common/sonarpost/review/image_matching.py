"""Place of a contact's image within an image of more seabed around it."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import fft

EXPAND_FACTOR: Final = 2
"""Ratio of the pixel sizes."""
MIN_CORRELATION: Final = 0.4
"""Normalised cross-correlation below which the place counts as unknown."""

GreyImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


def place_in_expanded(image: GreyImage, expanded: GreyImage) -> tuple[int, int] | None:
    """Return (row, column) of the upper left corner of an image in the expanded image, None if it is not found.

    Both windows are shifted at the borders of a recording, so that their centres can differ. The place is the maximum
    of the normalised cross-correlation.

    Args:
        image: Shape (height_px, width_px).
        expanded: Any shape of at least half of these sides, with pixels of twice the size.
    """
    rows, columns = image.shape[0] // EXPAND_FACTOR, image.shape[1] // EXPAND_FACTOR
    if rows < 1 or columns < 1 or rows > expanded.shape[0] or columns > expanded.shape[1]:
        return None
    cut = image[: rows * EXPAND_FACTOR, : columns * EXPAND_FACTOR].astype(np.float64)
    template = cut.reshape(rows, EXPAND_FACTOR, columns, EXPAND_FACTOR).mean(axis=(1, 3))
    template -= template.mean()
    scene = expanded.astype(np.float64)
    scene -= scene.mean()
    window = np.ones_like(template)
    sums = _convolve_valid(scene, window)
    squares = _convolve_valid(scene**2, window)
    power = np.maximum(squares - sums**2 / template.size, 0.0) * float((template**2).sum())
    products = _convolve_valid(scene, template[::-1, ::-1])
    correlation = products / np.sqrt(np.maximum(power, 1e-9 * max(1.0, float(power.max()))))
    best = int(np.argmax(correlation))
    if correlation.flat[best] < MIN_CORRELATION:
        return None
    row, column = divmod(best, correlation.shape[1])
    return row, column


def _convolve_valid(scene: npt.NDArray[np.float64], kernel: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the convolution where the kernel lies inside the scene; without scipy.signal, which is large."""
    full = [rows + kernel_rows - 1 for rows, kernel_rows in zip(scene.shape, kernel.shape, strict=True)]
    shape = [fft.next_fast_len(size, real=True) for size in full]
    product = fft.irfft2(fft.rfft2(scene, shape) * fft.rfft2(kernel, shape), shape)
    rows, columns = scene.shape
    valid: npt.NDArray[np.float64] = product[kernel.shape[0] - 1 : rows, kernel.shape[1] - 1 : columns]
    return valid
