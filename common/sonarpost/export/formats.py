"""The formats of exports by the end of a file name. Each has one writer, for `sonarpost c2 export` and the console."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, Final

from sonarpost.errors import BadInputError
from sonarpost.export.contacts import ExportContact
from sonarpost.export.geo.geopackage import write_geopackage
from sonarpost.export.geo.kml import write_kml, write_kmz
from sonarpost.export.source import ExportSource, StoredImages
from sonarpost.export.tables import write_csv, write_geojson
from sonarpost.files import atomic_file
from sonarpost.registry import Registry


@dataclass(frozen=True, slots=True)
class Format:
    """A format.

    Attributes:
        write: Function that writes it to a seekable binary file.
        media_type: Media type of the file.
        label: Its name in the console, where that has no text of its own; empty: the console does not offer it.
    """

    write: Callable[[IO[bytes], ExportSource], None]
    media_type: str
    label: str = ""


_CORE: Final[Mapping[str, Format]] = {
    "geojson": Format(write_geojson, "application/geo+json", "GeoJSON"),
    "kml": Format(write_kml, "application/vnd.google-earth.kml+xml"),
    "kmz": Format(write_kmz, "application/vnd.google-earth.kmz", "KMZ"),
    "csv": Format(write_csv, "text/csv; charset=utf-8", "CSV"),
    "gpkg": Format(write_geopackage, "application/geopackage+sqlite3", "GeoPackage"),
}


@cache
def exporters() -> Registry[Format]:
    """Return the formats: see `sonarpost.registry`. The group of entry points is `sonarpost.exporters`."""
    expected = "a sonarpost.export.formats.Format"
    return Registry("sonarpost.exporters", expected, lambda found, _: isinstance(found, Format), _CORE)


def write_export(name: str, path: Path, contacts: Iterable[ExportContact]) -> list[BadInputError]:
    """Write contacts from the folder of c2 to a file, atomically.

    Args:
        name: The format, a name in `exporters`.
        path: The file.
        contacts: The contacts.

    Returns:
        One error for each image that cannot be read. Its contact is exported without an image.

    Raises:
        ConfigError: There is no such format, or its plug-in cannot be imported.
        OSError: The file cannot be written.
    """
    images = StoredImages()
    with atomic_file(path) as file:
        exporters().get(name).write(file, ExportSource(contacts, images, path))
    return images.problems
