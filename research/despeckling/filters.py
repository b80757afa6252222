"""Classical speckle filters, to compare with: each maps an 8-bit image of amplitudes to its estimate without speckle.

- `nlm`: non-local means of the logarithm (Buades, Coll, Morel, CVPR 2005).
- `collaborative`: block matching with collaborative filtering of the logarithm, the two steps of BM3D (Dabov et al.,
  "Image denoising by sparse 3-D transform-domain collaborative filtering", IEEE TIP 2007); SAR-BM3D (Parrilli et al.,
  IEEE TGRS 2012) has the same structure.
- `ppb`: iterative probabilistic patch-based weights (Deledalle, Denis, Tupin, IEEE TIP 2009).
- `guided`: self-guided filter of the logarithm (He, Sun, Tang, IEEE TPAMI 2013).
- `lee`: local linear minimum mean-square error of the intensity (Lee, IEEE TPAMI 1980).

All are deterministic. The parameters are constants, chosen for the PSNR on the first 6 to 12 pairs of `speckle_pairs`
with seed 9, which no published figure uses. The mean of a logarithm is below the logarithm of the mean, so the filters
of the logarithm scale their result to the mean intensity of the input.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import fft, ndimage

from research.common.nonlocal_means import noise_sigma, nonlocal_means
from sonarpost.codec.interface import Image

Values = npt.NDArray[np.float64]
SpeckleFilter = Callable[[Image], Image]

LOOKS: Final = 2.0
"""Equivalent number of looks of the intensity: a standard deviation of the amplitude of 0.36 of the mean."""
LOG_OFFSET: Final = 4.0
"""Added to the grey levels before the logarithm: shadows have additive noise of a few grey levels."""
NLM_STRENGTH: Final = 1.3
NLM_PATCH_PX: Final = 1
NLM_SEARCH_PX: Final = 6
GUIDED_RADIUS_PX: Final = 1
GUIDED_SIGMAS: Final = 3.0
LEE_PX: Final = 5
PPB_ITERATIONS: Final = 3
PPB_PATCH_PX: Final = 1
PPB_SEARCH_PX: Final = 5
PPB_WIDTH: Final = 2.0
"""Width of the weights of the noisy image, in the mean difference of two patches of the same intensity."""
PPB_TRUST: Final = 1.0
"""Width of the weights of the previous estimate, in its symmetric Kullback-Leibler divergence."""
BLOCK_PX: Final = 8
BLOCK_STEP_PX: Final = 3
BLOCK_SEARCH_PX: Final = 9
GROUP: Final = 16
HARD_THRESHOLD: Final = 2.7
SIGMA_FACTOR: Final = 1.6
"""Speckle is correlated between neighbouring samples: in blocks its noise exceeds the estimate for white noise."""


def _as_image(amplitude: Values) -> Image:
    return np.asarray(np.clip(np.rint(amplitude), 0, 255), dtype=np.uint8)


def _filtered_logarithm(image: Image, work: Callable[[Values], Values]) -> Image:
    """Filter the logarithm of an image; scale the result to the mean intensity of the image."""
    grey = image.astype(np.float64)
    filtered = np.maximum(np.exp(work(np.log(grey + LOG_OFFSET))) - LOG_OFFSET, 0.0)
    power = float((filtered**2).mean())
    return _as_image(filtered * np.sqrt((grey**2).mean() / power) if power > 0 else filtered)


def nlm(image: Image) -> Image:
    """Return the non-local means of the logarithm.

    Args:
        image: Shape (height, width), uint8, as for every filter of this module.

    Returns:
        Same shape, uint8.
    """
    return _filtered_logarithm(image, lambda log: nonlocal_means(log, NLM_STRENGTH, NLM_PATCH_PX, NLM_SEARCH_PX))


def guided(image: Image) -> Image:
    """Return the self-guided filter of the logarithm."""

    def work(log: Values) -> Values:
        size = 2 * GUIDED_RADIUS_PX + 1
        mean = ndimage.uniform_filter(log, size, mode="reflect")
        variance = np.maximum(ndimage.uniform_filter(log**2, size, mode="reflect") - mean**2, 0.0)
        slope = variance / (variance + (GUIDED_SIGMAS * noise_sigma(log)) ** 2)
        offset = (1.0 - slope) * mean
        smooth_slope = ndimage.uniform_filter(slope, size, mode="reflect")
        return np.asarray(smooth_slope * log + ndimage.uniform_filter(offset, size, mode="reflect"))

    return _filtered_logarithm(image, work)


def lee(image: Image) -> Image:
    """Return the Lee filter of the intensity."""
    intensity = image.astype(np.float64) ** 2
    mean = ndimage.uniform_filter(intensity, LEE_PX, mode="reflect")
    variance = np.maximum(ndimage.uniform_filter(intensity**2, LEE_PX, mode="reflect") - mean**2, 0.0)
    # Variance of the scene: that of the image is mean^2 / L + (1 + 1 / L) * variance of the scene.
    scene = np.maximum((variance - mean**2 / LOOKS) / (1.0 + 1.0 / LOOKS), 0.0)
    gain = np.divide(scene, variance, out=np.zeros_like(variance), where=variance > 0)
    # Running sums of zeros may be negative by rounding.
    return _as_image(np.sqrt(np.maximum(mean + gain * (intensity - mean), 0.0)))


def ppb(image: Image) -> Image:
    """Return the estimate of iterative probabilistic patch-based weights.

    The distance of two pixels of amplitudes a and b is log((a / b + b / a) / 2); that of two estimates R and S of the
    intensity is (R - S)^2 / (R S). Both are averaged over patches.
    """
    amplitude = np.maximum(image.astype(np.float64), 1.0)
    height, width = amplitude.shape
    size, search = 2 * PPB_PATCH_PX + 1, PPB_SEARCH_PX
    estimate: Values | None = None
    for _ in range(PPB_ITERATIONS):
        padded = np.pad(amplitude, search, mode="symmetric")
        padded_estimate = None if estimate is None else np.pad(estimate, search, mode="symmetric")
        total, weights = np.zeros_like(amplitude), np.zeros_like(amplitude)
        for down in range(2 * search + 1):
            for right in range(2 * search + 1):
                window = (slice(down, down + height), slice(right, right + width))
                other = padded[window]
                distance = np.log((amplitude / other + other / amplitude) / 2.0) / (PPB_WIDTH / LOOKS)
                if estimate is not None and padded_estimate is not None:
                    previous = padded_estimate[window]
                    distance += LOOKS * (estimate - previous) ** 2 / (estimate * previous) / PPB_TRUST
                weight = np.exp(-ndimage.uniform_filter(distance, size, mode="reflect") * size)
                total += weight * other**2
                weights += weight
        estimate = total / weights
    assert estimate is not None
    return _as_image(np.sqrt(estimate))


def collaborative(image: Image) -> Image:
    """Return the estimate of block matching with collaborative filtering of the logarithm."""

    def work(log: Values) -> Values:
        sigma = SIGMA_FACTOR * noise_sigma(log)
        first = _collaborative_step(log, log, sigma, wiener=False)
        return _collaborative_step(log, first, sigma, wiener=True)

    return _filtered_logarithm(image, work)


def _collaborative_step(noisy: Values, guide: Values, sigma: float, *, wiener: bool) -> Values:
    """Group similar blocks of `guide`, filter the groups of `noisy` in a 3-D cosine transform, and average the blocks.

    Args:
        noisy: Shape (height, width), both at least `BLOCK_PX`.
        guide: Same shape; an earlier estimate for the Wiener step.
        sigma: Standard deviation of the noise.
        wiener: Whether coefficients are scaled by the power of those of `guide`, instead of a hard threshold.
    """
    height, width = noisy.shape
    down, right = height - BLOCK_PX + 1, width - BLOCK_PX + 1
    blocks = np.lib.stride_tricks.sliding_window_view(noisy, (BLOCK_PX, BLOCK_PX)).reshape(-1, BLOCK_PX, BLOCK_PX)
    guides = np.lib.stride_tricks.sliding_window_view(guide, (BLOCK_PX, BLOCK_PX)).reshape(-1, BLOCK_PX, BLOCK_PX)
    transformed = fft.dctn(blocks, axes=(1, 2), norm="ortho")
    guide_transformed = fft.dctn(guides, axes=(1, 2), norm="ortho")
    matched = guide_transformed.reshape(-1, BLOCK_PX**2)
    if not wiener:
        matched = np.where(np.abs(matched) > sigma, matched, 0.0)
    total, weights = np.zeros_like(noisy), np.zeros_like(noisy)
    rows = np.unique(np.append(np.arange(0, down, BLOCK_STEP_PX), down - 1))
    columns = np.unique(np.append(np.arange(0, right, BLOCK_STEP_PX), right - 1))
    for row in rows:
        for column in columns:
            near_rows = np.arange(max(row - BLOCK_SEARCH_PX, 0), min(row + BLOCK_SEARCH_PX + 1, down))
            near_columns = np.arange(max(column - BLOCK_SEARCH_PX, 0), min(column + BLOCK_SEARCH_PX + 1, right))
            candidates = (near_rows[:, None] * right + near_columns[None, :]).ravel()
            block = row * right + column
            distance = ((matched[candidates] - matched[block]) ** 2).sum(axis=1)
            distance[candidates == block] = -1.0  # the block itself is in its group, even if others are equal to it
            count = min(GROUP, candidates.size)
            group = candidates[np.argpartition(distance, count - 1)[:count]]
            spectrum = fft.dct(transformed[group], axis=0, norm="ortho")
            if wiener:
                power = fft.dct(guide_transformed[group], axis=0, norm="ortho") ** 2
                gain = power / (power + sigma**2)
                weight = 1.0 / max(float((gain**2).sum()), 1.0)
            else:
                gain = (np.abs(spectrum) > HARD_THRESHOLD * sigma).astype(np.float64)
                gain[0, 0, 0] = 1.0
                weight = 1.0 / max(float(gain.sum()), 1.0)
            filtered = fft.idctn(spectrum * gain, axes=(0, 1, 2), norm="ortho")
            for number, place in enumerate(group):
                top, left = divmod(int(place), right)
                window = (slice(top, top + BLOCK_PX), slice(left, left + BLOCK_PX))
                total[window] += weight * filtered[number]
                weights[window] += weight
    return np.asarray(total / weights)


FILTERS: Final[dict[str, SpeckleFilter]] = {
    "nlm": nlm,
    "collaborative": collaborative,
    "ppb": ppb,
    "guided": guided,
    "lee": lee,
}
"""Filters by name."""
