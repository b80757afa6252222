"""Image files: JPEG, PNG and TIFF are read as grey; TIFF is written as the record, PNG for display."""

from __future__ import annotations

import io
import os
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import tifffile
from PIL import Image

from sonarpost.errors import SurveyFileError
from sonarpost.files import write_atomically
from sonarpost.sonar.image_decoding import EXPECTED, GreyImage, read_any_image

IMAGE_SUFFIXES: Final = (".tif", ".tiff", ".png", ".jpg", ".jpeg")
SIDE_CAR_SUFFIX: Final = ".txt"
MAX_UNUSED_LINES: Final = 10
MAX_IMAGES: Final = 100_000


def read_image(path: Path) -> GreyImage:
    """Read an image that is grey of 8 or 16 bits already; `image_decoding.read_any_image` converts others.

    RGB with three equal channels is grey.

    Returns:
        Shape (rows, columns), uint8 or uint16 as in the file; 0 is black (a white-is-zero TIFF is inverted).

    Raises:
        SurveyFileError: Not a readable image, or one that has to be converted.
    """
    decoded = read_any_image(path)
    if decoded.notes:
        raise SurveyFileError(str(path), "pixels", "; ".join(decoded.notes), "grey of 8 or 16 bits without conversion")
    return decoded.pixels


@dataclass(frozen=True)
class ImageFolder:
    """The images of a folder.

    Attributes:
        images: Files with a suffix of `IMAGE_SUFFIXES`, sorted; at least one.
        side_cars: Text files `NAME.txt` beside an image of that name.
        unused: A line with the reason for each other file; above `MAX_UNUSED_LINES` one for each suffix.
    """

    images: tuple[Path, ...]
    side_cars: tuple[Path, ...]
    unused: tuple[str, ...]


def list_images(folder: Path, *, recursive: bool = False, ignore: Collection[Path] = ()) -> ImageFolder:
    """List the images of a folder and what else is in it. Links to folders are not followed.

    Args:
        folder: The folder.
        recursive: Whether subfolders are searched.
        ignore: Subfolders that are not mentioned: output folders.

    Raises:
        SurveyFileError: Not a readable folder, without an image, or with more than `MAX_IMAGES`.
    """
    images: list[Path] = []
    others: list[tuple[Path, str]] = []

    def fail(error: OSError) -> None:
        raise SurveyFileError(str(folder), "", error.strerror or str(error), "readable folders") from error

    if not folder.is_dir():
        raise SurveyFileError(str(folder), "", "no such folder", "a folder of JPEG, PNG or TIFF images")
    for place, subfolders, names in os.walk(folder, onerror=fail):
        for path in (Path(place) / name for name in names):
            reason = _unused_reason(path)
            if reason:
                others.append((path, reason))
            else:
                images.append(path)
        if not recursive:
            found = (path for path in (Path(place) / name for name in subfolders) if path not in ignore)
            others += ((path, "a folder, not searched") for path in found)
            subfolders.clear()
    stems = {path.with_suffix("") for path in images}
    is_side_car = [path.suffix == SIDE_CAR_SUFFIX and path.with_suffix("") in stems for path, _ in others]
    side_cars = [path for (path, _), taken in zip(others, is_side_car, strict=True) if taken]
    unused = unused_lines(folder, [other for other, taken in zip(others, is_side_car, strict=True) if not taken])
    if not 1 <= len(images) <= MAX_IMAGES:
        expected = f"1 to {MAX_IMAGES} files ending in {', '.join(IMAGE_SUFFIXES)}"
        only = ", ".join(path.name for path, _ in sorted(others)[:MAX_UNUSED_LINES])
        raise SurveyFileError(str(folder), "images", len(images), expected + (f" (only {only})" if only else ""))
    return ImageFolder(tuple(sorted(images)), tuple(sorted(side_cars)), unused)


def unused_lines(folder: Path, unused: Sequence[tuple[Path, str]]) -> tuple[str, ...]:
    """Return a line for each file and its reason; above `MAX_UNUSED_LINES` one for each suffix and reason."""
    if len(unused) <= MAX_UNUSED_LINES:
        return tuple(f"{path}: not used: {reason}" for path, reason in sorted(unused))
    counts = Counter((path.suffix.lower() or "no suffix", reason) for path, reason in unused)
    return tuple(f"{folder}: {count} not used ({suffix}): {why}" for (suffix, why), count in sorted(counts.items()))


def _unused_reason(path: Path) -> str:
    if path.name.startswith("."):
        return "hidden"
    if path.suffix.lower() not in IMAGE_SUFFIXES:
        return "not " + EXPECTED
    return "" if path.is_file() else "not a regular file"


def write_tiff(path: Path, image: GreyImage) -> None:
    """Write a grey image as TIFF, atomically, with lossless compression (deflate), which common readers support.

    The image has shape (rows, columns), uint8 or uint16.

    Raises:
        SurveyFileError: Another shape or depth.
        OSError: The file cannot be written.
    """
    write_atomically(path, tiff_bytes(path, image))


def tiff_bytes(path: Path, image: GreyImage) -> bytes:
    """Return the bytes that `write_tiff` writes; `path` is for error messages only.

    Raises:
        SurveyFileError: Another shape or depth.
    """
    _check_writable(path, image)
    buffer = io.BytesIO()
    tifffile.imwrite(
        buffer,
        image,
        byteorder="<",
        photometric="minisblack",
        compression="zlib",
        software=False,  # a version number would make the bytes depend on the installation
        datetime=None,
        metadata=None,
    )
    return buffer.getvalue()


def write_png(path: Path, image: GreyImage) -> None:
    """Write a grey image as PNG, atomically, without dates.

    The image has shape (rows, columns), uint8 or uint16.

    Raises:
        SurveyFileError: Another shape or depth.
        OSError: The file cannot be written.
    """
    write_atomically(path, png_bytes(path, image))


def png_bytes(path: Path, image: GreyImage) -> bytes:
    """Return the bytes that `write_png` writes; `path` is for error messages only.

    Raises:
        SurveyFileError: Another shape or depth.
    """
    _check_writable(path, image)
    return encode_png(Image.fromarray(np.ascontiguousarray(image)))


def encode_png(image: Image.Image, compress_level: int = 6) -> bytes:
    """Return an image of Pillow as PNG, without dates; `compress_level` is that of zlib, 1 to 9."""
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", compress_level=compress_level)
    return buffer.getvalue()


def _check_writable(path: Path, image: GreyImage) -> None:
    if image.dtype not in (np.uint8, np.uint16):
        raise SurveyFileError(str(path), "depth", str(image.dtype), "uint8 or uint16")
    if image.ndim != 2 or 0 in image.shape:
        raise SurveyFileError(str(path), "shape", image.shape, "rows and columns, both at least 1")
