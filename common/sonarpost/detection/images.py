"""Detection in a single image without navigation, for example a decoded snippet or a tile of a data set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sonarpost.detection.candidates import classified_candidates
from sonarpost.detection.detector import classifier_of
from sonarpost.detection.matched_filter import matched_response
from sonarpost.detection.normalisation import LevelGrid, levels_of_ratio
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import FloatImage, Side

GreyImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

_CELL_M: Final = 0.06
_SEABED_WINDOW_M: Final = 4.0
"""Window of the local seabed level: more than twice the extent of a mine and its shadow."""
_WATER_SHARE: Final = 0.12
"""A window below this share of the usual level is water, the shadow of something large, or empty."""


@dataclass(frozen=True, slots=True)
class ScaledImage:
    """A side-scan image with its pixel size.

    Attributes:
        pixels: Shape (rows, columns), uint8 or uint16, echo strength; rows along-track.
        pixel_along_m: Distance between two rows.
        pixel_across_m: Slant range of a column.

    Raises:
        ValueError: `pixels` is not two-dimensional, or a pixel size is not positive.
    """

    pixels: GreyImage
    pixel_along_m: float
    pixel_across_m: float

    def __post_init__(self) -> None:
        if self.pixels.ndim != 2:
            raise ValueError(f"pixels: got shape {self.pixels.shape}, expected rows by columns")
        if not (self.pixel_along_m > 0 and self.pixel_across_m > 0):
            raise ValueError(f"pixel sizes: got {self.pixel_along_m}, {self.pixel_across_m} m, expected above 0")


@dataclass(frozen=True, slots=True)
class ImageDetection:
    """The most confident candidate of an image.

    Attributes:
        confidence: 0 to 2: twice the probability of a mine-like object.
        p_mine_like: That probability.
        side: Direction of the shadow: right (starboard) or left (port).
        row: Row of the centre of the highlight.
        column: Its column.
    """

    confidence: float
    p_mine_like: float
    side: Side
    row: int
    column: int


def detect_in_image(
    image: ScaledImage, settings: DetectorSettings | None = None, side: Side | None = None
) -> ImageDetection | None:
    """Return the most confident candidate of an image, or None if there is none.

    Args:
        image: The image with its pixel size.
        settings: None for the defaults. The confidence threshold is not applied.
        side: Direction of the shadows; None to search both.
    """
    settings = settings if settings is not None else DetectorSettings()
    found = [d for s in ((side,) if side is not None else tuple(Side)) for d in _detections(image, settings, s)]
    return max(found, key=lambda d: d.confidence, default=None)


def _detections(image: ScaledImage, settings: DetectorSettings, side: Side) -> list[ImageDetection]:
    grid = normalise_image(image, side)
    if grid is None:
        return []
    rows_per_cell = round(grid.row_along_m / image.pixel_along_m)
    last = image.pixels.shape[1] - 1
    found = []
    response = matched_response(grid, settings)
    for candidate in classified_candidates(response, grid, settings, classifier_of(settings)):
        peak = candidate.peak
        outward = min(peak.cell * grid.samples_per_cell + grid.samples_per_cell // 2, last)
        column = outward if side is Side.STARBOARD else last - outward
        row = min(peak.row * rows_per_cell + rows_per_cell // 2, image.pixels.shape[0] - 1)
        found.append(ImageDetection(candidate.confidence, candidate.p_mine_like, side, row, column))
    return found


def normalise_image(image: ScaledImage, side: Side) -> LevelGrid | None:
    """Return an image as a level grid, or None if it is too small or empty.

    The range is unknown, so the seabed level is the median around each place in place of the median at the same range.
    Borders of constant value (padding) and water are marked as unknown.

    Args:
        image: The image with its pixel size.
        side: Direction away from the vehicle: right (starboard) or left (port).
    """
    values = image.pixels.astype(np.float32)
    if side is Side.PORT:
        values = values[:, ::-1]
    values = _without_padding(values)
    rows = max(1, round(_CELL_M / image.pixel_along_m))
    columns = max(1, round(_CELL_M / image.pixel_across_m))
    cells = _block_means(values, rows, columns)
    if min(cells.shape) < 16 or not np.isfinite(cells).any():
        return None
    row_m, cell_m = image.pixel_along_m * rows, image.pixel_across_m * columns
    seabed = _seabed_level(cells, row_m, cell_m)
    if seabed is None:
        return None
    floor = 0.02 * float(np.nanmedian(seabed))
    ratio = ((cells + floor) / (seabed + floor)).astype(np.float32)
    none = np.zeros(cells.shape[0], dtype=np.int64)
    return LevelGrid(side, levels_of_ratio(ratio), none, none, columns, cell_m, row_m, row_is_measured=True)


def _without_padding(values: FloatImage) -> FloatImage:
    """Set border rows and columns of constant value to NaN."""
    out = values.copy()
    for view in (out, out[::-1], out.T, out.T[::-1]):
        for line in view:
            known = line[np.isfinite(line)]
            if known.size and known.max() - known.min() > 2.0:
                break
            line[:] = np.nan
    return out


def _block_means(values: FloatImage, rows: int, columns: int) -> FloatImage:
    height, width = values.shape[0] // rows, values.shape[1] // columns
    blocks = values[: height * rows, : width * columns].reshape(height, rows, width, columns)
    means: FloatImage = blocks.mean(axis=(1, 3), dtype=np.float32)
    return means


def _seabed_level(cells: FloatImage, row_m: float, cell_m: float) -> FloatImage | None:
    """Return the median level around every cell; NaN where it is too low for seabed, None for an empty image."""
    step = (max(1, round(0.25 / row_m)), max(1, round(0.25 / cell_m)))
    coarse = cells[:: step[0], :: step[1]]
    known = np.isfinite(coarse)
    if not known.any():
        return None
    filled = np.where(known, coarse, np.median(coarse[known])).astype(np.float32)
    size = (max(3, round(_SEABED_WINDOW_M / row_m / step[0])), max(3, round(_SEABED_WINDOW_M / cell_m / step[1])))
    medians = ndimage.median_filter(filled, size=size, mode="reflect")
    usual = float(np.percentile(medians, 75))
    if usual <= 0:
        return None
    repeated = np.repeat(np.repeat(medians, step[0], axis=0), step[1], axis=1)[: cells.shape[0], : cells.shape[1]]
    smooth: FloatImage = ndimage.uniform_filter(repeated, size=(2 * step[0] + 1, 2 * step[1] + 1), mode="nearest")
    smooth[repeated < _WATER_SHARE * usual] = np.nan
    return smooth
