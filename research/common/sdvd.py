"""Crops of the Sonar Drowned Victims Datasets (a folder with `index.csv`, `train/images`, `test/images`).

The tiles are 256 x 256 px, each with the box of its one target or none. Two windows of 120 x 120 px (six in the train
split) are cut near the target, or anywhere where there is none, and reduced to 80 x 80 px. The draws are those of the
table of figures this project compares with (one generator, seed 0, train split first), so the 138 crops of the test
split are always the same ones.

Targets are lossless PNG, most negatives JPEG: what is measured on them compares codecs with one another only.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image as PillowImage

from research.common.images import JPEG_SUFFIXES, BenchPicture, PictureSet, read_jpeg
from sonarpost.codec.interface import MAX_SIDE_PX, MIN_SIDE_PX, to_uint8
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.sonar.image_files import read_image

WINDOW_PX: Final = 120
TILE_PX: Final = 256
CROPS: Final = {"train": 6, "test": 2}
_SHIFT_PX: Final = 12
_FIELDS: Final = ("split", "image", "target_px", "x0", "y0", "x1", "y1")
_MAX_INDEX_BYTES: Final = 1 << 24
_TIME: Final = re.compile(r"_(\d{12})\d{2}[HL]_")


@dataclass(frozen=True)
class _Tile:
    split: str
    image: str
    target_middle: tuple[int, int] | None


def sdvd_crops(folder: Path, split: str = "test", side_px: int = 80) -> PictureSet:
    """Cut the crops of one split.

    Args:
        folder: The data set's folder.
        split: "test" (evaluation) or "train".
        side_px: Side that the windows of 120 px are reduced to, 16..512.

    Raises:
        SurveyFileError: The index or a tile cannot be read or is not what the data set has.
        ConfigError: The side is out of range.
    """
    if not MIN_SIDE_PX <= side_px <= MAX_SIDE_PX:
        raise ConfigError("research", "crop", side_px, f"{MIN_SIDE_PX}..{MAX_SIDE_PX} px")
    rng = np.random.default_rng(0)
    pictures: list[BenchPicture] = []
    tiles = _read_index(folder / "index.csv")
    for tile in sorted(tiles, key=lambda t: tuple(CROPS).index(t.split)):
        corners = list(_corners(tile, rng))
        if tile.split != split:
            continue
        view = _read_tile(folder / tile.split / "images" / tile.image)
        for number, (left, top) in enumerate(corners):
            window = view.crop((left, top, left + WINDOW_PX, top + WINDOW_PX))
            pixels = np.asarray(window.resize((side_px, side_px), PillowImage.Resampling.LANCZOS), dtype=np.uint8)
            pictures.append(
                BenchPicture(
                    f"{tile.image} #{number}", tile.image, pixels, survey_line(tile.image), bool(tile.target_middle)
                )
            )
    if not pictures:
        raise SurveyFileError(str(folder / "index.csv"), "split", f"no tile of {split!r}", "at least one")
    return PictureSet(f"{folder}, {split} split, {side_px} px crops", tuple(pictures))


def survey_line(image: str) -> str:
    """Return what tells survey lines apart: the minute of a dated name, else the name up to its first underscore.

    Port and starboard and both frequencies of one moment show the same bottom, so they are one line.
    """
    dated = _TIME.search(image)
    return dated[1] if dated else image.partition("_")[0]


def _corners(tile: _Tile, rng: np.random.Generator) -> Iterator[tuple[int, int]]:
    """Yield left and top of each window; the order of the draws must stay as it is (module docstring)."""
    half = WINDOW_PX // 2
    for _ in range(CROPS[tile.split]):
        if tile.target_middle is not None:
            x = tile.target_middle[0] + int(rng.integers(-_SHIFT_PX, _SHIFT_PX + 1))
            y = tile.target_middle[1] + int(rng.integers(-_SHIFT_PX, _SHIFT_PX + 1))
        else:
            x, y = (int(value) for value in rng.integers(half, TILE_PX - half, 2))
        yield min(max(x, half), TILE_PX - half) - half, min(max(y, half), TILE_PX - half) - half


def _read_index(path: Path) -> list[_Tile]:
    try:
        if path.stat().st_size > _MAX_INDEX_BYTES:
            raise SurveyFileError(str(path), "file size", path.stat().st_size, f"at most {_MAX_INDEX_BYTES} bytes")
        text = path.read_bytes().decode("utf-8")
    except OSError as error:
        raise SurveyFileError(str(path), "", error.strerror or str(error), "the data set's index.csv") from error
    except UnicodeDecodeError as error:
        raise SurveyFileError(str(path), "text", str(error), "UTF-8") from error
    try:
        reader = csv.DictReader(io.StringIO(text), strict=True)
        if not set(_FIELDS) <= set(reader.fieldnames or ()):
            raise SurveyFileError(str(path), "header", reader.fieldnames, f"the columns {', '.join(_FIELDS)}")
        return [_tile(row, f"{path} line {reader.line_num}") for row in reader]
    except csv.Error as error:
        raise SurveyFileError(str(path), "text", str(error), "comma-separated values") from error


def _tile(row: dict[str, str], where: str) -> _Tile:
    split, image = row["split"], row["image"]
    if split not in CROPS:
        raise SurveyFileError(where, "split", split, " or ".join(CROPS))
    if not image or Path(image).name != image or "\0" in image:
        raise SurveyFileError(where, "image", image, "the name of a file")
    try:
        if int(row["target_px"]) <= 0:
            return _Tile(split, image, None)
        middle = ((int(row["x0"]) + int(row["x1"])) // 2, (int(row["y0"]) + int(row["y1"])) // 2)
    except (TypeError, ValueError) as error:  # a short row leaves None
        raise SurveyFileError(where, "target_px, x0, y0, x1, y1", list(row.values()), "whole numbers") from error
    return _Tile(split, image, middle)


def _read_tile(path: Path) -> PillowImage.Image:
    pixels = read_jpeg(path) if path.suffix.lower() in JPEG_SUFFIXES else to_uint8(read_image(path))
    if pixels.shape != (TILE_PX, TILE_PX):
        raise SurveyFileError(str(path), "size", pixels.shape, f"{TILE_PX} x {TILE_PX} px")
    return PillowImage.fromarray(pixels)
