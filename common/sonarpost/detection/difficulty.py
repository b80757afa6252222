"""Difficulty of a seabed for the detector: clutter, ripples, contrast, and the expected probability of detection.

A search without contacts means little on rock: the detector finds few of the mines there. The features are measured on
one side of a strip. A logistic model turns them and the confidence threshold into the expected probability of detection
(Pd) of a mine-like object at a random place of that seabed:

    log odds = offset(threshold)
               - clutter_weight * ln(1 + clutter) - contrast_weight * contrast - ripple_weight * ripples

No weight is negative and the offsets do not increase with the threshold. The expected Pd therefore never increases with
a feature or with the threshold. `difficulty.json` is fitted to simulated surveys only
(`research/detection/difficulty.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Final

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel
from scipy import ndimage

from sonarpost.detection.normalisation import LevelGrid

RELIABLE_PD: Final = 0.8
"""Below this expected Pd a result without contacts does not mean that there are no mines."""
CLUTTER_RESPONSE: Final = 3.5
"""Matched-filter response, in local noise units, above which a local maximum is a clutter echo."""

_MIN_AREA_M2: Final = 100.0
_BLOCK_M: Final = 0.2
"""Blocks of this size, averaged, are the smoothed levels."""
_TILE_M: Final = 6.4
_MIN_TILE_BLOCKS: Final = 8
_MIN_KNOWN: Final = 0.9
"""Share of known blocks of a tile whose spectrum is used."""
_RIPPLE_WAVELENGTH_M: Final = (0.4, 2.0)

_Blocks = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Difficulty:
    """Difficulty of an area of seabed.

    Attributes:
        area_m2: Area of known seabed, in slant range.
        clutter_per_1000_m2: Number of clutter echoes per 1000 m² of that area. True objects count as well.
        ripple_strength: Share of the variance of the smoothed levels in the dominant spatial period of 0.4 to 2 m, 0
            to 1; about 0.1 on a seabed without ripples.
        contrast: Standard deviation of the smoothed levels, in octaves of the echo.
        expected_pd: Expected probability of detection of a mine-like object at the confidence threshold, 0 to 1.
    """

    area_m2: float
    clutter_per_1000_m2: float
    ripple_strength: float
    contrast: float
    expected_pd: float

    @property
    def is_reliable(self) -> bool:
        """Whether a result without contacts has a meaning: the expected Pd is at least `RELIABLE_PD`."""
        return self.expected_pd >= RELIABLE_PD


class PdModel(BaseModel):
    """Parameters of the expected probability of detection.

    Attributes:
        thresholds: Confidence thresholds of `offsets`, increasing, 0 to 2.
        offsets: Log odds on a seabed without clutter, ripples and contrast, one for each threshold; not increasing.
            Between two thresholds they are interpolated, beyond the first and the last they are constant.
        clutter_weight: Weight of ln(1 + clutter echoes per 1000 m²), 0 or more.
        contrast_weight: Weight of the contrast, 0 or more.
        ripple_weight: Weight of the ripple strength, 0 or more.
    """

    thresholds: list[float]
    offsets: list[float]
    clutter_weight: float
    contrast_weight: float
    ripple_weight: float

    def expected_pd(
        self, clutter_per_1000_m2: float, ripple_strength: float, contrast: float, threshold: float
    ) -> float:
        """Return the expected probability of detection, 0 to 1.

        Args:
            clutter_per_1000_m2: 0 or more.
            ripple_strength: 0 to 1.
            contrast: Octaves, 0 or more.
            threshold: Confidence threshold, 0 to 2.
        """
        odds = float(np.interp(threshold, self.thresholds, self.offsets))
        odds -= self.clutter_weight * math.log1p(clutter_per_1000_m2)
        odds -= self.contrast_weight * contrast + self.ripple_weight * ripple_strength
        return 1.0 / (1.0 + math.exp(-odds)) if odds > 0 else math.exp(odds) / (1.0 + math.exp(odds))


@cache
def default_pd_model() -> PdModel:
    """Return the model of `difficulty.json`."""
    return PdModel.model_validate_json(files("sonarpost.detection").joinpath("difficulty.json").read_bytes())


def seabed_difficulty(grid: LevelGrid, matched: Sequence[float], threshold: float) -> Difficulty | None:
    """Return the difficulty of one side of a strip.

    Args:
        grid: The side.
        matched: Response of the matched filter at its local maxima there, in local noise units. Those below
            `CLUTTER_RESPONSE` may be absent.
        threshold: Confidence threshold of the search, 0 to 2.

    Returns:
        None if less than 100 m² of seabed is known, or no tile of 6.4 m for the ripple strength.
    """
    area_m2 = float(np.isfinite(grid.level).sum()) * grid.row_along_m * grid.cell_across_m
    if area_m2 < _MIN_AREA_M2:
        return None
    size = (max(1, round(_BLOCK_M / grid.row_along_m)), max(1, round(_BLOCK_M / grid.cell_across_m)))
    blocks = _block_means(grid, size)
    ripples = _ripple_strength(blocks, (size[0] * grid.row_along_m, size[1] * grid.cell_across_m))
    if ripples is None:
        return None
    clutter = 1000.0 * sum(score >= CLUTTER_RESPONSE for score in matched) / area_m2
    contrast = float(np.nanstd(blocks))
    expected_pd = default_pd_model().expected_pd(clutter, ripples, contrast, threshold)
    return Difficulty(area_m2, clutter, ripples, contrast, expected_pd)


def combined(difficulties: Iterable[Difficulty | None]) -> Difficulty | None:
    """Return the mean weighted by area, with the total area; None if all are None.

    The expected Pd is then that of an object at a random place of the whole area.
    """
    known = [d for d in difficulties if d is not None]
    if not known:
        return None
    weights = np.array([d.area_m2 for d in known])
    rows = np.array([[d.clutter_per_1000_m2, d.ripple_strength, d.contrast, d.expected_pd] for d in known])
    return Difficulty(float(weights.sum()), *(weights @ rows / weights.sum()).tolist())


def unreliable_text(expected_pd: float) -> str:
    """Return the warning about an expected probability of detection below `RELIABLE_PD`.

    >>> unreliable_text(0.62)
    'expected Pd 62 % on this seabed; a clean result does not mean no mines'
    """
    return f"expected Pd {100 * expected_pd:.0f} % on this seabed; a clean result does not mean no mines"


def _block_means(grid: LevelGrid, size: tuple[int, int]) -> _Blocks:
    """Return the mean level of blocks of `size` cells, NaN if half of the cells or fewer are known."""
    rows, cells = grid.level.shape[0] // size[0], grid.level.shape[1] // size[1]
    cut = grid.level[: rows * size[0], : cells * size[1]].reshape(rows, size[0], cells, size[1])
    known = np.isfinite(cut)
    count = known.sum(axis=(1, 3))
    total = np.where(known, cut, np.float32(0.0)).sum(axis=(1, 3), dtype=np.float64)
    means = np.full(count.shape, np.nan)
    np.divide(total, count, out=means, where=2 * count > size[0] * size[1])
    return means


def _ripple_strength(blocks: _Blocks, block_m: tuple[float, float]) -> float | None:
    """Return the share of the power of the smoothed levels in the dominant spatial period, 0 to 1.

    The power spectra of tiles (Hann window) are normalised to the power at wavelengths above 0.4 m and averaged. The
    dominant period is that with the greatest power within one frequency step, at wavelengths of 0.4 to 2 m.

    Args:
        blocks: Smoothed levels, NaN where unknown.
        block_m: Size of a block, along and across.

    Returns:
        None without a tile of which nine tenths are known.
    """
    shape = tuple(max(_MIN_TILE_BLOCKS, round(_TILE_M / metres)) for metres in block_m)
    count = (blocks.shape[0] // shape[0], blocks.shape[1] // shape[1])
    cut = blocks[: count[0] * shape[0], : count[1] * shape[1]].reshape(count[0], shape[0], count[1], shape[1])
    tiles = cut.swapaxes(1, 2).reshape(-1, *shape)
    known = np.isfinite(tiles)
    enough = known.mean(axis=(1, 2)) >= _MIN_KNOWN
    if not enough.any():
        return None
    tiles, known = tiles[enough], known[enough]
    window = np.hanning(shape[0] + 2)[1:-1, None] * np.hanning(shape[1] + 2)[None, 1:-1] * known
    level = np.where(known, tiles, 0.0)
    mean = (level * window).sum(axis=(1, 2)) / window.sum(axis=(1, 2))
    power = np.abs(np.fft.fft2((level - mean[:, None, None]) * window)) ** 2
    along, across = (np.fft.fftfreq(n, metres) for n, metres in zip(shape, block_m, strict=True))
    frequency = np.hypot(along[:, None], across[None, :])
    shortest_m, longest_m = _RIPPLE_WAVELENGTH_M
    smoothed = (frequency > 0) & (frequency <= 1 / shortest_m)
    total = power[:, smoothed].sum(axis=1)
    share = (power / np.where(total > 0, total, np.inf)[:, None, None]).mean(axis=0) * smoothed
    around = 9 * ndimage.uniform_filter(share, size=3, mode="wrap")
    peaks = around[smoothed & (frequency >= 1 / longest_m)]
    # A real image has each period twice: at a frequency and at its negative.
    return min(max(2 * float(peaks.max()), 0.0), 1.0) if peaks.size else 0.0
