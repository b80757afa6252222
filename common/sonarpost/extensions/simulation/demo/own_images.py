"""Images of the user as input of the demo: what is used, what is converted, what is left out and why."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from sonarpost.codec.fitting import Fit, fit_image
from sonarpost.errors import BadInputError, SurveyFileError
from sonarpost.sonar.image_decoding import read_any_image
from sonarpost.sonar.image_files import SIDE_CAR_SUFFIX, list_images
from sonarpost.sonar.side_car import read_side_car


def usable_images(source: Path, fit: Fit, console: Console) -> tuple[Path, ...]:
    """Return the images that the vehicle can send; print conversions and unused files.

    Args:
        source: An image or a folder of images, each with a side-car or without.
        fit: What the vehicle does with an image outside 16..512 px a side.
        console: Output.

    Raises:
        BadInputError: There is no such file or folder, or no image that can be sent.
    """
    images: tuple[Path, ...] = (source,)
    lines: list[str] = []
    if not source.exists():
        raise SurveyFileError(str(source), "", "no such file or folder", "an image or a folder of images")
    if source.is_dir():
        found = list_images(source)
        images = found.images
        lines += found.unused
    usable: list[Path] = []
    first_error: BadInputError | None = None
    for path in images:
        try:
            lines += [f"{path}: {note}" for note in _notes(path, fit)]
            usable.append(path)
        except BadInputError as error:
            first_error = first_error or error
            lines.append(f"not used: {error}")
    if first_error is not None and not usable:
        raise first_error
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    return tuple(usable)


def _notes(path: Path, fit: Fit) -> tuple[str, ...]:
    """Return what is converted in an image, and what is ignored in its side-car."""
    image = read_any_image(path)
    notes = image.notes + fit_image(image.pixels, fit, str(path)).notes
    side_car = path.with_suffix(SIDE_CAR_SUFFIX)
    return notes + (read_side_car(side_car, "check", "uuv-1").notes if side_car.is_file() else ())
