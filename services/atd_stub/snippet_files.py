"""Snippet files: an image with a text file beside it that has the fields of the contact."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sonarpost.codec.fitting import Fit, fit_image
from sonarpost.errors import StreamError, SurveyFileError
from sonarpost.messages import Contact, Pixels, Snippet
from sonarpost.services.atd_stub.input_folder import printable
from sonarpost.sonar.image_decoding import read_any_image
from sonarpost.sonar.image_files import SIDE_CAR_SUFFIX, write_tiff
from sonarpost.sonar.side_car import SideCar, read_side_car, write_side_car

SNIPPET_SUFFIXES: Final = (".txt", ".tiff")
"""Suffixes of the files of a snippet."""
MAX_PIXEL_M: Final = 100
"""Limit of the contact record."""
_UNSAFE_CHARACTER: Final = re.compile(r"[^A-Za-z0-9._-]")


def write_snippet(folder: Path, snippet: Snippet) -> Path:
    """Write a snippet as `CONTACT_ID.tiff` and, last, `CONTACT_ID.txt`; return the path of the TIFF.

    Raises:
        OSError: The folder cannot be made or written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tiff = folder / f"{_UNSAFE_CHARACTER.sub('_', snippet.contact.contact_id)}.tiff"
    write_tiff(tiff, snippet.pixels.to_array())
    write_side_car(tiff.with_suffix(SIDE_CAR_SUFFIX), snippet.contact)
    return tiff


@dataclass(frozen=True)
class SnippetFile:
    """A snippet and what was changed to make it from its file.

    Attributes:
        snippet: The snippet.
        notes: A phrase for each conversion of the image and each ignored line of the text file.
    """

    snippet: Snippet
    notes: tuple[str, ...]


def read_snippet(path: Path, content: str, vehicle_id: str, fit: Fit) -> SnippetFile:
    """Read an image as the snippet of a contact; a text file beside it has the fields of the contact.

    Args:
        path: The image, JPEG, PNG or TIFF.
        content: Hex SHA-256 of its content; part of the contact identifier where the text file has none.
        vehicle_id: This vehicle.
        fit: What to do with an image outside 16..512 px a side. A change of resolution changes the pixel size too.

    Raises:
        SurveyFileError: Not such an image, one that does not fit, or not such a text file.
    """
    image = read_any_image(path)
    try:
        fitted = fit_image(image.pixels, fit, str(path), 'fit = "{}"')
    except StreamError as error:
        raise SurveyFileError(error.where, error.field, error.value, error.expected) from error
    contact_id = f"{printable(path.stem)[:80]}-{content[:8]}"
    text = path.with_suffix(SIDE_CAR_SUFFIX)
    side_car = SideCar(Contact(contact_id=contact_id, vehicle_id=vehicle_id), ())
    if text.is_file():
        side_car = read_side_car(text, contact_id, vehicle_id)
    contact = side_car.contact.model_copy(
        update={
            "pixel_along_m": _scaled(side_car.contact.pixel_along_m, fitted.scale_along, text),
            "pixel_across_m": _scaled(side_car.contact.pixel_across_m, fitted.scale_across, text),
        }
    )
    snippet = Snippet(contact=contact, pixels=Pixels.from_array(fitted.pixels), source=printable(path.name))
    return SnippetFile(snippet, image.notes + fitted.notes + side_car.notes)


def _scaled(pixel_m: float | None, scale: float, path: Path) -> float | None:
    """Return the size of a pixel after a change of resolution."""
    if pixel_m is not None and not 0 < pixel_m * scale <= MAX_PIXEL_M:
        raise SurveyFileError(str(path), "pixel size", f"{pixel_m * scale:g} m", f"at most {MAX_PIXEL_M} m")
    return None if pixel_m is None else pixel_m * scale
