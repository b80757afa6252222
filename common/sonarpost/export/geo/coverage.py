"""Covered seabed as GeoJSON (RFC 7946), and the properties of its polygons."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from sonarpost.export.geo.geometry import geojson_geometry
from sonarpost.export.text import utc_text
from sonarpost.files import write_atomically
from sonarpost.sonar.maps.coverage import CoveragePolygon


def coverage_properties(polygon: CoveragePolygon) -> dict[str, str | int | float]:
    """Return the properties of a polygon: line, pings, times as ISO 8601, area in square metres."""
    return {
        "line": polygon.line,
        "first_ping": polygon.first_ping,
        "last_ping": polygon.last_ping,
        "start_utc": utc_text(polygon.start_utc_s),
        "end_utc": utc_text(polygon.end_utc_s),
        "area_m2": round(polygon.area_m2, 1),
    }


def write_coverage_geojson(path: Path, polygons: Sequence[CoveragePolygon]) -> None:
    """Write a FeatureCollection atomically: a polygon in WGS 84 for each part of a line.

    Raises:
        OSError: The file cannot be written.
    """
    features = [
        {
            "type": "Feature",
            "geometry": geojson_geometry("Polygon", [(p.lon_deg, p.lat_deg) for p in polygon.ring]),
            "properties": coverage_properties(polygon),
        }
        for polygon in polygons
    ]
    write_atomically(path, (json.dumps({"type": "FeatureCollection", "features": features}) + "\n").encode())
