"""A picture without navigation as a level grid, so that the detector can judge pieces of images as it does surveys.

## sonarpost.detection.image_detector
The detector's confidence for a picture that comes without navigation: the fused one, of its best place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sonarpost.detection.candidates import FilterScores, candidates
from sonarpost.detection.fusion import fused_confidences
from sonarpost.detection.normalisation import LevelGrid
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import FloatImage, Side

GreyImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

_CELL_M: Final = 0.06
_SEABED_WINDOW_M: Final = 4.0
"""Over which the seabed's own level is taken: more than twice a mine and its shadow."""
_WATER_SHARE: Final = 0.12
"""A window of that size below this part of the picture's level is water, the lee of something large, or nothing."""


@dataclass(frozen=True, slots=True)
class LevelImage:
    """A piece of a side-scan picture.

    Attributes:
        picture: Shape (rows, columns), uint8 or uint16, echo strength as shown; rows along-track.
        pixel_along_m: Travel between two rows.
        pixel_across_m: Slant range of a column.
    """

    picture: GreyImage
    pixel_along_m: float
    pixel_across_m: float

    def __post_init__(self) -> None:
        """Refuse what is no picture.

        Raises:
            ValueError: Not two axes, or a pixel size that is not above 0.
        """
        if self.picture.ndim != 2:
            raise ValueError(f"picture: got shape {self.picture.shape}, expected rows by columns")
        if not (self.pixel_along_m > 0 and self.pixel_across_m > 0):
            raise ValueError(f"pixel sizes: got {self.pixel_along_m}, {self.pixel_across_m} m, expected above 0")


def level_image(piece: LevelImage, side: Side) -> LevelGrid | None:
    """Return a piece as a level grid, or None when it is too small or holds nothing.

    Range is not known, so the seabed's level is the median around each place instead of that of the same range;
    borders of one value (padding) and water are unknown.

    Args:
        piece: The piece.
        side: Where its columns lead: away from the vehicle to the right (starboard), or to the left (port).
    """
    values = piece.picture.astype(np.float32)
    if side is Side.PORT:
        values = values[:, ::-1]
    values = _without_padding(values)
    rows = max(1, round(_CELL_M / piece.pixel_along_m))
    columns = max(1, round(_CELL_M / piece.pixel_across_m))
    cells = _reduced(values, rows, columns)
    if min(cells.shape) < 16 or not np.isfinite(cells).any():
        return None
    row_m, cell_m = piece.pixel_along_m * rows, piece.pixel_across_m * columns
    seabed = _seabed(cells, row_m, cell_m)
    if seabed is None:
        return None
    floor = 0.02 * float(np.nanmedian(seabed))
    ratio = ((cells + floor) / (seabed + floor)).astype(np.float32)
    level = np.clip(np.log2(np.maximum(ratio, 2.0**-6)), -4.0, 4.0).astype(np.float32)
    none = np.zeros(cells.shape[0], dtype=np.int64)
    return LevelGrid(side, level, ratio, none, none, columns, cell_m, row_m, row_is_measured=True)


def _without_padding(values: FloatImage) -> FloatImage:
    """Make rows and columns at the border that hold one value unknown."""
    out = values.copy()
    for view in (out, out[::-1], out.T, out.T[::-1]):
        for line in view:
            known = line[np.isfinite(line)]
            if known.size and known.max() - known.min() > 2.0:
                break
            line[:] = np.nan
    return out


def _reduced(values: FloatImage, rows: int, columns: int) -> FloatImage:
    height, width = values.shape[0] // rows, values.shape[1] // columns
    cut = values[: height * rows, : width * columns].reshape(height, rows, width, columns)
    reduced: FloatImage = cut.mean(axis=(1, 3), dtype=np.float32)
    return reduced


def _seabed(cells: FloatImage, row_m: float, cell_m: float) -> FloatImage | None:
    """Return the median level around every cell, NaN where it is so low that no seabed is seen."""
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
    zoomed = np.repeat(np.repeat(medians, step[0], axis=0), step[1], axis=1)[: cells.shape[0], : cells.shape[1]]
    smooth = ndimage.uniform_filter(zoomed, size=(2 * step[0] + 1, 2 * step[1] + 1), mode="nearest")
    smooth[zoomed < _WATER_SHARE * usual] = np.nan
    out: FloatImage = smooth
    return out


@dataclass(frozen=True, slots=True)
class ImageFinding:
    """The place of a piece of which the detector is surest.

    Attributes:
        confidence: 0 to 2, see `sonarpost.detection.fusion`.
        scores: What each filter says.
        side: Where the shadow falls: to the right (starboard) or to the left (port).
        row: Row of the highlight's middle in the picture.
        column: Column of it.
    """

    confidence: float
    scores: FilterScores
    side: Side
    row: int
    column: int


def image_confidence(
    piece: LevelImage, settings: DetectorSettings | None = None, side: Side | None = None
) -> ImageFinding | None:
    """Return the most confident place of a piece, or None where no filter answers.

    Args:
        piece: The picture and its pixel sizes.
        settings: How to look; the defaults when None. No threshold applies.
        side: Where shadows fall; looked for both ways when None.
    """
    chosen = settings if settings is not None else DetectorSettings()
    found = [f for s in ((side,) if side is not None else tuple(Side)) for f in _findings(piece, chosen, s)]
    return max(found, key=lambda f: f.confidence, default=None)


def _findings(piece: LevelImage, settings: DetectorSettings, side: Side) -> list[ImageFinding]:
    grid = level_image(piece, side)
    if grid is None:
        return []
    per_row = round(grid.row_along_m / piece.pixel_along_m)
    last = piece.picture.shape[1] - 1
    found = []
    places = candidates(grid, settings)
    for confidence, one in zip(fused_confidences(places, grid, settings), places, strict=True):
        away = min(one.measured.cell * grid.samples_per_cell + grid.samples_per_cell // 2, last)
        column = away if side is Side.STARBOARD else last - away
        row = min(one.measured.row * per_row + per_row // 2, piece.picture.shape[0] - 1)
        found.append(ImageFinding(confidence, one.scores, side, row, column))
    return found
