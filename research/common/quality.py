"""Image quality: PSNR, SSIM and MS-SSIM."""

import math
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sonarpost.codec.interface import Image
from sonarpost.errors import StreamError

PEAK: Final = 255.0
SSIM_SIGMA_PX: Final = 1.5
SSIM_RADIUS_PX: Final = 5  # an 11 x 11 window
MS_SSIM_WEIGHTS: Final = (0.0448, 0.2856, 0.3001)
"""The first three of the five weights of Wang et al., finest scale first."""
MIN_SIMILARITY: Final = 1e-6
"""Lower limit of the similarity of a scale."""

_Floats = npt.NDArray[np.float64]


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


def ms_ssim(original: Image, decoded: Image) -> float:
    """Return the multi-scale structural similarity over three scales, 0..1, 1 for equal images.

    Wang, Simoncelli, Bovik, "Multiscale structural similarity for image quality assessment", Asilomar 2003, with three
    scales instead of five (a snippet of 80 px is too small for five) and their weights scaled to a sum of 1:

        product over scales s of max(mean of contrast-structure_s, 1e-6) ** weight_s,

    the coarsest scale with its luminance term. Windows and constants are those of SSIM, but the image is mirrored at
    its edges, so every pixel counts. From one scale to the next 2 x 2 px are averaged; an odd last row or column is
    omitted.

    Args:
        original: Shape (height, width), both at least 4, uint8.
        decoded: The same shape, uint8.

    Raises:
        StreamError: The shapes differ, a side is shorter than 4 px, or a dtype is not uint8.
    """
    if original.ndim != 2 or min(original.shape) < 4:
        raise StreamError("MS-SSIM", "original.shape", original.shape, "at least 4 px a side for three scales")
    if decoded.shape != original.shape:
        raise StreamError("MS-SSIM", "decoded.shape", decoded.shape, f"the original's {original.shape}")
    if not original.dtype == decoded.dtype == np.uint8:
        raise StreamError("MS-SSIM", "dtype", f"{original.dtype}, {decoded.dtype}", "uint8")
    a, b = original.astype(np.float64), decoded.astype(np.float64)
    result = 1.0
    for scale, weight in enumerate(MS_SSIM_WEIGHTS):
        luminance, contrast_structure = _similarity_terms(a, b)
        is_coarsest = scale == len(MS_SSIM_WEIGHTS) - 1
        similarity = np.mean(luminance * contrast_structure) if is_coarsest else np.mean(contrast_structure)
        result *= max(float(similarity), MIN_SIMILARITY) ** (weight / sum(MS_SSIM_WEIGHTS))
        a, b = _half_resolution(a), _half_resolution(b)
    return result


def _similarity_terms(a: _Floats, b: _Floats) -> tuple[_Floats, _Floats]:
    """Return the luminance term and the contrast-structure term of SSIM at every pixel, mirrored at the edges."""

    def mean(values: _Floats) -> _Floats:
        smooth = ndimage.gaussian_filter(values, SSIM_SIGMA_PX, radius=SSIM_RADIUS_PX, mode="reflect")
        return np.asarray(smooth, dtype=np.float64)

    c1, c2 = (0.01 * PEAK) ** 2, (0.03 * PEAK) ** 2
    mean_a, mean_b = mean(a), mean(b)
    variances = mean(a * a) - mean_a * mean_a + mean(b * b) - mean_b * mean_b
    covariance = mean(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + c1) / (mean_a * mean_a + mean_b * mean_b + c1)
    return luminance, (2 * covariance + c2) / (variances + c2)


def _half_resolution(values: _Floats) -> _Floats:
    rows, columns = values.shape[0] // 2, values.shape[1] // 2
    blocks = values[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2)
    return np.asarray(blocks.mean(axis=(1, 3)), dtype=np.float64)
