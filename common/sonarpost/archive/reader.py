"""Reads the archive of a shore site, in files or in PostgreSQL, with the same methods."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from sonarpost.archive.address import SCHEME, DatabaseAddress
from sonarpost.archive.image_files import SUFFIXES
from sonarpost.archive.rows import DecisionRow, ImageRow
from sonarpost.archive.shore_files import decision_name

if TYPE_CHECKING:
    from sonarpost.archive.shore_archive import ShoreArchive

ArchivePlace = Path | DatabaseAddress
"""Folder of c2, or address of its database."""
COMMAND_TIMEOUT_S = 60.0
PART_IMAGES = 64
"""Number of images in one part of a database."""


def place_of(text: str, where: str) -> ArchivePlace:
    """Return the folder or the database that an option of a command names.

    Raises:
        ConfigError: The address of the database is invalid.
    """
    return DatabaseAddress.parse(text, where=where) if text.startswith(SCHEME) else Path(text)


def open_archive(
    place: ArchivePlace, *, site: str = "", owner: str = "", timeout_s: float = 5.0, writable: bool = True
) -> ShoreArchive:
    """Return an archive; it is opened when it is first used.

    Args:
        place: Folder or address of the archive.
        site: Name of the site; empty for any.
        owner: Identity of this c2 among those that share a database.
        timeout_s: Time limit to connect to a server, and to wait for its answer.
        writable: Whether to create the archive.

    Raises:
        ConfigError: There is no driver for the server.
    """
    # Imported here: they take 0.3 s, and few commands need them.
    from sonarpost.archive.database import SqliteDatabase  # noqa: PLC0415
    from sonarpost.archive.postgresql import PostgresDatabase  # noqa: PLC0415
    from sonarpost.archive.shore_archive import ShoreArchive  # noqa: PLC0415

    if isinstance(place, Path):
        return ShoreArchive(SqliteDatabase(place, site=site, writable=writable), place)
    return ShoreArchive(PostgresDatabase(place, timeout_s, site=site, writable=writable), owner=owner)


@contextmanager
def open_reader(place: ArchivePlace, *, writable: bool = False) -> Iterator[ShoreArchive]:
    """Open an existing archive, for a command.

    Args:
        place: Folder or address of the archive.
        writable: Whether `mark` is called; a database can always be marked.

    Raises:
        StoredFileError: There is no archive of this version.
        DeliveryError, OSError: It cannot be read.
    """
    if isinstance(place, DatabaseAddress):
        writable = False
    elif writable:
        with open_reader(place):
            pass  # there is one
    archive = open_archive(place, timeout_s=COMMAND_TIMEOUT_S, writable=writable)
    with closing(archive):
        archive.database.prepare()
        yield archive


def read_image_files(place: ArchivePlace, row: ImageRow) -> dict[str, bytes]:
    """Return the files of an image by name.

    Raises:
        StoredFileError: A file is missing or cannot be read.
        DatabaseUnavailableError: The server is not reached.
    """
    with open_reader(place) as archive:
        return {f"{row.name}{suffix}": data for suffix, data in archive.read_files(row.vessel_id, row.name).items()}


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
    with open_reader(place) as archive, tempfile.TemporaryDirectory(prefix="sonarpost-archive-") as name:
        _copy(archive, archive.images(), archive.decisions(), Path(name), suffixes)
        yield Path(name)


def archive_parts(place: ArchivePlace) -> Iterator[Path]:
    """Yield the archive as folders, one after the other: the folder itself, or copies of parts of a database.

    Raises:
        StoredFileError: The database has no archive of this version.
        DeliveryError, OSError: It cannot be read, or the copy cannot be written.
    """
    if isinstance(place, Path):
        yield place
        return
    with open_reader(place) as archive:
        rows = archive.images()
        for first in range(0, len(rows) + 1, PART_IMAGES):
            part = rows[first : first + PART_IMAGES]
            is_last = first + PART_IMAGES > len(rows)
            with tempfile.TemporaryDirectory(prefix="sonarpost-archive-") as name:
                _copy(archive, part, archive.decisions() if is_last else (), Path(name), SUFFIXES)
                yield Path(name)


def _copy(
    archive: ShoreArchive,
    images: Iterable[ImageRow],
    decisions: Iterable[DecisionRow],
    folder: Path,
    suffixes: Collection[str],
) -> None:
    names = [(row.vessel_id, row.name, [s for s in SUFFIXES if s in suffixes]) for row in images]
    names += [(row.vessel_id, decision_name(row.decision_id), [SUFFIXES[0]]) for row in decisions]
    for vessel_id, name, wanted in names:
        for suffix, content in archive.read_files(vessel_id, name, wanted).items():
            path = folder / vessel_id / f"{name}{suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
