"""What an export is written from: contacts, read once, and their images, one at a time in memory."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import IO, Final, Protocol

import numpy as np
import numpy.typing as npt

from sonarpost.errors import BadInputError, StoredFileError
from sonarpost.export.contacts import ExportContact
from sonarpost.files import read_regular
from sonarpost.review.true_scale import ImageLine
from sonarpost.sonar.image_files import read_image

MAX_IMAGE_BYTES: Final = 1 << 26
"""A larger image file is omitted and reported."""

_SPOOL_BYTES: Final = 1 << 20

GreyImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class ContactImage:
    """Image of a contact to export.

    Attributes:
        pixels: Shape (rows, columns).
        missing: Same shape, true for pixels that were not received; None if unknown.
        lines: Measured lines to draw.
    """

    pixels: GreyImage
    missing: npt.NDArray[np.bool_] | None = None
    lines: tuple[ImageLine, ...] = ()


class ContactImages(Protocol):
    """Images of the contacts of an export, each asked for before the next contact is read."""

    def image(self, contact: ExportContact) -> ContactImage | None:
        """Return the image of a contact; None if it has none."""

    def png(self, contact: ExportContact) -> bytes | None:
        """Return the image of a contact as PNG; None if it has none."""


class StoredImages:
    """Images in the files of c2. An unreadable file counts as no image.

    Attributes:
        problems: One error for each unreadable file.
    """

    def __init__(self) -> None:
        self.problems: list[BadInputError] = []

    def image(self, contact: ExportContact) -> ContactImage | None:
        """Return the image of a contact; None if it has none."""
        try:
            return None if contact.image_path is None else ContactImage(read_image(contact.image_path))
        except BadInputError as error:
            self.problems.append(error)
            return None

    def png(self, contact: ExportContact) -> bytes | None:
        """Return the PNG file of a contact; None if it has none."""
        path = contact.image_path
        if path is None:
            return None
        try:
            return read_regular(path, MAX_IMAGE_BYTES)
        except OSError as error:
            self.problems.append(StoredFileError(str(path), "", error.strerror or str(error), "a readable PNG"))
            return None


@dataclass(frozen=True, slots=True)
class ExportSource:
    """What an export is written from.

    Attributes:
        contacts: The contacts, read once and in order.
        images: Their images.
        path: The file to write. Temporary files are in its folder; a data package is named after it.
    """

    contacts: Iterable[ExportContact]
    images: ContactImages
    path: Path

    def temporary_file(self) -> IO[bytes]:
        """Return an empty file without a name for a part of the export; a small one is in memory."""
        return SpooledTemporaryFile(_SPOOL_BYTES, dir=str(self.path.parent))


def archive_entry(name: str) -> zipfile.ZipInfo:
    """Return an entry of a ZIP archive with a constant time, so that equal contacts give equal bytes."""
    entry = zipfile.ZipInfo(name)
    # Images are already compressed.
    entry.compress_type = zipfile.ZIP_STORED if name.endswith((".jpg", ".png")) else zipfile.ZIP_DEFLATED
    entry.external_attr = 0o644 << 16
    return entry
