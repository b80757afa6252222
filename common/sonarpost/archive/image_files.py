"""Files of a reconstructed image: TIFF, JSON side-car and PNG, with the same pixels on every platform.

Different images can have the same file name: the time in it has whole seconds, and a producer can repeat identifiers.
The first one keeps the plain name. Each further one has a digest of its side-car appended, so that none replaces
another.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Set
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from pydantic import ValidationError

from sonarpost.archive.retention import remove_files, vehicle_source
from sonarpost.errors import StoredFileError
from sonarpost.export.contacts import ImageSideCar, mask_of_runs
from sonarpost.export.contacts import side_car as side_car_fields
from sonarpost.files import AtomicFiles
from sonarpost.messages import Pixels, ReconstructedImage
from sonarpost.sonar.image_decoding import GreyImage
from sonarpost.sonar.image_files import png_bytes, tiff_bytes
from sonarpost.wire import first_error

DIGEST_CHARACTERS = 16


PREVIEW_NOTE = "preview from a short message"
"""Note of an image of which a short message has brought the beginning."""


class WrittenImage(NamedTuple):
    """Result of `write_image`.

    Attributes:
        tiff: Path of the TIFF file; the other two files differ in the suffix.
        is_new: Whether the image was not stored before.
        is_conflict: Whether another image has the plain file name.
    """

    tiff: Path
    is_new: bool
    is_conflict: bool


# The side-car first: if it exists, the others are complete.
SUFFIXES = (".json", ".tiff", ".png")


def image_file_name(image: ReconstructedImage | ImageSideCar) -> str:
    """Return the plain file name without suffix: vehicle, time of the first frame, image identifier, version.

    The time distinguishes images of a later mission, if the vehicle has restarted its identifiers.
    """
    first = datetime.fromtimestamp(image.first_frame_utc_s, UTC).strftime("%Y%m%dT%H%M%SZ")
    return f"{image.vehicle_id}_{first}_{image.image_id}_v{image.version}"


def is_superseded(name: str, names: Set[str]) -> bool:
    """Return whether a later version is among the file names without suffix."""
    base, _, version = name.rpartition("_v")
    return version.isdecimal() and f"{base}_v{int(version) + 1}" in names


def remove_old_images(folder: Path, now_utc_s: float, retain_days: float, max_bytes: int) -> list[str]:
    """Remove the files of images by age and total size; return their names without suffix.

    Because of the total size, the vehicle with the most bytes loses images first, superseded versions before others.

    Raises:
        OSError: The folder cannot be read, or a file cannot be deleted.
    """
    return remove_files(
        folder,
        SUFFIXES,
        now_utc_s,
        retain_days,
        max_bytes,
        order=lambda name, names: 0 if is_superseded(name, names) else 1,
        source=lambda name: vehicle_source(name.partition("_")[0]),
    )


def side_car_text(image: ReconstructedImage) -> bytes:
    """Return the content of the JSON file as bytes."""
    return (json.dumps(side_car_fields(image), indent=1) + "\n").encode()


def stored_image(content: bytes, pixels: GreyImage, where: str) -> ReconstructedImage:
    """Return the record of stored files, which is the record that they were written from.

    Args:
        content: Content of the JSON file.
        pixels: Pixels of the TIFF file, shape (rows, columns), uint8 or uint16.
        where: Name of the JSON file for errors.

    Raises:
        BadInputError: The JSON file is invalid, or the files do not match.
    """
    try:
        stored = ImageSideCar.model_validate_json(content)
        mask = mask_of_runs(stored.missing_runs, stored.height_px, stored.width_px)
        fields = stored.model_dump(exclude={"type", "v", "height_px", "width_px", "missing_runs"})
        return ReconstructedImage(**fields, pixels=Pixels.from_array(pixels), missing_mask=mask)
    except ValidationError as error:
        raise StoredFileError(where, *first_error(error)) from error
    except ValueError as error:
        raise StoredFileError(
            where, "missing_runs", stored.missing_runs, f"the mask of its pixels ({error})"
        ) from error


def other_name(name: str, text: bytes) -> str:
    """Return the file name without suffix of an image whose plain name belongs to another image.

    Args:
        name: Plain file name without suffix.
        text: Content of the JSON file.
    """
    return f"{name}_{hashlib.sha256(text).hexdigest()[:DIGEST_CHARACTERS]}"


def write_image(folder: Path, image: ReconstructedImage) -> WrittenImage:
    """Write the three files of an image; files of the same and of other images are not changed.

    The JSON file is written last: if it exists, the other two are complete.

    Raises:
        OSError: The folder cannot be written, for example because of a full disk.
    """
    text = side_car_text(image)
    plain = folder / f"{image_file_name(image)}.json"
    other = plain.with_name(f"{other_name(plain.stem, text)}.json")
    for path in (plain, other):
        if _content(path) == text and all(path.with_suffix(suffix).is_file() for suffix in (".tiff", ".png")):
            return WrittenImage(path.with_suffix(".tiff"), is_new=False, is_conflict=path == other)
    is_conflict = other.exists() or _is_other_image(_content(plain), image, text)
    side_car = other if is_conflict else plain
    tiff, png = side_car.with_suffix(".tiff"), side_car.with_suffix(".png")
    folder.mkdir(parents=True, exist_ok=True)
    pixels = image.pixels.to_array()
    files = AtomicFiles()
    try:
        files.add(tiff, tiff_bytes(tiff, pixels))
        files.add(png, png_bytes(png, pixels))
        files.add(side_car, text, last=True)
        files.commit()
    finally:
        files.drop_from(0)
    return WrittenImage(tiff, is_new=True, is_conflict=is_conflict)


def _content(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None


def _is_other_image(content: bytes | None, image: ReconstructedImage, text: bytes) -> bool:
    """Return whether a side-car belongs to another image; an unreadable one is written again."""
    if content is None or content == text:
        return False
    try:
        fields = json.loads(content)
    except ValueError:
        return False
    return isinstance(fields, dict) and fields.get("type") == image.TYPE


def same_version(fields: Mapping[str, object], image: ReconstructedImage) -> bool:
    """Return whether a side-car belongs to the same version of the same image, by identifiers and time."""
    names = ("vessel_id", "vehicle_id", "image_id", "version", "first_frame_utc_s")
    return all(fields.get(name) == getattr(image, name) for name in names)
