"""The detector's confidence for a picture that comes without navigation: the fused one, of its best place."""

from __future__ import annotations

from dataclasses import dataclass

from sonarpost.detection.candidates import FilterScores, candidates
from sonarpost.detection.fusion import fused_confidences
from sonarpost.detection.image_detector import LevelImage, level_image
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import Side


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
