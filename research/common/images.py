"""Images for the measurements: a folder of the user, contacts of simulated surveys, or crops of the SDVD data set.

SDVD (Sonar Drowned Victims Datasets) is a folder with `index.csv`, `train/images` and `test/images`: tiles of 256 x 256
px, each with the bounding box of its target, if it has one. Two windows of 120 x 120 px (six in the train split) are
cut near the target, or at random without one, and reduced to 80 x 80 px. The random draws use one generator, seed 0,
train split first, so the 138 crops of the test split are always those of the published figures.

Targets are lossless PNG, most other tiles JPEG: figures from them compare codecs with one another only.
"""

from __future__ import annotations

import csv
import io
import math
import os
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image as PillowImage

from sonarpost.codec.interface import MAX_SIDE_PX, MIN_SIDE_PX, Image, to_uint8
from sonarpost.detection.snippets import to_grey
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.image_files import MAX_FILE_BYTES, MAX_PIXELS, read_image

JPEG_SUFFIXES: Final = (".jpg", ".jpeg")
SUFFIXES: Final = (*JPEG_SUFFIXES, ".png", ".tif", ".tiff")
MAX_IMAGES: Final = 100_000

_FIRST_SEED: Final = 910_000
"""Differs from the seeds of the shipped codebooks (7000 to 7051): no test image is a training image."""
_OBJECTS_PER_LINE: Final = 6
_PINGS: Final = 500

WINDOW_PX: Final = 120
TILE_PX: Final = 256
CROPS: Final = {"train": 6, "test": 2}
_SHIFT_PX: Final = 12
_FIELDS: Final = ("split", "image", "target_px", "x0", "y0", "x1", "y1")
_MAX_INDEX_BYTES: Final = 1 << 24
_TIME: Final = re.compile(r"_(\d{12})\d{2}[HL]_")


@dataclass(frozen=True)
class SampleImage:
    """An image to measure on.

    Attributes:
        name: Name in messages.
        source: File or tile it was cut from. Images of one source are correlated; the bootstrap draws sources.
        pixels: Shape (16..512, 16..512), uint8.
        group: Survey line, if known.
        is_target: Whether it shows a target; None if unknown.
    """

    name: str
    source: str
    pixels: Image
    group: str = ""
    is_target: bool | None = None


@dataclass(frozen=True)
class ImageSet:
    """The images of one run.

    Attributes:
        origin: Description of where they are from.
        images: At least one.
        rejected: One line for each file that cannot be used, with the reason.
    """

    origin: str
    images: tuple[SampleImage, ...]
    rejected: tuple[str, ...] = ()


def read_image_folder(folder: Path) -> ImageSet:
    """Read every grey PNG, JPEG and TIFF in a folder and its subfolders, in order of their paths.

    Files that cannot be measured on (a side outside 16..512 px, colour, damage) are rejected and listed. 16-bit images
    are mapped to 8 bits as the codecs do. Links to folders are not followed.

    Raises:
        SurveyFileError: Not a folder, not readable, or without a usable image.
    """
    if not folder.is_dir():
        raise SurveyFileError(str(folder), "", "not a folder or absent", "a folder of PNG, JPEG or TIFF images")
    images: list[SampleImage] = []
    rejected: list[str] = []
    for path in _image_paths(folder):
        name = str(path.relative_to(folder))
        try:
            images.append(SampleImage(name, name, _read_usable(path)))
        except SurveyFileError as error:
            rejected.append(str(error))
    if not images:
        expected = f"at least one grey {', '.join(SUFFIXES)} of {MIN_SIDE_PX}..{MAX_SIDE_PX} px a side"
        if rejected:
            expected += f" (the first one rejected is {rejected[0]})"
        raise SurveyFileError(str(folder), "images", f"none, {len(rejected)} rejected", expected)
    return ImageSet(str(folder), tuple(images), tuple(rejected))


def _image_paths(folder: Path) -> list[Path]:
    def fail(error: OSError) -> None:
        raise SurveyFileError(str(folder), "", error.strerror or str(error), "readable folders") from error

    paths = [
        Path(place) / name
        for place, _, names in os.walk(folder, onerror=fail)
        for name in names
        if Path(name).suffix.lower() in SUFFIXES
    ]
    if len(paths) > MAX_IMAGES:
        raise SurveyFileError(str(folder), "images", len(paths), f"at most {MAX_IMAGES}")
    return sorted(paths)


def _read_usable(path: Path) -> Image:
    pixels = read_grey(path)
    for field, value in (("height", pixels.shape[0]), ("width", pixels.shape[1])):
        if not MIN_SIDE_PX <= value <= MAX_SIDE_PX:
            raise SurveyFileError(str(path), field, f"{value} px", f"{MIN_SIDE_PX}..{MAX_SIDE_PX} px")
    return pixels


def read_grey(path: Path) -> Image:
    """Read a grey PNG, JPEG or TIFF, shape (rows, columns), mapped to uint8.

    Raises:
        SurveyFileError: The file cannot be read, is damaged, too large, or in colour.
    """
    return _read_jpeg(path) if path.suffix.lower() in JPEG_SUFFIXES else to_uint8(read_image(path))


def _read_jpeg(path: Path) -> Image:
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise SurveyFileError(str(path), "file size", path.stat().st_size, f"at most {MAX_FILE_BYTES} bytes")
        raw = path.read_bytes()
    except OSError as error:
        raise SurveyFileError(str(path), "", error.strerror or str(error), "a readable image") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with PillowImage.open(io.BytesIO(raw), formats=["JPEG"]) as image:
                size = image.size
                fits = size[0] * size[1] <= MAX_PIXELS  # the declared size is checked before decoding
                pixels = np.asarray(image, dtype=np.uint8) if fits else np.empty(0, dtype=np.uint8)
    except Exception as error:  # Pillow raises OSError, SyntaxError, ValueError, struct.error, ...
        raise SurveyFileError(str(path), "JPEG data", str(error), "an undamaged JPEG") from error
    if not fits:
        raise SurveyFileError(str(path), "size", f"{size[0]} x {size[1]}", f"at most {MAX_PIXELS} pixels")
    if pixels.ndim == 3 and pixels.shape[2] == 3 and (pixels == pixels[..., :1]).all():
        pixels = pixels[..., 0]
    if pixels.ndim != 2:
        raise SurveyFileError(str(path), "colour", f"{pixels.shape}", "a grey image")
    return np.ascontiguousarray(pixels)


def simulated_images(count: int, seed: int = 0, side_px: int = 80) -> ImageSet:
    """Cut images from simulated surveys over every kind of seabed, half of them with a mine-like object.

    Each image is cut at the resolution of the survey around a mine-like object, another object, or (every fourth of
    the others) bare seabed. It is mapped to grey like the snippets of the detector.

    Args:
        count: Number of images, 1..100,000.
        seed: The same values give the same images.
        side_px: Side of the square images, 16..500 px.

    Raises:
        ConfigError: A number out of range.
    """
    if not 1 <= count <= MAX_IMAGES:
        raise ConfigError("research", "simulated images", count, f"1..{MAX_IMAGES}")
    if not MIN_SIDE_PX <= side_px <= _PINGS:
        raise ConfigError("research", "crop", side_px, f"{MIN_SIDE_PX}..{_PINGS} px")
    kinds = tuple(SeabedKind)
    images: list[SampleImage] = []
    for line in range(math.ceil(count / (2 * _OBJECTS_PER_LINE))):
        spec = SurveySpec(
            seed=_FIRST_SEED + 10_000 * seed + line,
            pings=_PINGS,
            seabed=kinds[line % len(kinds)],
            targets=_OBJECTS_PER_LINE,
            clutter=_OBJECTS_PER_LINE,
        )
        images += _cut_simulated(spec, side_px)
    return ImageSet(f"simulated surveys, seed {seed}", tuple(images[:count]))


def _cut_simulated(spec: SurveySpec, side_px: int) -> list[SampleImage]:
    simulated = simulate_survey(spec)
    rng = np.random.default_rng(spec.seed)
    waterfalls = {side: simulated.survey.waterfall(side) for side in simulated.survey.sides()}
    line = simulated.survey.line_name
    images = []
    others = 0
    for number, thing in enumerate(simulated.truth):
        waterfall = waterfalls[thing.side]
        rows, columns = waterfall.shape
        down, right = (int(v) for v in rng.integers(-side_px // 10, side_px // 10 + 1, 2))
        row, column = thing.ping + down, thing.sample_index + side_px // 8 + right
        if not thing.is_mine_like:
            others += 1
            if others % 4 == 0:
                row, column = int(rng.integers(0, rows)), int(rng.integers(columns // 3, columns))
        top = min(max(row - side_px // 2, 0), rows - side_px)
        left = min(max(column - side_px // 2, 0), columns - side_px)
        window = waterfall[top : top + side_px, left : left + side_px]
        grey = to_grey(window.astype(np.uint32), np.ones(window.shape, dtype=np.bool_))
        name = f"{line} {number}"
        images.append(SampleImage(name, name, grey, line, thing.is_mine_like))
    # Alternating, so that the first images of the set contain both kinds.
    targets = [image for image in images if image.is_target]
    rest = [image for image in images if not image.is_target]
    return [image for pair in zip(targets, rest, strict=True) for image in pair]


@dataclass(frozen=True)
class SdvdTile:
    """A tile of the data set: split, file name, and centre of its target, None without a target."""

    split: str
    image: str
    target_centre: tuple[int, int] | None


def sdvd_crops(folder: Path, split: str = "test", side_px: int = 80) -> ImageSet:
    """Cut the crops of one split of the SDVD data set.

    Args:
        folder: Folder of the data set.
        split: "test" (evaluation) or "train".
        side_px: Side to which the windows of 120 px are reduced, 16..512.

    Raises:
        SurveyFileError: The index or a tile cannot be read or is invalid.
        ConfigError: The side is out of range.
    """
    if not MIN_SIDE_PX <= side_px <= MAX_SIDE_PX:
        raise ConfigError("research", "crop", side_px, f"{MIN_SIDE_PX}..{MAX_SIDE_PX} px")
    rng = np.random.default_rng(0)
    images: list[SampleImage] = []
    tiles = read_sdvd_index(folder)
    for tile in sorted(tiles, key=lambda t: tuple(CROPS).index(t.split)):
        corners = list(_corners(tile, rng))
        if tile.split != split:
            continue
        tile_image = _read_tile(folder / tile.split / "images" / tile.image)
        line, is_target = survey_line(tile.image), bool(tile.target_centre)
        for number, (left, top) in enumerate(corners):
            window = tile_image.crop((left, top, left + WINDOW_PX, top + WINDOW_PX))
            pixels = np.asarray(window.resize((side_px, side_px), PillowImage.Resampling.LANCZOS), dtype=np.uint8)
            images.append(SampleImage(f"{tile.image} #{number}", tile.image, pixels, line, is_target))
    if not images:
        raise SurveyFileError(str(folder / "index.csv"), "split", f"no tile of {split!r}", "at least one")
    return ImageSet(f"{folder}, {split} split, {side_px} px crops", tuple(images))


def survey_line(image: str) -> str:
    """Return the survey line of a tile: the minute of a dated name, else the name up to its first underscore.

    Port and starboard and both frequencies of one minute show the same bottom, so they are one line.
    """
    dated = _TIME.search(image)
    return dated[1] if dated else image.partition("_")[0]


def _corners(tile: SdvdTile, rng: np.random.Generator) -> Iterator[tuple[int, int]]:
    """Yield left and top of each window. The order of the draws must not change, see the module docstring."""
    half = WINDOW_PX // 2
    for _ in range(CROPS[tile.split]):
        if tile.target_centre is not None:
            x = tile.target_centre[0] + int(rng.integers(-_SHIFT_PX, _SHIFT_PX + 1))
            y = tile.target_centre[1] + int(rng.integers(-_SHIFT_PX, _SHIFT_PX + 1))
        else:
            x, y = (int(value) for value in rng.integers(half, TILE_PX - half, 2))
        yield min(max(x, half), TILE_PX - half) - half, min(max(y, half), TILE_PX - half) - half


def read_sdvd_index(folder: Path) -> list[SdvdTile]:
    """Read `index.csv` of the data set.

    Raises:
        SurveyFileError: The file cannot be read or is invalid.
    """
    path = folder / "index.csv"
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


def _tile(row: dict[str, str], where: str) -> SdvdTile:
    split, image = row["split"], row["image"]
    if split not in CROPS:
        raise SurveyFileError(where, "split", split, " or ".join(CROPS))
    if not image or Path(image).name != image or "\0" in image:
        raise SurveyFileError(where, "image", image, "the name of a file")
    try:
        if int(row["target_px"]) <= 0:
            return SdvdTile(split, image, None)
        centre = ((int(row["x0"]) + int(row["x1"])) // 2, (int(row["y0"]) + int(row["y1"])) // 2)
    except (TypeError, ValueError) as error:  # the fields of a short row are None
        raise SurveyFileError(where, "target_px, x0, y0, x1, y1", list(row.values()), "whole numbers") from error
    return SdvdTile(split, image, centre)


def _read_tile(path: Path) -> PillowImage.Image:
    pixels = read_grey(path)
    if pixels.shape != (TILE_PX, TILE_PX):
        raise SurveyFileError(str(path), "size", pixels.shape, f"{TILE_PX} x {TILE_PX} px")
    return PillowImage.fromarray(pixels)
