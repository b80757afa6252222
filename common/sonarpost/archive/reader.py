"""Reads the archive of a shore site, in files or in PostgreSQL, with the same methods."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from sonarpost.archive.address import SCHEME, DatabaseAddress
from sonarpost.archive.image_files import SUFFIXES
from sonarpost.archive.rows import ImageRow
from sonarpost.archive.shore_files import decision_name

if TYPE_CHECKING:
    from sonarpost.archive.shore_archive import ShoreArchive

ArchivePlace = Path | DatabaseAddress
"""Folder of c2, or address of its database."""
COMMAND_TIMEOUT_S = 60.0


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
    with open_reader(place) as archive, tempfile.TemporaryDirectory(prefix="sonarpost-archive-") as folder:
        wanted = [suffix for suffix in SUFFIXES if suffix in suffixes]
        names = [(row.vessel_id, row.name, wanted) for row in archive.images()]
        names += [(row.vessel_id, decision_name(row.decision_id), [SUFFIXES[0]]) for row in archive.decisions()]
        for vessel_id, name, wanted in names:
            for suffix, content in archive.read_files(vessel_id, name, wanted).items():
                path = Path(folder, vessel_id, f"{name}{suffix}")
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
        yield Path(folder)
