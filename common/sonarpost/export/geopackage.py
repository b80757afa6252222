"""GeoPackage 1.3 (OGC 12-128r17): contacts as points with images and a style for QGIS, covered seabed as polygons.

The table `contacts` has one column for each of `tables.COLUMNS`, the geometry `geom` and the PNG `picture`. The table
`layer_styles` has the form that QGIS reads.
"""

from __future__ import annotations

import errno
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Final

from sonarpost.errors import BadInputError
from sonarpost.export.contacts import ContactSet, ExportContact, read_png
from sonarpost.export.coverage import coverage_properties
from sonarpost.export.kml import COLOURS
from sonarpost.export.tables import COLUMNS, contact_properties
from sonarpost.export.text import utc_text
from sonarpost.files import atomic_file
from sonarpost.sonar.geometry import Position
from sonarpost.sonar.maps.coverage import CoveragePolygon

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
_INTEGERS: Final = ("version", "decided_version", "decisions", "picture_height_px", "picture_width_px")
_BOOLEANS: Final = ("picture_complete", "authenticated")
_REALS: Final = ("_m", "_deg", "_confidence", "_fraction", "_mine_like", "_other_object")


def _column_type(name: str) -> str:
    if name in _BOOLEANS:
        return "BOOLEAN"
    if name in _INTEGERS:
        return "INTEGER"
    return "REAL" if name.endswith(_REALS) else "TEXT"


def _point(contact: ExportContact) -> bytes | None:
    """Return the point as GeoPackage geometry: header without envelope, then WKB, longitude first."""
    if contact.position is None:
        return None
    lat_deg, lon_deg = contact.position
    return struct.pack("<2sBBiBIdd", b"GP", 0, 1, 4326, 1, 1, lon_deg, lat_deg)


def _polygon(ring: Sequence[Position]) -> bytes:
    """Return a polygon of one ring as GeoPackage geometry: header with envelope, then WKB, longitude first."""
    lons, lats = [corner.lon_deg for corner in ring], [corner.lat_deg for corner in ring]
    header = struct.pack("<2sBBi4d", b"GP", 0, 3, 4326, min(lons), max(lons), min(lats), max(lats))
    points = b"".join(struct.pack("<2d", corner.lon_deg, corner.lat_deg) for corner in ring)
    return header + struct.pack("<BIII", 1, 3, 1, len(ring)) + points


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
def new_geopackage(path: Path) -> Iterator[sqlite3.Connection]:
    """Create a GeoPackage without layers; when the block ends without an error, it replaces the file atomically.

    Raises:
        OSError: The file cannot be written.
    """
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        database = Path(folder) / "new.gpkg"
        try:
            with closing(sqlite3.connect(database)) as db:
                # The file is written to a temporary folder first.
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
            raise OSError(errno.EIO, str(error), str(path)) from error
        with database.open("rb") as complete, atomic_file(path) as file:
            shutil.copyfileobj(complete, file)


def add_layer(
    db: sqlite3.Connection, name: str, geometry: str, columns: str, positions: Sequence[tuple[float, float]], time: str
) -> None:
    """Create a table of features in WGS 84.

    Args:
        db: A GeoPackage.
        name: Name of the table.
        geometry: Type of the column `geom`, for example `POINT`.
        columns: Definitions of the other columns, as in SQL.
        positions: Latitude and longitude of all features, for the bounding box of the layer.
        time: Time of the last change, ISO 8601.
    """
    lats, lons = [lat for lat, _ in positions], [lon for _, lon in positions]
    box = (min(lons), min(lats), max(lons), max(lats)) if positions else (None,) * 4
    db.execute(f"CREATE TABLE {name} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom {geometry}, {columns})")
    db.execute(_CONTENTS, (name, "features", name, time, *box, 4326))
    db.execute("INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, 4326, 0, 0)", (name, geometry))


def write_geopackage(path: Path, contacts: ContactSet) -> list[BadInputError]:
    """Write a GeoPackage atomically. One image at a time is in memory.

    A contact without a position has no geometry; one without an image has no picture.

    Returns:
        One error for each image that cannot be read. Its contact has no picture.

    Raises:
        OSError: The file cannot be written.
    """
    problems: list[BadInputError] = []
    changed = utc_text(max((c.image.last_frame_utc_s for c in contacts.contacts), default=0.0))
    columns = ", ".join(f'"{name}" {_column_type(name)}' for name in COLUMNS)
    positions = [c.position for c in contacts.located if c.position is not None]
    with new_geopackage(path) as db:
        db.executescript(_STYLES)
        add_layer(db, "contacts", "POINT", f"{columns}, picture BLOB", positions, changed)
        db.execute(_CONTENTS, ("layer_styles", "attributes", "layer_styles", changed, *(None,) * 4, 0))
        db.execute(
            "INSERT INTO layer_styles VALUES (1, '', '', 'contacts', 'geom', 'review', ?, '', 1, '', '', NULL, ?)",
            (_style(), changed),
        )
        marks = ", ".join("?" * (len(COLUMNS) + 3))
        for contact in contacts.contacts:
            values = (None, _point(contact), *contact_properties(contact).values(), read_png(contact, problems))
            db.execute(f"INSERT INTO contacts VALUES ({marks})", values)  # noqa: S608 - only question marks
    return problems


def write_coverage_geopackage(path: Path, polygons: Sequence[CoveragePolygon]) -> None:
    """Write the covered seabed atomically as the layer `coverage`: polygons in WGS 84.

    Raises:
        OSError: The file cannot be written.
    """
    changed = utc_text(max((polygon.end_utc_s for polygon in polygons), default=0.0))
    positions = [(corner.lat_deg, corner.lon_deg) for polygon in polygons for corner in polygon.ring]
    columns = "line TEXT, first_ping INTEGER, last_ping INTEGER, start_utc TEXT, end_utc TEXT, area_m2 REAL"
    with new_geopackage(path) as db:
        add_layer(db, "coverage", "POLYGON", columns, positions, changed)
        for polygon in polygons:
            values = (None, _polygon(polygon.ring), *coverage_properties(polygon).values())
            db.execute("INSERT INTO coverage VALUES (?, ?, ?, ?, ?, ?, ?, ?)", values)
