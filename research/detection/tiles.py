"""Evaluation of the detector on the tiles of the SDVD data set: tiles with a target against tiles without."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from research.common.images import read_sdvd_index, survey_line
from research.common.statistics import Interval, auc, bootstrap_weights, interval
from sonarpost.codec.interface import to_uint8
from sonarpost.detection.images import ScaledImage, detect_in_image
from sonarpost.errors import SurveyFileError
from sonarpost.sonar.image_files import read_image

PIXEL_M: Final = 0.05
"""Pixel size, which the data set does not state: its targets are 1.8 m long, their boxes 40 x 35 px (median)."""


@dataclass(frozen=True, slots=True)
class TileScore:
    """A tile with the maximum confidence of its detections (0 without detection)."""

    split: str
    image: str
    is_target: bool
    confidence: float


def tile_scores(folder: Path) -> tuple[TileScore, ...]:
    """Return the score of every tile of both splits, with shadows in both directions.

    Raises:
        SurveyFileError: The index or a tile cannot be read or is invalid.
    """
    scores = []
    for tile in read_sdvd_index(folder):
        image = ScaledImage(to_uint8(read_image(folder / tile.split / "images" / tile.image)), PIXEL_M, PIXEL_M)
        found = detect_in_image(image)
        confidence = 0.0 if found is None else found.confidence
        scores.append(TileScore(tile.split, tile.image, tile.target_centre is not None, confidence))
    return tuple(scores)


def tile_auc(tiles: tuple[TileScore, ...]) -> tuple[float, Interval | None]:
    """Return the area under the ROC curve with its 95 % interval over survey lines.

    Raises:
        SurveyFileError: There are no targets, or only targets.
    """
    scores = np.array([t.confidence for t in tiles])
    is_target = np.array([t.is_target for t in tiles], dtype=np.bool_)
    if not tiles or is_target.all() or not is_target.any():
        raise SurveyFileError("index.csv", "target_px", f"{int(is_target.sum())} of {len(tiles)}", "targets and others")
    weights = bootstrap_weights([survey_line(t.image) for t in tiles])
    return float(auc(scores, is_target)[0]), interval(auc(scores, is_target, weights))
