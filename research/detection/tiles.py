"""The detector's confidence on whole tiles of the SDVD set: tiles with a target against tiles of clutter."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from research.common.images import JPEG_SUFFIXES, read_jpeg
from research.common.sdvd import survey_line
from research.common.statistics import Interval, auc, bootstrap_weights, interval
from sonarpost.codec.interface import to_uint8
from sonarpost.detection.image_detector import ScaledImage, detect_in_image
from sonarpost.errors import SurveyFileError
from sonarpost.sonar.image_files import read_image

PIXEL_M: Final = 0.05
"""The set does not say; its targets are 1.8 m long and their boxes 40 x 35 px in the median."""
_FIELDS: Final = ("split", "image", "target_px")


@dataclass(frozen=True, slots=True)
class TileScore:
    """A tile, and the greatest confidence on it (0 where no filter answers)."""

    split: str
    image: str
    is_target: bool
    confidence: float


def tile_scores(folder: Path) -> tuple[TileScore, ...]:
    """Return the confidence of every tile of both splits; shadows are looked for to both sides.

    Raises:
        SurveyFileError: The index or a tile cannot be read or is not what the data set has.
    """
    path = folder / "index.csv"
    try:
        rows = list(csv.DictReader(io.StringIO(path.read_text("utf-8")), strict=True))
    except (OSError, ValueError, csv.Error) as error:
        raise SurveyFileError(str(path), "", str(error), "the data set's index.csv") from error
    if not rows or not set(_FIELDS) <= set(rows[0]):
        raise SurveyFileError(str(path), "header", list(rows[0]) if rows else "", f"the columns {', '.join(_FIELDS)}")
    return tuple(_scored(folder, row, f"{path} row {number}") for number, row in enumerate(rows, start=1))


def _scored(folder: Path, row: dict[str, str], where: str) -> TileScore:
    split, image = row["split"], row["image"]
    if split not in ("train", "test") or not image or Path(image).name != image or "\0" in image:
        raise SurveyFileError(where, "split, image", (split, image), "train or test, and the name of a file")
    try:
        is_target = int(row["target_px"]) > 0
    except (TypeError, ValueError) as error:
        raise SurveyFileError(where, "target_px", row["target_px"], "a whole number") from error
    path = folder / split / "images" / image
    pixels = read_jpeg(path) if path.suffix.lower() in JPEG_SUFFIXES else to_uint8(read_image(path))
    best = detect_in_image(ScaledImage(pixels, PIXEL_M, PIXEL_M))
    return TileScore(split, image, is_target, 0.0 if best is None else best.confidence)


def tile_auc(tiles: tuple[TileScore, ...]) -> tuple[float, Interval | None]:
    """Return the area under the ROC curve and its 95 % interval over survey lines.

    Raises:
        SurveyFileError: Not both targets and others.
    """
    scores = np.array([t.confidence for t in tiles])
    is_target = np.array([t.is_target for t in tiles], dtype=np.bool_)
    if not tiles or is_target.all() or not is_target.any():
        raise SurveyFileError("index.csv", "target_px", f"{int(is_target.sum())} of {len(tiles)}", "targets and others")
    weights = bootstrap_weights([survey_line(t.image) for t in tiles])
    return float(auc(scores, is_target)[0]), interval(auc(scores, is_target, weights))
