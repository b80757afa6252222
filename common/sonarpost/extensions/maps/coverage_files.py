"""Covered seabed as GeoJSON (RFC 7946) and as GeoPackage: polygons with the pings, times and area of each."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

from sonarpost.export.geo.geometry import GeoPoint, geojson_geometry, split_ring
from sonarpost.export.geo.geopackage import Layer, new_geopackage
from sonarpost.export.text import utc_text
from sonarpost.extensions.maps.coverage import CoveragePolygon
from sonarpost.files import atomic_file, write_atomically


def _properties(polygon: CoveragePolygon) -> dict[str, str | int | float]:
    """Return the properties of a polygon: line, pings, times as ISO 8601, area in square metres."""
    return {
        "line": polygon.line,
        "first_ping": polygon.first_ping,
        "last_ping": polygon.last_ping,
        "start_utc": utc_text(polygon.start_utc_s),
        "end_utc": utc_text(polygon.end_utc_s),
        "area_m2": round(polygon.area_m2, 1),
    }


def _polygons(rings: Sequence[Sequence[GeoPoint]], geometry: str) -> bytes:
    """Return a `POLYGON` of one ring, or a `MULTIPOLYGON`, as GeoPackage geometry: header with envelope, then WKB."""
    lons, lats = zip(*chain(*rings), strict=True)
    header = struct.pack("<2sBBi4d", b"GP", 0, 3, 4326, min(lons), max(lons), min(lats), max(lats))
    count = struct.pack("<BII", 1, 6, len(rings)) if geometry == "MULTIPOLYGON" else b""
    polygons = (struct.pack(f"<BIII{2 * len(ring)}d", 1, 3, 1, len(ring), *chain(*ring)) for ring in rings)
    return header + count + b"".join(polygons)


def write_coverage_geojson(path: Path, polygons: Sequence[CoveragePolygon]) -> None:
    """Write a FeatureCollection atomically: a polygon in WGS 84 for each part of a line.

    Raises:
        OSError: The file cannot be written.
    """
    features = [
        {
            "type": "Feature",
            "geometry": geojson_geometry("Polygon", [(p.lon_deg, p.lat_deg) for p in polygon.ring]),
            "properties": _properties(polygon),
        }
        for polygon in polygons
    ]
    write_atomically(path, (json.dumps({"type": "FeatureCollection", "features": features}) + "\n").encode())


def write_coverage_geopackage(path: Path, polygons: Sequence[CoveragePolygon]) -> None:
    """Write the covered seabed atomically as the layer `coverage`: polygons in WGS 84.

    Raises:
        OSError: The file cannot be written.
    """
    divided = [split_ring([(corner.lon_deg, corner.lat_deg) for corner in polygon.ring]) for polygon in polygons]
    # A layer has one type.
    geometry = "MULTIPOLYGON" if any(len(rings) > 1 for rings in divided) else "POLYGON"
    columns = "line TEXT, first_ping INTEGER, last_ping INTEGER, start_utc TEXT, end_utc TEXT, area_m2 REAL"
    with atomic_file(path) as file, new_geopackage(file, path.parent) as db:
        layer = Layer(db, "coverage", geometry, columns)
        for polygon, rings in zip(polygons, divided, strict=True):
            layer.add(_polygons(rings, geometry), chain(*rings), _properties(polygon).values())
        layer.finish(utc_text(max((polygon.end_utc_s for polygon in polygons), default=0.0)))
