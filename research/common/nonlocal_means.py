"""Non-local means: Buades, Coll, Morel, "A non-local algorithm for image denoising", CVPR 2005.

`reference_filtered` is the fixed reference for recordings, of which no speckle-free scene exists. The encoder of `emb`
does not use it.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sonarpost.codec.interface import Image

Values = npt.NDArray[np.float64]

REFERENCE_SEARCH_PX: Final = 6
REFERENCE_PATCH_PX: Final = 2
REFERENCE_STRENGTH: Final = 1.0
_HIGH_PASS_TO_SIGMA: Final = 1.4826 * 1.2
"""Noise from the median absolute deviation of an image minus its 3 x 3 median, which contains some of the noise."""


def reference_filtered(image: Image) -> Image:
    """Return an image filtered with non-local means in the square-root domain, with fixed parameters.

    Patches of 5 x 5 px, search within 6 px, strength 1.

    Args:
        image: Shape (height, width), uint8.

    Returns:
        Same shape, uint8.
    """
    root = np.sqrt(image.astype(np.float64))
    filtered = nonlocal_means(root, REFERENCE_STRENGTH, REFERENCE_PATCH_PX, REFERENCE_SEARCH_PX)
    return np.asarray(np.clip(np.rint(filtered**2), 0, 255), dtype=np.uint8)


def noise_sigma(values: Values) -> float:
    """Return a robust estimate of the standard deviation of white additive noise in an image."""
    high_pass = values - ndimage.median_filter(values, 3, mode="reflect")
    return _HIGH_PASS_TO_SIGMA * float(np.median(np.abs(high_pass))) + 1e-6


def nonlocal_means(values: Values, strength: float, patch_px: int, search_px: int) -> Values:
    """Return the non-local means of an image with additive noise.

    Each pixel becomes the mean of the pixels within `search_px` rows and columns. The weight of a pixel is
    exp(-max(d - 2 sigma^2, 0) / (strength sigma)^2), where d is the mean squared difference of the two patches.

    Args:
        values: Shape (height, width), float64.
        strength: Width of the weights in standard deviations of the noise, above 0.
        patch_px: Patches have 2 patch_px + 1 pixels a side.
        search_px: Maximum distance in rows and in columns.

    Returns:
        Same shape, float64.
    """
    sigma = noise_sigma(values)
    padded = np.pad(values, search_px, mode="symmetric")
    height, width = values.shape
    total, weights = np.zeros_like(values), np.zeros_like(values)
    for down in range(2 * search_px + 1):
        for right in range(2 * search_px + 1):
            shifted = padded[down : down + height, right : right + width]
            distance = ndimage.uniform_filter((values - shifted) ** 2, 2 * patch_px + 1, mode="reflect")
            weight = np.exp(-np.maximum(distance - 2 * sigma**2, 0.0) / (strength * sigma) ** 2)
            total += weight * shifted
            weights += weight
    return np.asarray(total / weights)
