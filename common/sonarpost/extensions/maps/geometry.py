"""Lines and polygons in WGS 84, divided at the 180th meridian (RFC 7946, section 3.1.9)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

GeoPoint = tuple[float, float]
"""Longitude, -180 to 180, and latitude in degrees."""


def split_line(points: Sequence[GeoPoint]) -> list[list[GeoPoint]]:
    """Divide a line of at least one point where it crosses the 180th meridian.

    Consecutive points are connected the shorter way. A point on the meridian has the longitude 180 or -180 of its part.
    """
    lon_deg, lat_deg = points[0]
    side_deg = next((lon_deg for lon_deg, _ in points if abs(lon_deg) < 180), 180.0)
    parts = [[(lon_deg if abs(lon_deg) < 180 else math.copysign(180.0, side_deg), lat_deg)]]
    for lon_deg, lat_deg in points[1:]:
        part = parts[-1]
        last_lon_deg, last_lat_deg = part[-1]
        near_deg = lon_deg - 360 * round((lon_deg - last_lon_deg) / 360)
        if abs(near_deg) <= 180:
            part.append((near_deg, lat_deg))
            continue
        edge_deg = math.copysign(180.0, near_deg)
        fraction = (edge_deg - last_lon_deg) / (near_deg - last_lon_deg)
        crossing_deg = last_lat_deg + fraction * (lat_deg - last_lat_deg)
        if fraction:
            part.append((edge_deg, crossing_deg))
        parts.append([(-edge_deg, crossing_deg), (lon_deg, lat_deg)])
    return parts


def split_ring(ring: Sequence[GeoPoint]) -> list[list[GeoPoint]]:
    """Divide a closed ring that does not cross itself where it crosses the 180th meridian.

    The rings have the same direction. One around a pole is returned whole.
    """
    first = next((row for row, (lon_deg, _) in enumerate(ring) if abs(lon_deg) < 180), 0)
    parts = split_line([*ring[first:], *ring[1 : first + 1]])
    if len(parts) == 1:
        return parts
    parts[0] = parts.pop() + parts[0][1:]
    # Along the meridian the polygon lies between the first and the second end of a part, the third and the fourth, …
    following: dict[int, int] = {}
    for edge_deg in (-180.0, 180.0):
        ends = sorted((part[at][1], at, n) for n, part in enumerate(parts) for at in (-1, 0) if part[at][0] == edge_deg)
        for one, other in zip(ends[::2], ends[1::2], strict=False):
            if len(pair := dict((one[1:], other[1:]))) == 2:
                following[pair[-1]] = pair[0]
    if len(following) < len(parts):
        return [list(ring)]
    rings = []
    while following:
        points: list[GeoPoint] = []
        number = next(iter(following))
        while number in following:
            points += parts[number]
            number = following.pop(number)
        neighbours = zip([points[-1], *points], points, [*points[1:], points[0]], strict=False)
        corners = [near[1] for near in neighbours if any(abs(lon_deg) < 180 for lon_deg, _ in near)]
        rings.append([*corners, corners[0]])
    return rings


def geojson_geometry(kind: Literal["LineString", "Polygon"], points: Sequence[GeoPoint]) -> dict[str, object]:
    """Return a line, or a polygon of a closed ring, as GeoJSON geometry; a line of a single point is a Point."""
    parts = split_line(points) if kind == "LineString" else split_ring(points)
    # One unit of the last digit is about 1 mm on the ground.
    rounded = [[[round(degrees, 8) for degrees in point] for point in part] for part in parts]
    if len(points) == 1:
        return {"type": "Point", "coordinates": rounded[0][0]}
    coordinates = rounded if kind == "LineString" else [[ring] for ring in rounded]
    if len(coordinates) == 1:
        return {"type": kind, "coordinates": coordinates[0]}
    return {"type": f"Multi{kind}", "coordinates": coordinates}
