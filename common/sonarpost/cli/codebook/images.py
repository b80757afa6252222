"""The training images that a user names: folders and files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from sonarpost.codec.interface import to_uint8
from sonarpost.codec.vq.tiles import Tiles
from sonarpost.codec.vq.training_config import TrainingImage
from sonarpost.errors import SurveyFileError
from sonarpost.sonar.image_files import read_image

IMAGE_SUFFIXES = (".tiff", ".tif", ".png")


def training_images(sources: list[Path], console: Console) -> tuple[list[TrainingImage], int]:
    """Return the readable images of folders and files, sorted within each folder, and how many are not readable.

    The order decides what a codebook becomes. Images are read again when needed: a folder may hold more than memory.
    """
    images, failed = [], 0
    for path in _paths(sources):
        try:
            pixels = read_image(path)
        except SurveyFileError as error:
            failed += 1
            console.print(f"left out: {error}", markup=False)
            continue
        images.append(TrainingImage(f"{path} {pixels.shape} {pixels.dtype}", _loader(path)))
    return images, failed


def _paths(sources: list[Path]) -> list[Path]:
    paths: list[Path] = []
    for source in sources:
        if source.is_dir():
            paths += sorted(p for p in source.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())
        else:
            paths.append(source)
    return paths


def _loader(path: Path) -> Callable[[], Tiles]:
    return lambda: to_uint8(read_image(path))
