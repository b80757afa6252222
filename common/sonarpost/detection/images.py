"""Detection in a single image without navigation, for example a decoded snippet or a tile of a data set.

The result does not depend on the gain and the bit depth of the recorder, nor on padding: borders of constant value are
cut off, and the other pixels are divided by their 99th percentile.
"""

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
_MIN_CELLS: Final = 16
"""Minimum rows and columns of a level grid."""
_SEABED_WINDOW_M: Final = 4.0
"""Window of the local seabed level: more than twice the extent of a mine and its shadow."""
_WATER_SHARE: Final = 0.12
"""A window below this share of the usual level is water, the shadow of something large, or empty."""
_SCALE_PERCENTILE: Final = 99.0
_PADDING_RANGE: Final = 0.01
"""Maximum difference of the pixels of a padding line, as a share of that percentile: traces of JPEG coding."""


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
class SeabedWindow:
    """The part of an image inside its padding, independent of gain and bit depth.

    Attributes:
        values: Shape (rows, columns), float32, 0 or more; 1.0 is the 99th percentile.
        top: Row of the image of the first row.
        left: Column of the image of the first column.
        pixel_along_m: As in `ScaledImage`.
        pixel_across_m: As in `ScaledImage`.
    """

    values: FloatImage
    top: int
    left: int
    pixel_along_m: float
    pixel_across_m: float


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
    window = seabed_window(image)
    if window is None:
        return None
    found = [d for s in ((side,) if side is not None else tuple(Side)) for d in _detections(window, settings, s)]
    return max(found, key=lambda d: d.confidence, default=None)


def _detections(window: SeabedWindow, settings: DetectorSettings, side: Side) -> list[ImageDetection]:
    grid = normalise_window(window, side)
    if grid is None:
        return []
    rows_per_cell = round(grid.row_along_m / window.pixel_along_m)
    last_row, last_column = window.values.shape[0] - 1, window.values.shape[1] - 1
    found = []
    response = matched_response(grid, settings)
    for candidate in classified_candidates(response, grid, settings, classifier_of(settings)):
        peak = candidate.peak
        outward = min(peak.cell * grid.samples_per_cell + grid.samples_per_cell // 2, last_column)
        column = outward if side is Side.STARBOARD else last_column - outward
        row = min(peak.row * rows_per_cell + rows_per_cell // 2, last_row)
        place = window.top + row, window.left + column
        found.append(ImageDetection(candidate.confidence, candidate.p_mine_like, side, *place))
    return found


def seabed_window(image: ScaledImage) -> SeabedWindow | None:
    """Cut off the padding of an image and scale the other pixels; None for an image of constant value.

    Padding is every border row and column whose pixels are equal, apart from traces of JPEG coding.
    """
    pixels = image.pixels
    inside = _inside_padding(pixels, (slice(0, pixels.shape[0]), slice(0, pixels.shape[1])), 0.0)
    if not pixels[inside].size:
        return None
    # The percentile is taken without the padding, so that it does not depend on its extent.
    max_range = _PADDING_RANGE * float(np.percentile(pixels[inside], _SCALE_PERCENTILE))
    inside = _inside_padding(pixels, inside, max_range)
    values = pixels[inside].astype(np.float32)
    if not values.size:
        return None
    scale = float(np.percentile(values, _SCALE_PERCENTILE)) or float(values.max())
    top, left = inside[0].start, inside[1].start
    return SeabedWindow(values / np.float32(scale), top, left, image.pixel_along_m, image.pixel_across_m)


def _inside_padding(pixels: GreyImage, inside: tuple[slice, slice], max_range: float) -> tuple[slice, slice]:
    """Return the rows and columns of a window that remain without its border lines of at most `max_range`."""
    (top, bottom), (left, right) = ((s.start, s.stop) for s in inside)

    def is_padding(line: GreyImage) -> bool:
        return int(line.max()) - int(line.min()) <= max_range

    before = None
    # Removed columns can make a row constant, and the other way round.
    while before != (top, bottom, left, right):
        before = (top, bottom, left, right)
        while top < bottom and is_padding(pixels[top, left:right]):
            top += 1
        while bottom > top and is_padding(pixels[bottom - 1, left:right]):
            bottom -= 1
        while top < bottom and left < right and is_padding(pixels[top:bottom, left]):
            left += 1
        while top < bottom and right > left and is_padding(pixels[top:bottom, right - 1]):
            right -= 1
        if top == bottom or left == right:
            return slice(top, top), slice(left, left)
    return slice(top, bottom), slice(left, right)


def normalise_window(window: SeabedWindow, side: Side) -> LevelGrid | None:
    """Return the window of an image as a level grid, or None if it is too small or empty.

    The range is unknown, so the seabed level is the median around each place in place of the median at the same range.
    Water is marked as unknown. A cell is about 6 cm, in a small window less, so that there are at least 16 by 16 cells.

    Args:
        window: The window.
        side: Direction away from the vehicle: right (starboard) or left (port).
    """
    values = window.values if side is Side.STARBOARD else window.values[:, ::-1]
    height, width = values.shape
    rows = max(1, min(round(_CELL_M / window.pixel_along_m), height // _MIN_CELLS))
    columns = max(1, min(round(_CELL_M / window.pixel_across_m), width // _MIN_CELLS))
    cells = _block_means(values, rows, columns)
    if min(cells.shape) < _MIN_CELLS:
        return None
    row_m, cell_m = window.pixel_along_m * rows, window.pixel_across_m * columns
    seabed = _seabed_level(cells, row_m, cell_m)
    if seabed is None:
        return None
    floor = 0.02 * float(np.nanmedian(seabed))
    ratio = ((cells + floor) / (seabed + floor)).astype(np.float32)
    none = np.zeros(cells.shape[0], dtype=np.int64)
    return LevelGrid(side, levels_of_ratio(ratio), none, columns, cell_m, row_m, row_is_measured=True)


def _block_means(values: FloatImage, rows: int, columns: int) -> FloatImage:
    height, width = values.shape[0] // rows, values.shape[1] // columns
    blocks = values[: height * rows, : width * columns].reshape(height, rows, width, columns)
    means: FloatImage = blocks.mean(axis=(1, 3), dtype=np.float32)
    return means


def _seabed_level(cells: FloatImage, row_m: float, cell_m: float) -> FloatImage | None:
    """Return the median level around every cell; NaN where it is too low for seabed, None if there is none."""
    step = (max(1, round(0.25 / row_m)), max(1, round(0.25 / cell_m)))
    coarse = cells[:: step[0], :: step[1]]
    size = (max(3, round(_SEABED_WINDOW_M / row_m / step[0])), max(3, round(_SEABED_WINDOW_M / cell_m / step[1])))
    medians = ndimage.median_filter(coarse, size=size, mode="reflect")
    usual = float(np.percentile(medians, 75))
    if usual <= 0:
        return None
    repeated = np.repeat(np.repeat(medians, step[0], axis=0), step[1], axis=1)[: cells.shape[0], : cells.shape[1]]
    smooth: FloatImage = ndimage.uniform_filter(repeated, size=(2 * step[0] + 1, 2 * step[1] + 1), mode="nearest")
    smooth[repeated < _WATER_SHARE * usual] = np.nan
    return smooth
