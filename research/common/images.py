"""The pictures a bench measures on: a folder of the user's, or contacts of simulated surveys."""

from __future__ import annotations

import io
import math
import os
import warnings
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
MAX_PICTURES: Final = 100_000

# Apart from the seeds of the shipped codebooks (7000 to 7051): nobody is tested on what was learnt.
_FIRST_SEED: Final = 910_000
_OBJECTS_A_LINE: Final = 6
_PINGS: Final = 500


@dataclass(frozen=True)
class BenchPicture:
    """A picture to measure on.

    Attributes:
        name: Names it in messages.
        source: What it was cut from: pictures of one source are alike, so chance is drawn among sources.
        pixels: Shape (16..512, 16..512), uint8.
        group: Survey line, where it is known.
        is_target: Whether it shows a target; None where nobody says.
    """

    name: str
    source: str
    pixels: Image
    group: str = ""
    is_target: bool | None = None


@dataclass(frozen=True)
class PictureSet:
    """The pictures of one run.

    Attributes:
        origin: Where they are from, for people.
        pictures: At least one.
        refused: One line for each file that was left out, and why.
    """

    origin: str
    pictures: tuple[BenchPicture, ...]
    refused: tuple[str, ...] = ()


def read_folder(folder: Path) -> PictureSet:
    """Read every grey PNG, JPEG and TIFF below a folder, in order of their paths.

    Files that cannot be measured on (a side outside 16..512 px, colour, damage) are refused and listed. 16-bit pictures
    are mapped to 8 bits as the codecs do.

    Args:
        folder: Searched with its subfolders; links to folders are not followed.

    Raises:
        SurveyFileError: It is no folder, cannot be listed, or has no picture that can be measured on.
    """
    if not folder.is_dir():
        raise SurveyFileError(str(folder), "", "not a folder or absent", "a folder of PNG, JPEG or TIFF pictures")
    pictures: list[BenchPicture] = []
    refused: list[str] = []
    for path in _picture_paths(folder):
        name = str(path.relative_to(folder))
        try:
            pictures.append(BenchPicture(name, name, _read_measurable(path)))
        except SurveyFileError as error:
            refused.append(str(error))
    if not pictures:
        expected = f"at least one grey {', '.join(SUFFIXES)} of {MIN_SIDE_PX}..{MAX_SIDE_PX} px a side"
        if refused:
            expected += f" (the first refused is {refused[0]})"
        raise SurveyFileError(str(folder), "pictures", f"none, {len(refused)} refused", expected)
    return PictureSet(str(folder), tuple(pictures), tuple(refused))


def simulated_pictures(count: int, seed: int = 0, side_px: int = 80) -> PictureSet:
    """Cut pictures from simulated surveys over every kind of bottom, half of them with a mine-like object.

    Each is cut at the survey's own resolution around a mine-like object, another object, or (every fourth of the
    others) bare bottom, and mapped to grey as the detector's snippets are.

    Args:
        count: How many, 1..100,000.
        seed: Source of every chance; the same values give the same pictures.
        side_px: Side of the square pictures, 16..500 px.

    Raises:
        ConfigError: A number out of range.
    """
    if not 1 <= count <= MAX_PICTURES:
        raise ConfigError("research", "simulated pictures", count, f"1..{MAX_PICTURES}")
    if not MIN_SIDE_PX <= side_px <= _PINGS:
        raise ConfigError("research", "crop", side_px, f"{MIN_SIDE_PX}..{_PINGS} px")
    kinds = tuple(SeabedKind)
    lines = math.ceil(count / (2 * _OBJECTS_A_LINE))
    pictures: list[BenchPicture] = []
    for line in range(lines):
        spec = SurveySpec(
            seed=_FIRST_SEED + 10_000 * seed + line,
            pings=_PINGS,
            seabed=kinds[line % len(kinds)],
            targets=_OBJECTS_A_LINE,
            clutter=_OBJECTS_A_LINE,
        )
        pictures += _cut_simulated(spec, side_px)
    return PictureSet(f"simulated surveys, seed {seed}", tuple(pictures[:count]))


def _cut_simulated(spec: SurveySpec, side_px: int) -> list[BenchPicture]:
    simulated = simulate_survey(spec)
    rng = np.random.default_rng(spec.seed)
    views = {side: simulated.survey.waterfall(side) for side in simulated.survey.sides()}
    line = simulated.survey.line_name
    pictures = []
    others = 0
    for number, thing in enumerate(simulated.truth):
        view = views[thing.side]
        down, right = (int(v) for v in rng.integers(-side_px // 10, side_px // 10 + 1, 2))
        row, column = thing.ping + down, thing.sample_index + side_px // 8 + right
        if not thing.is_mine_like:
            others += 1
            if others % 4 == 0:
                row, column = int(rng.integers(0, view.shape[0])), int(rng.integers(view.shape[1] // 3, view.shape[1]))
        top = min(max(row - side_px // 2, 0), view.shape[0] - side_px)
        left = min(max(column - side_px // 2, 0), view.shape[1] - side_px)
        window = view[top : top + side_px, left : left + side_px]
        grey = to_grey(window.astype(np.uint32), np.ones(window.shape, dtype=np.bool_))
        name = f"{line} {number}"
        pictures.append(BenchPicture(name, name, grey, line, thing.is_mine_like))
    # Mine-like and others by turns, so that any number of pictures taken from the front has both.
    mines = [p for p in pictures if p.is_target]
    rest = [p for p in pictures if not p.is_target]
    return [p for pair in zip(mines, rest, strict=True) for p in pair]


def _picture_paths(folder: Path) -> list[Path]:
    def refuse(error: OSError) -> None:
        raise SurveyFileError(str(folder), "", error.strerror or str(error), "folders that can be listed") from error

    paths = [
        Path(place) / name
        for place, _, names in os.walk(folder, onerror=refuse)
        for name in names
        if Path(name).suffix.lower() in SUFFIXES
    ]
    if len(paths) > MAX_PICTURES:
        raise SurveyFileError(str(folder), "pictures", len(paths), f"at most {MAX_PICTURES}")
    return sorted(paths)


def _read_measurable(path: Path) -> Image:
    pixels = to_uint8(read_jpeg(path) if path.suffix.lower() in JPEG_SUFFIXES else read_image(path))
    for field, value in (("height", pixels.shape[0]), ("width", pixels.shape[1])):
        if not MIN_SIDE_PX <= value <= MAX_SIDE_PX:
            raise SurveyFileError(str(path), field, f"{value} px", f"{MIN_SIDE_PX}..{MAX_SIDE_PX} px")
    return pixels


def read_jpeg(path: Path) -> Image:
    """Read a grey JPEG (or one whose three channels are equal).

    Returns:
        Shape (rows, columns), uint8.

    Raises:
        SurveyFileError: It cannot be read, is damaged, too large, or in colour.
    """
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise SurveyFileError(str(path), "file size", path.stat().st_size, f"at most {MAX_FILE_BYTES} bytes")
        raw = path.read_bytes()
    except OSError as error:
        raise SurveyFileError(str(path), "", error.strerror or str(error), "a readable picture") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with PillowImage.open(io.BytesIO(raw), formats=["JPEG"]) as picture:
                size = picture.size
                small = size[0] * size[1] <= MAX_PIXELS  # what it declares, before anything is decoded
                pixels = np.asarray(picture, dtype=np.uint8) if small else np.empty(0, dtype=np.uint8)
    except Exception as error:  # Pillow raises OSError, SyntaxError, ValueError, struct.error, ...
        raise SurveyFileError(str(path), "JPEG data", str(error), "an undamaged JPEG") from error
    if not small:
        raise SurveyFileError(str(path), "size", f"{size[0]} x {size[1]}", f"at most {MAX_PIXELS} pixels")
    if pixels.ndim == 3 and pixels.shape[2] == 3 and (pixels == pixels[..., :1]).all():
        pixels = pixels[..., 0]
    if pixels.ndim != 2:
        raise SurveyFileError(str(path), "colour", f"{pixels.shape}", "a grey picture")
    return np.ascontiguousarray(pixels)
