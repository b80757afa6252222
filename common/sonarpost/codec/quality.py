"""Image quality: PSNR and SSIM."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sonarpost.codec.interface import Image
from sonarpost.errors import StreamError

PEAK = 255.0
SSIM_SIGMA_PX = 1.5
SSIM_RADIUS_PX = 5  # an 11 x 11 window


def psnr_db(original: Image, decoded: Image) -> float:
    """Return the peak signal-to-noise ratio in dB for a peak of 255; infinite for equal images.

    PSNR = 10 log10(255^2 / mean((original - decoded)^2)). Both images: shape (height, width), uint8.

    Raises:
        StreamError: The shapes differ, an image is empty, or a dtype is not uint8.
    """
    _check_pair(original, decoded)
    error = original.astype(np.float64) - decoded.astype(np.float64)
    mean_square = float(np.mean(error * error))
    return math.inf if mean_square == 0.0 else 10.0 * math.log10(PEAK * PEAK / mean_square)


def ssim(original: Image, decoded: Image) -> float:
    """Return the mean structural similarity, -1..1, 1 for equal images.

    Wang, Bovik, Sheikh, Simoncelli, "Image quality assessment: from error visibility to structural similarity", IEEE
    Trans. Image Processing 13(4), 2004: Gaussian window 11 x 11 with sigma 1.5 px, K1 = 0.01, K2 = 0.03, L = 255,
    population (co)variances. As there, only places with the whole window inside the image count. A side shorter than 11
    px is mirrored at its edges, and all of it counts. Both images: shape (height, width), uint8.

    Raises:
        StreamError: The shapes differ, an image is empty, or a dtype is not uint8.
    """
    _check_pair(original, decoded)
    a, b = original.astype(np.float64), decoded.astype(np.float64)
    c1, c2 = (0.01 * PEAK) ** 2, (0.03 * PEAK) ** 2
    mean_a, mean_b = _window_mean(a), _window_mean(b)
    variance_a = _window_mean(a * a) - mean_a * mean_a
    variance_b = _window_mean(b * b) - mean_b * mean_b
    covariance = _window_mean(a * b) - mean_a * mean_b
    numerator = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    denominator = (mean_a * mean_a + mean_b * mean_b + c1) * (variance_a + variance_b + c2)
    return float(np.mean(numerator / denominator))


def _window_mean(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the Gaussian-weighted mean around each place with the whole window inside."""
    for axis in (0, 1):
        values = np.asarray(
            ndimage.gaussian_filter1d(values, SSIM_SIGMA_PX, axis=axis, radius=SSIM_RADIUS_PX, mode="reflect"),
            dtype=np.float64,
        )
        if values.shape[axis] > 2 * SSIM_RADIUS_PX:
            values = np.take(values, np.arange(SSIM_RADIUS_PX, values.shape[axis] - SSIM_RADIUS_PX), axis=axis)
    return values


def _check_pair(original: Image, decoded: Image) -> None:
    if original.ndim != 2 or original.size == 0:
        raise StreamError("image quality", "original.shape", original.shape, "(height, width), not empty")
    if original.shape != decoded.shape:
        raise StreamError("image quality", "decoded.shape", decoded.shape, f"the original's {original.shape}")
    for name, image in (("original", original), ("decoded", decoded)):
        if image.dtype != np.uint8:
            raise StreamError("image quality", f"{name}.dtype", str(image.dtype), "uint8")
