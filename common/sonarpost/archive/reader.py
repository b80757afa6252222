"""Reads the archive of a shore site, in files or in PostgreSQL, with the same methods."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Protocol

from sonarpost.archive.image_files import SUFFIXES
from sonarpost.archive.postgresql import SCHEME, ConnectionPool, DatabaseAddress
from sonarpost.archive.shore_database import ShoreDatabase
from sonarpost.archive.shore_files import decision_path, image_paths
from sonarpost.archive.shore_index import DecisionRow, ImageRow, MarkColumn, ShoreIndex, TaskingRow
from sonarpost.errors import StoredFileError
from sonarpost.files import read_regular
from sonarpost.sonar.image_decoding import MAX_FILE_BYTES

ArchivePlace = Path | DatabaseAddress
"""Folder of c2, or address of its database."""
COMMAND_TIMEOUT_S = 60.0
PART_IMAGES = 64
"""Number of images in one part of a database."""


class RecordReader(Protocol):
    """Rows of the stored records; `ShoreIndex` and `ShoreDatabase`."""

    def images(self, *, removed: bool = False) -> list[ImageRow]:
        """Return all versions of all images, oldest first; removed ones only if `removed`."""

    def decisions(self) -> list[DecisionRow]:
        """Return all decisions, oldest first."""

    def tasking(self) -> list[TaskingRow]:
        """Return all comments and commands, oldest first."""

    def mark(self, column: MarkColumn, images: Iterable[ImageRow], at_utc_s: float) -> None:
        """Mark images as exported or removed."""

    def close(self) -> None:
        """Close the index or the connections."""


def place_of(text: str, where: str) -> ArchivePlace:
    """Return the folder or the database that an option of a command names.

    Raises:
        ConfigError: The address of the database is invalid.
    """
    return DatabaseAddress.parse(text, where=where) if text.startswith(SCHEME) else Path(text)


@contextmanager
def open_reader(place: ArchivePlace, *, writable: bool = False) -> Iterator[RecordReader]:
    """Open the records of an archive.

    Args:
        place: Folder or address of the archive.
        writable: Whether `mark` is called; a database can always be marked.

    Raises:
        StoredFileError: There is no archive of this version.
        DeliveryError, OSError: It cannot be read.
    """
    if isinstance(place, Path):
        with closing(ShoreIndex(place, writable=writable)) as index:
            yield index
        return
    with closing(open_database(place)) as database:
        yield database


def open_database(address: DatabaseAddress) -> ShoreDatabase:
    """Open an existing archive in a database, for a command.

    Raises:
        StoredFileError: It has no archive of this version.
        DatabaseUnavailableError: The server is not reached.
    """
    database = ShoreDatabase(ConnectionPool(address, COMMAND_TIMEOUT_S), writable=False)
    database.prepare()
    return database


def read_image_files(place: ArchivePlace, row: ImageRow) -> dict[str, bytes]:
    """Return the files of an image by name.

    Raises:
        StoredFileError: A file is missing or cannot be read.
        DatabaseUnavailableError: The server is not reached.
    """
    if isinstance(place, Path):
        files = {}
        for path in image_paths(place, row):
            try:
                files[path.name] = read_regular(path, MAX_FILE_BYTES)
            except OSError as error:
                raise StoredFileError(str(path), "", error.strerror or str(error), "a readable file of c2") from error
        return files
    with closing(open_database(place)) as database:
        found = database.image_files(row.vessel_id, row.name)
    if not found:
        raise StoredFileError(str(place), "name", row.name, "an image whose files are stored")
    return {f"{row.name}{suffix}": content for suffix, content in found.items()}


@contextmanager
def as_folder(place: ArchivePlace, suffixes: Collection[str] = SUFFIXES) -> Iterator[Path]:
    """Return the archive as a folder of files, as c2 writes it; a database is copied to a temporary one.

    Args:
        place: Folder or address of the archive.
        suffixes: Suffixes of the files of images that are copied.

    Raises:
        StoredFileError: The database has no archive of this version.
        DeliveryError, OSError: It cannot be read, or the copy cannot be written.
    """
    if isinstance(place, Path):
        yield place
        return
    with (
        closing(open_database(place)) as database,
        tempfile.TemporaryDirectory(prefix="sonarpost-archive-") as name,
    ):
        folder = Path(name)
        for row in database.images():
            _copy_image(database, row, folder, suffixes)
        _copy_decisions(database, folder)
        yield folder


def archive_parts(place: ArchivePlace) -> Iterator[Path]:
    """Yield the archive as folders, one after the other: the folder itself, or copies of parts of a database.

    Raises:
        StoredFileError: The database has no archive of this version.
        DeliveryError, OSError: It cannot be read, or the copy cannot be written.
    """
    if isinstance(place, Path):
        yield place
        return
    with closing(open_database(place)) as database:
        rows = database.images()
        for first in range(0, len(rows), PART_IMAGES):
            with tempfile.TemporaryDirectory(prefix="sonarpost-archive-") as name:
                for row in rows[first : first + PART_IMAGES]:
                    _copy_image(database, row, Path(name), SUFFIXES)
                yield Path(name)
        with tempfile.TemporaryDirectory(prefix="sonarpost-archive-") as name:
            _copy_decisions(database, Path(name))
            yield Path(name)


def _copy_image(database: ShoreDatabase, row: ImageRow, folder: Path, suffixes: Collection[str]) -> None:
    (folder / row.vessel_id).mkdir(exist_ok=True)
    for suffix, content in database.image_files(row.vessel_id, row.name).items():
        if suffix in suffixes:
            (folder / row.vessel_id / f"{row.name}{suffix}").write_bytes(content)


def _copy_decisions(database: ShoreDatabase, folder: Path) -> None:
    for decision in database.decisions():
        path = decision_path(folder, decision.vessel_id, decision.decision_id)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(database.decision_content(decision))
