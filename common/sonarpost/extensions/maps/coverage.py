"""Outline of the seabed that recordings cover: polygons of the swath."""

import json
import struct
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.export.geo.geopackage import Layer, new_geopackage
from sonarpost.export.text import utc_text
from sonarpost.extensions.maps.geometry import GeoPoint, geojson_geometry, split_ring
from sonarpost.extensions.maps.track import Track, far_m, first_position, is_gap, no_positions, tracks, utm_epsg
from sonarpost.files import atomic_file, write_atomically
from sonarpost.sonar.geometry import Position
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.projection import Projection
from sonarpost.sonar.readers import open_survey
from sonarpost.sonar.source import SurveySource
from sonarpost.sonar.survey import Side

FloatArray = npt.NDArray[np.float64]

_STEP_M: Final = 2.0
"""Distance of the points of an outline."""
_BRIDGE_M: Final = 10.0
"""Length of track over which pings that cross the outline are left out."""
_MAX_EDGES: Final = 2000
"""Maximum number of pings of a polygon."""


@dataclass(frozen=True, slots=True)
class CoveragePolygon:
    """Swath of a part of a line, to the range of both sides over a flat seabed. Its outline does not cross itself.

    Attributes:
        line: Name of the line.
        first_ping: Number of the first ping in the file.
        last_ping: Number of the last ping in the file.
        start_utc_s: Time of the first ping, seconds since 1970-01-01 UTC.
        end_utc_s: Time of the last ping.
        area_m2: Area in the UTM zone, which differs from that on the ellipsoid by at most 0.2 %.
        ring: Corners, counter-clockwise; the last one is the first one again.
    """

    line: str
    first_ping: int
    last_ping: int
    start_utc_s: float
    end_utc_s: float
    area_m2: float
    ring: tuple[Position, ...]


@dataclass(frozen=True, slots=True)
class Coverage:
    """The covered seabed of recordings.

    Attributes:
        polygons: In the order of recording.
        pings: Number of pings with position, heading and altitude.
        left_out: Number of pings without one of them, or without seabed in the range.
    """

    polygons: tuple[CoveragePolygon, ...]
    pings: int
    left_out: int


def survey_coverage(paths: Sequence[Path], options: SurveyOptions | None = None) -> Coverage:
    """Return the seabed that recordings cover; memory depends on the length of the outlines only.

    Raises:
        SurveyFileError: A recording cannot be read, or none has a ping with position, heading and altitude.
    """
    with ExitStack() as stack:
        sources = [stack.enter_context(open_survey(path, options)) for path in paths]
        projection = Projection(f"EPSG:{utm_epsg(first_position(sources))}")
        return outline_of(sources, projection).coverage()


def outline_of(sources: Sequence[SurveySource], projection: Projection) -> "CoverageOutline":
    """Return the outline of all pings of open recordings.

    Raises:
        SurveyFileError: A recording cannot be read, or none has a ping with position, heading and altitude.
    """
    outline = CoverageOutline(projection)
    for source in sources:
        for track in tracks(source, projection):
            outline.add(track)
        outline.end_polygon()
    if not outline.pings:
        raise no_positions(sources)
    return outline


class CoverageOutline:
    """Outline of pings: polygons with a point every 2 m, and the extent of all of them.

    Pings with which the outline would cross itself are left out, which removes errors of the heading. If the track has
    gone on for 10 m, as in a turn and where lines of the same recording overlap, the polygon ends and the next begins.
    A polygon ends at a gap, too. Of a turn sharper than the range, parts have no polygon.

    Attributes:
        low_m: Smallest easting and northing.
        high_m: Greatest easting and northing.
        pings: Number of pings with position, heading and altitude.
        left_out: Number of other pings.
    """

    def __init__(self, projection: Projection) -> None:
        self._projection = projection
        self.low_m, self.high_m = np.full(2, np.inf), np.full(2, -np.inf)
        self.pings = self.left_out = 0
        self._polygons: list[CoveragePolygon] = []
        # Far ends of the pings of the polygon in progress: port and starboard, easting and northing.
        self._ends = np.empty((_MAX_EDGES, 2, 2))
        # Number and time of these pings.
        self._edge_pings: list[tuple[int, float]] = []
        self._edge_centre = np.zeros(2)
        self._line = ""
        self._last: tuple[tuple[int, float], FloatArray, FloatArray] | None = None

    def add(self, track: Track) -> None:
        """Add the pings of a strip."""
        self._line = track.survey.line_name
        for row in range(int(track.is_continued), len(track.survey.pings)):
            ping = track.survey.pings[row]
            sides = [far_m(track, row, side) for side in Side] if track.is_known[row] else []
            points = [end for end in sides if end is not None]
            if not points:
                self.left_out += 1
                continue
            self.pings += 1
            centre = track.centre_m[row]
            self.low_m = np.minimum(self.low_m, np.min([*points, centre], axis=0))
            self.high_m = np.maximum(self.high_m, np.max([*points, centre], axis=0))
            if self._last is not None and is_gap(centre - self._last[1], ping.time_utc_s - self._last[0][1]):
                self.end_polygon()
            number_and_time = ping.number, ping.time_utc_s
            ends = np.array([centre if end is None else end for end in sides])
            count = len(self._edge_pings)
            if count == 0 or np.hypot(*(ends - self._ends[count - 1]).T).max() >= _STEP_M:
                self._add_edge(number_and_time, centre, ends)
            self._last = (number_and_time, centre, ends)

    def _add_edge(self, ping: tuple[int, float], centre: FloatArray, ends: FloatArray) -> None:
        """Add a ping to the polygon, or leave it out if the outline would cross itself, for up to 10 m of the track."""
        count = len(self._edge_pings)
        is_crossed = count > 0 and _crosses(self._ends[:count], ends)
        if is_crossed and np.hypot(*(centre - self._edge_centre)) < _BRIDGE_M:
            return
        if is_crossed or count == _MAX_EDGES:
            last_ping, last_ends = self._edge_pings[-1], self._ends[count - 1].copy()
            self._complete()
            if not _crosses(last_ends[None], ends):
                self._ends[0] = last_ends
                self._edge_pings.append(last_ping)
        self._ends[len(self._edge_pings)] = ends
        self._edge_pings.append(ping)
        self._edge_centre = centre

    def end_polygon(self) -> None:
        """Complete the polygon of the pings so far, to the last one."""
        if self._last is not None and self._last[0] != self._edge_pings[-1]:
            self._add_edge(*self._last)
        self._last = None
        self._complete()

    def _complete(self) -> None:
        pings, self._edge_pings = self._edge_pings, []
        if len(pings) < 2:
            return
        ends = self._ends[: len(pings)]
        # Counter-clockwise on a course ahead: forward along starboard, back along port.
        ring = np.concatenate([ends[:, 1], ends[::-1, 0], ends[:1, 1]])
        local = ring - ring[0]
        area_m2 = float(np.sum(local[:-1, 0] * local[1:, 1] - local[1:, 0] * local[:-1, 1])) / 2
        corners = (ring if area_m2 >= 0 else ring[::-1]).tolist()
        positions = tuple(p for corner in corners if (p := self._projection.position(*corner)) is not None)
        (first_ping, start_utc_s), (last_ping, end_utc_s) = pings[0], pings[-1]
        self._polygons.append(
            CoveragePolygon(self._line, first_ping, last_ping, start_utc_s, end_utc_s, abs(area_m2), positions)
        )

    def coverage(self) -> Coverage:
        """Return the polygons, after `end_polygon`."""
        return Coverage(tuple(self._polygons), self.pings, self.left_out)


def _crosses(edges: FloatArray, ends: FloatArray) -> bool:
    """Return whether the outline of pings crosses itself, or a side of it turns back, when one more ping is added.

    Args:
        edges: Port and starboard end of each ping so far, shape (pings, 2, 2), at least one ping; they do not cross.
        ends: Those of the new ping, shape (2, 2).
    """
    last, first = edges[-1], edges[:1]
    ahead = _cross(last[1] - last[0], ends - last)
    forward = ahead if len(edges) == 1 else _cross(edges[0, 1] - edges[0, 0], edges[1] - edges[0])
    if not (ahead * np.sign(forward.sum()) > 0).all():
        return True
    begins = np.concatenate([edges[:-1, 0], edges[:-1, 1], first[:, 0]])
    stops = np.concatenate([edges[1:, 0], edges[1:, 1], first[:, 1]])
    port, starboard, across = (last[0], ends[0]), (last[1], ends[1]), (ends[0], ends[1])
    if any(_intersect(begins, stops, *segment).any() for segment in (port, starboard, across)):
        return True
    return bool(_intersect(port[0][None], port[1][None], *starboard).any())


def _intersect(begins: FloatArray, stops: FloatArray, begin: FloatArray, stop: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which segments cross another one; segments that only touch it do not cross it.

    Args:
        begins: First ends of the segments, shape (segments, 2).
        stops: Their other ends, same shape.
        begin: First end of the other one, shape (2,).
        stop: Its other end.
    """
    # Relative to one point, so that the products keep their digits.
    begins, stops, stop = begins - begin, stops - begin, stop - begin
    one_side = _cross(stop, begins) * _cross(stop, stops) < 0
    return one_side & (_cross(stops - begins, -begins) * _cross(stops - begins, stop - begins) < 0)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    product: FloatArray = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product


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
