"""Images for the measurements: a folder of the user, contacts of simulated surveys, or crops of the SDVD data set.

SDVD (Sonar Drowned Victims Datasets) is a folder with `index.csv`, `train/images` and `test/images`: tiles of 256 x 256
px, each with the bounding box of its target, if it has one. Two windows of 120 x 120 px (six in the train split) are
cut near the target, or at random without one, and reduced to 80 x 80 px. The random draws use one generator, seed 0,
train split first, so the 138 crops of the test split are always those of the published figures.

Targets are lossless PNG, most other tiles JPEG: figures from them compare codecs with one another only.
"""

import csv
import io
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from PIL import Image as PillowImage

from research.common.scene_measures import ObjectPlace, place_in_window
from sonarpost.codec.fitting import Fit, fit_image
from sonarpost.codec.interface import MAX_SIDE_PX, MIN_SIDE_PX, Image, to_uint8
from sonarpost.detection.snippets import HIGH_PERCENTILE, LOW_PERCENTILE, to_grey
from sonarpost.errors import BadInputError, ConfigError, SurveyFileError
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.image_decoding import read_any_image
from sonarpost.sonar.image_files import IMAGE_SUFFIXES, MAX_IMAGES, list_images, read_image

_FIRST_SEED: Final = 910_000
"""Differs from the seeds of the shipped codebooks (7000 to 7051): no test image is a training image."""
_OBJECTS_PER_LINE: Final = 6
_PINGS: Final = 500

WINDOW_PX: Final = 120
TILE_PX: Final = 256
CROPS: Final = {"train": 6, "test": 2}
_SHIFT_PX: Final = 12
SDVD_FIELDS: Final = ("split", "image", "w", "h", "target_px", "x0", "y0", "x1", "y1")
_FIELDS: Final = tuple(field for field in SDVD_FIELDS if field not in ("w", "h"))
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
        clean: The same scene without speckle, same shape and grey scale; None if unknown.
        place: Place of the object that it was cut around; None if unknown.
    """

    name: str
    source: str
    pixels: Image
    group: str = ""
    is_target: bool | None = None
    clean: Image | None = None
    place: ObjectPlace | None = None


@dataclass(frozen=True)
class ImageSet:
    """The images of one run.

    Attributes:
        origin: Description of where they are from.
        images: At least one.
        rejected: One line for each file that cannot be used, with the reason.
        notes: One line for each conversion of an image.
    """

    origin: str
    images: tuple[SampleImage, ...]
    rejected: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def read_image_folder(folder: Path, fit: Fit = "refuse") -> ImageSet:
    """Read every JPEG, PNG and TIFF in a folder and its subfolders, in order of their paths, as grey of 8 bits.

    Files that cannot be measured on (damage, a side outside 16..512 px unless `fit` changes it) are rejected and
    listed, and so are other files. 16-bit images are mapped to 8 bits as the codecs do. Links to folders are not
    followed.

    Raises:
        SurveyFileError: Not a folder, not readable, or without a usable image.
    """
    found = list_images(folder, recursive=True)
    images: list[SampleImage] = []
    rejected: list[str] = []
    notes: list[str] = []
    for path in found.images:
        name = str(path.relative_to(folder))
        try:
            read = read_any_image(path)
            fitted = fit_image(read.pixels, fit, str(path))
        except BadInputError as error:
            rejected.append(str(error))
            continue
        images.append(SampleImage(name, name, to_uint8(fitted.pixels)))
        notes += [f"{path}: {note}" for note in (*read.notes, *fitted.notes)]
    if not images:
        expected = f"at least one {', '.join(IMAGE_SUFFIXES)} (the first one rejected is {rejected[0]})"
        raise SurveyFileError(str(folder), "images", f"none, {len(rejected)} rejected", expected)
    return ImageSet(str(folder), tuple(images), (*rejected, *found.unused), tuple(notes))


def simulated_images(count: int, seed: int = 0, side_px: int = 80, *, with_scenes: bool = False) -> ImageSet:
    """Cut images from simulated surveys over every kind of seabed, half of them with a mine-like object.

    Each image is cut at the resolution of the survey around a mine-like object, another object, or (every fourth of
    the others) bare seabed. It is mapped to grey like the snippets of the detector.

    Args:
        count: Number of images, 1..100,000.
        seed: The same values give the same images.
        side_px: Side of the square images, 16..500 px.
        with_scenes: Whether to simulate each survey without speckle as well, for `clean` and `place`.

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
        images += _cut_simulated(spec, side_px, with_scenes=with_scenes)
    return ImageSet(f"simulated surveys, seed {seed}", tuple(images[:count]))


def _cut_simulated(spec: SurveySpec, side_px: int, *, with_scenes: bool) -> list[SampleImage]:
    simulated = simulate_survey(spec)
    without_speckle = simulate_survey(spec, speckle=False).survey if with_scenes else None
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
        is_bare_seabed = False
        if not thing.is_mine_like:
            others += 1
            is_bare_seabed = others % 4 == 0
            if is_bare_seabed:
                row, column = int(rng.integers(0, rows)), int(rng.integers(columns // 3, columns))
        top = min(max(row - side_px // 2, 0), rows - side_px)
        left = min(max(column - side_px // 2, 0), columns - side_px)
        window = waterfall[top : top + side_px, left : left + side_px]
        grey = to_grey(window.astype(np.uint32), np.ones(window.shape, dtype=np.bool_))
        name = f"{line} {number}"
        clean, place = None, None
        if without_speckle is not None:
            scene = without_speckle.waterfall(thing.side)[top : top + side_px, left : left + side_px]
            clean = grey_on_scale(scene, window)
            altitude_m = simulated.survey.pings[thing.ping].altitude_m
            if not is_bare_seabed and altitude_m is not None:
                place = place_in_window(thing, spec, altitude_m, top, left)
        images.append(SampleImage(name, name, grey, line, thing.is_mine_like, clean, place))
    # Alternating, so that the first images of the set contain both kinds.
    targets = [image for image in images if image.is_target]
    rest = [image for image in images if not image.is_target]
    return [image for pair in zip(targets, rest, strict=True) for image in pair]


def grey_on_scale(values: npt.NDArray[np.float32], scale: npt.NDArray[np.float32]) -> Image:
    """Map file values to grey as `to_grey` maps them, with the percentiles of `scale`.

    Args:
        values: Shape (rows, columns), not negative.
        scale: File values whose grey scale is used, of any shape.
    """
    low, high = np.percentile(np.sqrt(scale.astype(np.float64)), (LOW_PERCENTILE, HIGH_PERCENTILE))
    if high <= low:
        return np.full(values.shape, 128, dtype=np.uint8)
    scaled = 255.0 * (np.sqrt(values.astype(np.float64)) - low) / (high - low)
    return np.asarray(np.clip(np.rint(scaled), 0, 255), dtype=np.uint8)


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


def missing_data(path: Path, found: str) -> SurveyFileError:
    """Return the error for recordings that are not there, which says where to get them."""
    return SurveyFileError(str(path), "", found, "recordings; research/README.md#data states where to get them")


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
        raise missing_data(path, error.strerror or str(error)) from error
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
    pixels = to_uint8(read_image(path))
    if pixels.shape != (TILE_PX, TILE_PX):
        size = f"{pixels.shape[1]} × {pixels.shape[0]} px"
        raise SurveyFileError(str(path), "size", size, f"{TILE_PX} × {TILE_PX} px")
    return PillowImage.fromarray(pixels)
