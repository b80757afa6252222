"""Georeferenced images of recordings as cloud-optimised GeoTIFF: a mosaic, and waterfalls of straight lines.

A waterfall is rotated, not distorted: columns are at right angles to the line, port on the left, and the last ping is
at the top. Every echo is at its position, so that an affine transformation gives the position of each pixel. A
waterfall in slant range has no such transformation: slant range is not proportional to the distance on the seabed, and
the line is never quite straight. Ground control points would describe it, but GDAL interpolates between them: with its
default polynomial, positions of a slant-range waterfall are metres off.

Memory does not depend on the length of the recordings: they are read twice in strips, and tiles of an image that are
not in use are in a temporary file.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.errors import SurveyFileError
from sonarpost.extensions.maps.coverage import Coverage, outline_of
from sonarpost.extensions.maps.geotiff import GeoTransform, write_tiles
from sonarpost.extensions.maps.ground_canvas import GroundCanvas, checked_size
from sonarpost.extensions.maps.track import Track, far_m, first_position, is_gap, no_positions, tracks, utm_epsg
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.projection import Projection
from sonarpost.sonar.readers import open_survey
from sonarpost.sonar.source import SurveySource
from sonarpost.sonar.survey import Side

FloatArray = npt.NDArray[np.float64]

MAX_TURN_DEG: Final = 20.0
"""A line ends where the heading of three pings, each some metres from the last, differs by more from its mean."""
MIN_LINE_M: Final = 20.0
"""Shorter lines, the parts of a turn, have no waterfall."""
_STEP_M: Final = 2.0
_TURN_PINGS: Final = 3


@dataclass(frozen=True, slots=True)
class MosaicResult:
    """What was written.

    Attributes:
        transform: Place of the image.
        size_px: Rows and columns.
        coverage: The covered seabed, and the number of pings.
    """

    transform: GeoTransform
    size_px: tuple[int, int]
    coverage: Coverage


def write_mosaic(
    paths: Sequence[Path],
    out: Path,
    resolution_m: float,
    options: SurveyOptions | None = None,
) -> MosaicResult:
    """Write the mosaic of recordings as a cloud-optimised GeoTIFF in the UTM zone of the first position.

    Grey is 1 to 255, 128 at the mean echo of an angle, and 0 without data.

    Args:
        paths: Survey files.
        out: GeoTIFF to create or replace.
        resolution_m: Side of a pixel, from 0.01 m.
        options: Of the recordings.

    Raises:
        SurveyFileError: A recording cannot be read, none has a ping with position, heading and altitude, or the image
            would be too large.
        OSError: A file cannot be written.
    """
    with ExitStack() as stack:
        sources = [stack.enter_context(open_survey(path, options)) for path in paths]
        epsg = utm_epsg(first_position(sources))
        projection = Projection(f"EPSG:{epsg}")
        outline = outline_of(sources, projection)
        west_m = math.floor(outline.low_m[0] / resolution_m) * resolution_m
        north_m = math.ceil(outline.high_m[1] / resolution_m) * resolution_m
        width_px = math.floor((outline.high_m[0] - west_m) / resolution_m) + 1
        height_px = math.floor((north_m - outline.low_m[1]) / resolution_m) + 1
        checked_size(out, (height_px, width_px))
        transform = GeoTransform(epsg, (west_m, north_m), (resolution_m, 0.0), (0.0, -resolution_m))
        canvas = stack.enter_context(GroundCanvas((height_px, width_px), transform, out.parent))
        for source in sources:
            for track in tracks(source, projection):
                canvas.draw(track)
        write_tiles(out, (height_px, width_px), canvas.grey, transform)
        return MosaicResult(transform, (height_px, width_px), outline.coverage())


@dataclass(frozen=True, slots=True)
class LineWaterfall:
    """A waterfall that was written.

    Attributes:
        path: The file.
        transform: Place of the image.
        size_px: Rows and columns.
        first_ping: Number of its first ping in the file.
        last_ping: Number of its last ping in the file.
    """

    path: Path
    transform: GeoTransform
    size_px: tuple[int, int]
    first_ping: int
    last_ping: int


@dataclass(slots=True)
class _Line:
    """A straight part of a recording: its rows, and its points in steps of 2 m.

    Attributes:
        first_row: Row of the first ping.
        end_row: Row after the last ping.
        first_ping: Number of the first ping in the file.
        last_ping: Number of the last ping in the file.
        starboard: Directions to starboard.
        points_m: Sonar, port end and starboard end of the swath, each of shape (3, 2).
        length_m: Length of the track.
    """

    first_row: int
    end_row: int
    first_ping: int
    last_ping: int
    starboard: list[FloatArray]
    points_m: list[FloatArray]
    length_m: float = 0.0

    def add(self, starboard: FloatArray, points_m: FloatArray) -> None:
        """Add a ping."""
        self.length_m += float(np.hypot(*(points_m[0] - self.points_m[-1][0])))
        self.starboard.append(starboard)
        self.points_m.append(points_m)

    def is_turned(self) -> bool:
        """Return whether the last pings all have another heading than the line; a single one may be wrong."""
        mean, last = np.sum(self.starboard, axis=0), np.array(self.starboard[-_TURN_PINGS:])
        cosines = last @ mean / np.maximum(np.hypot(*last.T) * np.hypot(*mean), 1e-9)
        return len(last) == _TURN_PINGS and bool((cosines < math.cos(math.radians(MAX_TURN_DEG))).all())

    def place(self, epsg: int, resolution_m: float) -> tuple[GeoTransform, tuple[int, int]]:
        """Return transformation and size of the image: the points with a margin of their distance."""
        mean = np.sum(self.starboard, axis=0)
        right = mean / np.hypot(*mean)
        down = np.array([right[1], -right[0]])  # astern
        points = np.concatenate(self.points_m) @ np.array([right, down]).T
        low, high = points.min(axis=0) - _STEP_M, points.max(axis=0) + _STEP_M
        width_px, height_px = (math.ceil(size_m / resolution_m) for size_m in (high - low).tolist())
        east_m, north_m = (low[0] * right + low[1] * down).tolist()
        (cx, cy), (rx, ry) = ((vector * resolution_m).tolist() for vector in (right, down))
        return GeoTransform(epsg, (east_m, north_m), (cx, cy), (rx, ry)), (height_px, width_px)


def write_waterfalls(
    path: Path, folder: Path, resolution_m: float, options: SurveyOptions | None = None
) -> list[LineWaterfall]:
    """Write a waterfall of each straight line of a recording as a cloud-optimised GeoTIFF.

    The files are called LINE-waterfall-N.tif, N from 1. Grey is 1 to 255, 128 at the mean echo of an angle, and 0
    without data. Memory does not depend on the length of the recording.

    Args:
        path: Survey file.
        folder: Existing folder of the files.
        resolution_m: Side of a pixel, from 0.01 m.
        options: Of the recording.

    Raises:
        SurveyFileError: The recording cannot be read, it has no straight line of 20 m with position, heading and
            altitude, or an image would be too large.
        OSError: A file cannot be written.
    """
    with open_survey(path, options) as source:
        epsg = utm_epsg(first_position([source]))
        projection = Projection(f"EPSG:{epsg}")
        waterfalls: list[LineWaterfall] = []
        rows: list[tuple[int, int]] = []
        is_placed = False
        for line in _lines(source, projection):
            is_placed = True
            if line.length_m < MIN_LINE_M:
                continue
            transform, size_px = line.place(epsg, resolution_m)
            out = folder / f"{source.info.line_name}-waterfall-{len(waterfalls) + 1}.tif"
            size_px = checked_size(out, size_px)
            waterfalls.append(LineWaterfall(out, transform, size_px, line.first_ping, line.last_ping))
            rows.append((line.first_row, line.end_row))
        if not is_placed:
            raise no_positions([source])
        if not waterfalls:
            raise SurveyFileError(str(path), "lines", "none", f"a straight line of at least {MIN_LINE_M:g} m")
        _write(source, projection, list(zip(waterfalls, rows, strict=True)))
        return waterfalls


def _write(
    source: SurveySource, projection: Projection, waterfalls: list[tuple[LineWaterfall, tuple[int, int]]]
) -> None:
    """Draw the lines one after the other, in one pass through the recording; each has its first row and its end."""
    remaining = iter(waterfalls)
    current = next(remaining, None)
    with ExitStack() as stack:
        canvas: GroundCanvas | None = None
        for track in tracks(source, projection):
            end_of_track = track.first_row + len(track.survey.pings)
            while current is not None and current[1][0] < end_of_track:
                line, (first_row, end_row) = current
                if canvas is None:
                    canvas = stack.enter_context(GroundCanvas(line.size_px, line.transform, line.path.parent))
                begin = max(first_row - track.first_row, 0)
                canvas.draw(track.part(slice(begin, end_row - track.first_row)))
                if end_row > end_of_track:
                    break
                write_tiles(line.path, line.size_px, canvas.grey, line.transform)
                stack.pop_all().close()
                canvas, current = None, next(remaining, None)


def _lines(source: SurveySource, projection: Projection) -> Iterator[_Line]:
    """Yield the straight lines; gaps and turns are between them."""
    line: _Line | None = None
    last: tuple[FloatArray, float] | None = None
    for track in tracks(source, projection):
        for row in range(int(track.is_continued), len(track.survey.pings)):
            points_m = _points_m(track, row)
            if points_m is None:
                continue
            at, ping = track.first_row + row, track.survey.pings[row]
            if line is not None and last is not None and is_gap(points_m[0] - last[0], ping.time_utc_s - last[1]):
                yield line
                line = None
            last = points_m[0], ping.time_utc_s
            if line is None:
                line = _Line(at, at + 1, ping.number, ping.number, [track.starboard[row]], [points_m])
                continue
            line.end_row, line.last_ping = at + 1, ping.number
            if np.hypot(*(points_m - line.points_m[-1]).T).max() < _STEP_M:
                continue
            line.add(track.starboard[row], points_m)
            if line.is_turned():
                yield line
                line = None
    if line is not None:
        yield line


def _points_m(track: Track, row: int) -> FloatArray | None:
    """Return sonar, port end and starboard end of a ping, shape (3, 2); None without position or seabed."""
    if not track.is_known[row]:
        return None
    ends = [far_m(track, row, side) for side in Side]
    if all(end is None for end in ends):
        return None
    centre = track.centre_m[row]
    return np.array([centre, *(centre if end is None else end for end in ends)])
