"""GeoPackage 1.3 (OGC 12-128r17): contacts as points with images and a style for QGIS.

The table `contacts` has one column for each of `tables.COLUMNS`, the geometry `geom` and the PNG `image`. The table
`layer_styles` has the form that QGIS reads.
"""

from __future__ import annotations

import errno
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import IO, Final

from sonarpost.export.contacts import ExportContact
from sonarpost.export.geo.kml import COLOURS
from sonarpost.export.source import ExportSource
from sonarpost.export.tables import COLUMNS, Value, contact_properties
from sonarpost.export.text import utc_text
from sonarpost.messages import Contact

_APPLICATION_ID: Final = 0x47504B47
_USER_VERSION: Final = 10300
_WGS84_WKT: Final = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433],AUTHORITY["EPSG","4326"]]'
)
_SCHEMA: Final = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL, min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE,
  srs_id INTEGER REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL UNIQUE REFERENCES gpkg_contents(table_name),
  column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL
  REFERENCES gpkg_spatial_ref_sys(srs_id), z TINYINT NOT NULL, m TINYINT NOT NULL,
  PRIMARY KEY (table_name, column_name));
"""
_STYLES: Final = """
CREATE TABLE layer_styles (id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, f_table_catalog TEXT(256),
  f_table_schema TEXT(256), f_table_name TEXT(256), f_geometry_column TEXT(256), styleName TEXT(30), styleQML TEXT,
  styleSLD TEXT, useAsDefault BOOLEAN, description TEXT, owner TEXT(30), ui TEXT(30), update_time DATETIME);
"""
_CONTENTS: Final = "INSERT INTO gpkg_contents VALUES (?, ?, ?, '', ?, ?, ?, ?, ?, ?)"
_INTEGERS: Final = ("version", "decided_version", "decisions", "image_height_px", "image_width_px")
_BOOLEANS: Final = ("image_complete", "authenticated")
_REALS: Final = ("_m", "_deg", "_confidence", "_fraction")


def _column_type(name: str) -> str:
    of_contact = str(Contact.model_fields[name].annotation) if name in Contact.model_fields else ""
    if name in _BOOLEANS or "bool" in of_contact:
        return "BOOLEAN"
    if name in _INTEGERS or "int" in of_contact:
        return "INTEGER"
    return "REAL" if name.endswith(_REALS) or "float" in of_contact else "TEXT"


def _point(contact: ExportContact) -> bytes | None:
    """Return the point as GeoPackage geometry: header without envelope, then WKB, longitude first."""
    if contact.position is None:
        return None
    lat_deg, lon_deg = contact.position
    return struct.pack("<2sBBiBIdd", b"GP", 0, 1, 4326, 1, 1, lon_deg, lat_deg)


def _style() -> str:
    """Return a QGIS style (QML) with one colour for each review state, as in KML."""
    categories = "".join(
        f'<category value="{state}" symbol="{state}" label="{state}" render="true"/>' for state in COLOURS
    )
    symbols = "".join(
        f'<symbol type="marker" name="{state}" alpha="1"><layer class="SimpleMarker" enabled="1">'
        f'<prop k="name" v="circle"/><prop k="color" v="{_rgba(colour)}"/><prop k="size" v="3"/></layer></symbol>'
        for state, colour in COLOURS.items()
    )
    return (
        '<qgis version="3.22"><renderer-v2 type="categorizedSymbol" attr="review">'
        f"<categories>{categories}</categories><symbols>{symbols}</symbols></renderer-v2></qgis>"
    )


def _rgba(colour: str) -> str:
    """Return `#rrggbb` in the form of QML: red, green, blue and opacity, 0 to 255."""
    return ",".join(str(value) for value in (*bytes.fromhex(colour[1:]), 255))


@contextmanager
def new_geopackage(file: IO[bytes], folder: Path) -> Iterator[sqlite3.Connection]:
    """Create a GeoPackage without layers; when the block ends without an error, copy it to a file.

    The database has no name in the folder, so that the operating system deletes it when the process ends.

    Raises:
        OSError: The file cannot be written.
    """
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".gpkg-", delete=False) as complete:
        try:
            try:
                new = sqlite3.connect(complete.name)
            finally:
                Path(complete.name).unlink()
            with closing(new) as db:
                # A journal would need the name.
                db.execute("PRAGMA journal_mode = OFF")
                db.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
                db.execute(f"PRAGMA user_version = {_USER_VERSION}")
                db.executescript(_SCHEMA)
                db.executemany(
                    "INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, NULL)",
                    [
                        ("Undefined cartesian SRS", -1, "NONE", -1, "undefined"),
                        ("Undefined geographic SRS", 0, "NONE", 0, "undefined"),
                        ("WGS 84", 4326, "EPSG", 4326, _WGS84_WKT),
                    ],
                )
                yield db
                db.commit()
        except sqlite3.OperationalError as error:
            raise OSError(errno.EIO, str(error)) from error
        shutil.copyfileobj(complete, file)


class Layer:
    """A table of features in WGS 84, with the columns `fid` and `geom` and others.

    Args:
        db: A GeoPackage.
        name: Name of the table.
        geometry: Type of the column `geom`, for example `POINT`.
        columns: Definitions of the other columns, as in SQL.
    """

    def __init__(self, db: sqlite3.Connection, name: str, geometry: str, columns: str) -> None:
        self._db = db
        self._name = name
        self._box: tuple[float, float, float, float] | None = None
        db.execute(f"CREATE TABLE {name} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom {geometry}, {columns})")
        db.execute(_CONTENTS, (name, "features", name, "", *(None,) * 4, 4326))
        db.execute("INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, 4326, 0, 0)", (name, geometry))

    def add(
        self, geometry: bytes | None, points: Iterable[tuple[float, float]], values: Iterable[Value | bytes]
    ) -> None:
        """Add a feature: its geometry, the points of it (longitude, latitude), and the values of the other columns."""
        for lon_deg, lat_deg in points:
            west, south, east, north = self._box or (lon_deg, lat_deg) * 2
            self._box = min(west, lon_deg), min(south, lat_deg), max(east, lon_deg), max(north, lat_deg)
        row = (None, geometry, *values)
        self._db.execute(f"INSERT INTO {self._name} VALUES ({', '.join('?' * len(row))})", row)  # noqa: S608  constants

    def finish(self, changed: str) -> None:
        """Store the bounding box, and the time of the last change, ISO 8601."""
        box = self._box or (None,) * 4
        self._db.execute(
            "UPDATE gpkg_contents SET last_change = ?, min_x = ?, min_y = ?, max_x = ?, max_y = ? WHERE table_name = ?",
            (changed, *box, self._name),
        )


def write_geopackage(file: IO[bytes], source: ExportSource) -> None:
    """Write a GeoPackage of contacts. A contact without a position has no geometry; one without an image has no PNG."""
    columns = ", ".join(f'"{name}" {_column_type(name)}' for name in COLUMNS)
    changed_utc_s = 0.0
    with new_geopackage(file, source.path.parent) as db:
        layer = Layer(db, "contacts", "POINT", f"{columns}, image BLOB")
        for contact in source.contacts:
            points = [] if contact.position is None else [contact.position[::-1]]
            layer.add(_point(contact), points, [*contact_properties(contact).values(), source.images.png(contact)])
            changed_utc_s = max(changed_utc_s, contact.image.last_frame_utc_s)
        changed = utc_text(changed_utc_s)
        layer.finish(changed)
        db.executescript(_STYLES)
        db.execute(_CONTENTS, ("layer_styles", "attributes", "layer_styles", changed, *(None,) * 4, 0))
        db.execute(
            "INSERT INTO layer_styles VALUES (1, '', '', 'contacts', 'geom', 'review', ?, '', 1, '', '', NULL, ?)",
            (_style(), changed),
        )
