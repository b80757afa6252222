"""Canvas of the seabed: pings drawn into a georeferenced image in tiles.

Pings are projected to a flat seabed and divided by the mean at their angle. Each pixel is the mean of all echoes in it.
Between two pings the image of the nearer one is repeated. Memory does not depend on the size of the image.
"""

import math
import tempfile
from collections import OrderedDict
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.errors import SurveyFileError
from sonarpost.extensions.maps.geotiff import TILE_PX, GeoTransform, Grey
from sonarpost.extensions.maps.track import MAX_GAP_M, MAX_GAP_S, Track
from sonarpost.sonar.ground_range import beam_normalised, ground_range_image
from sonarpost.sonar.survey import FloatImage, Side

FloatArray = npt.NDArray[np.float64]

MIN_RESOLUTION_M: Final = 0.01
MAX_TILES: Final = 1 << 17
"""Maximum number of tiles of an image: 34 gigapixels."""
NADIR_DEG: Final = 10.0
"""Angle from the vertical within which the seabed is left out: there a sample covers metres of it."""
_STEP: Final = 0.7
"""Distance of neighbouring points as a fraction of a pixel, so that no pixel is missed."""
_POINTS: Final = 400_000
_HELD_TILES: Final = 64
_MEAN_GREY: Final = 127.0


class GroundCanvas:
    """Image of the seabed: sums and counts of the echoes in every pixel.

    Tiles that were not used for a time are in a temporary file.

    Args:
        size_px: Rows and columns.
        transform: Place of the image. A step of a column and a step of a row are at right angles and of equal length.
        folder: Folder of the temporary file; None for that of the system.
    """

    def __init__(self, size_px: tuple[int, int], transform: GeoTransform, folder: Path | None = None) -> None:
        self._size_px = size_px
        self._pixel_m = math.hypot(*transform.column_m)
        self._origin_m = np.array(transform.origin_m)
        # Columns are the pixels of one metre east and of one metre north.
        self._to_pixels = np.linalg.inv(np.array([transform.column_m, transform.row_m]).T)
        self._columns = math.ceil(size_px[1] / TILE_PX)
        self._tiles: OrderedDict[int, npt.NDArray[np.float32]] = OrderedDict()
        self._slots: dict[int, int] = {}
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed by `__exit__`

    def __enter__(self) -> "GroundCanvas":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def draw(self, track: Track) -> None:
        """Add the pings of a strip.

        Raises:
            SurveyFileError: The pixels are too small for the range of the sonar.
        """
        spacing_m = _STEP * self._pixel_m
        known = np.where(track.is_known, track.altitude_m, np.nan)
        for side in track.survey.sides():
            try:
                image = ground_range_image(track.survey, side, known, spacing_m)
            except ValueError as error:
                where, value = str(track.survey.path), f"{self._pixel_m:g} m"
                raise SurveyFileError(where, "resolution", value, "a coarser one for this range") from error
            image = beam_normalised(image, known, spacing_m)
            ground_m = (np.arange(image.shape[1]) + 0.5) * spacing_m
            image[ground_m < np.nan_to_num(known)[:, None] * math.tan(math.radians(NADIR_DEG))] = np.nan
            across_m = np.asarray(ground_m if side is Side.STARBOARD else -ground_m, dtype=np.float64)
            rows, fractions = _sub_rows(track, float(ground_m[-1]), spacing_m)
            chunk = max(_POINTS // len(ground_m), 1)
            for begin in range(0, len(rows), chunk):
                part = slice(begin, begin + chunk)
                self._add_points(track, image, across_m, rows[part], fractions[part])

    def _add_points(
        self,
        track: Track,
        image: FloatImage,
        across_m: FloatArray,
        rows: npt.NDArray[np.intp],
        fractions: FloatArray,
    ) -> None:
        following = np.where(fractions > 0, rows + 1, rows)
        share = fractions[:, None]
        centre = track.centre_m[rows] * (1 - share) + track.centre_m[following] * share - self._origin_m
        starboard = track.starboard[rows] * (1 - share) + track.starboard[following] * share
        values = image[np.where(fractions < 0.5, rows, following)]
        east_m = centre[:, :1] + starboard[:, :1] * across_m
        north_m = centre[:, 1:] + starboard[:, 1:] * across_m
        known = np.isfinite(values)
        columns, lines = (
            np.floor(east_m[known] * per_east + north_m[known] * per_north).astype(np.intp)
            for per_east, per_north in self._to_pixels
        )
        self._add(lines, columns, values[known])

    def _add(self, lines: npt.NDArray[np.intp], columns: npt.NDArray[np.intp], values: FloatImage) -> None:
        """Add echoes at pixels; points beyond the image are ignored."""
        inside = (lines >= 0) & (lines < self._size_px[0]) & (columns >= 0) & (columns < self._size_px[1])
        lines, columns, values = lines[inside], columns[inside], values[inside]
        numbers = lines // TILE_PX * self._columns + columns // TILE_PX
        places = lines % TILE_PX * TILE_PX + columns % TILE_PX
        for number in np.unique(numbers).tolist():
            here = numbers == number
            tile = self._tile(number)
            np.add.at(tile[0], places[here], values[here])
            np.add.at(tile[1], places[here], np.float32(1))

    def _tile(self, number: int) -> npt.NDArray[np.float32]:
        """Return sums and counts of a tile, shape (2, 512 x 512)."""
        if (tile := self._tiles.get(number)) is not None:
            self._tiles.move_to_end(number)
            return tile
        if len(self._tiles) >= _HELD_TILES:
            oldest, content = self._tiles.popitem(last=False)
            slot = self._slots.setdefault(oldest, len(self._slots))
            self._file.seek(slot * content.nbytes)
            self._file.write(content.tobytes())
        tile = np.zeros((2, TILE_PX**2), np.float32)
        if number in self._slots:
            self._file.seek(self._slots[number] * tile.nbytes)
            tile = np.frombuffer(self._file.read(tile.nbytes), np.float32).reshape(tile.shape).copy()
        self._tiles[number] = tile
        return tile

    def grey(self, row: int, column: int) -> Grey:
        """Return a tile of the image: 1 + 127 times the square root of the mean echo, at most 255; 0 without data."""
        number = row * self._columns + column
        if number not in self._tiles and number not in self._slots:
            return np.zeros((TILE_PX, TILE_PX), np.uint8)
        sums, counts = self._tile(number)
        level = np.sqrt(np.maximum(sums, 0) / np.maximum(counts, 1))
        grey = np.where(counts > 0, np.clip(1 + np.rint(_MEAN_GREY * level), 1, 255), 0)
        return grey.astype(np.uint8).reshape(TILE_PX, TILE_PX)

    def image(self) -> Grey:
        """Return the whole image, shape (rows, columns), as the tiles of `grey`; for images of a few tiles."""
        rows, columns = (math.ceil(size / TILE_PX) for size in self._size_px)
        tiles = [[self.grey(row, column) for column in range(columns)] for row in range(rows)]
        image: Grey = np.block(tiles)[: self._size_px[0], : self._size_px[1]]
        return image


def _sub_rows(track: Track, far_m: float, spacing_m: float) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Return the ping before each line of points, and the line's place from it to the next ping, 0 to below 1."""
    steps = np.diff(track.centre_m, axis=0)
    times = np.array([ping.time_utc_s for ping in track.survey.pings])
    length_m = np.hypot(*steps.T)
    turn_m = far_m * np.hypot(*np.diff(track.starboard, axis=0).T)
    joined = track.is_known[:-1] & track.is_known[1:] & (length_m <= MAX_GAP_M) & (np.abs(np.diff(times)) <= MAX_GAP_S)
    # The outer end moves by the way and by the turn; a jump of the heading is not filled.
    reach_m = np.where(joined & (turn_m <= MAX_GAP_M), length_m + turn_m, 0.0)
    counts = np.maximum(np.ceil(np.nan_to_num(reach_m) / spacing_m).astype(np.intp), 1)
    counts = np.append(counts, 1)[: len(track.survey.pings)]
    counts[~track.is_known] = 0
    rows = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    return rows, within / counts[rows]


def checked_size(out: Path, size_px: tuple[int, int]) -> tuple[int, int]:
    """Return the rows and columns of an image.

    Raises:
        SurveyFileError: It would be too large; the error names its file.
    """
    rows, columns = (math.ceil(size / TILE_PX) for size in size_px)
    if rows * columns > MAX_TILES:
        size = f"{size_px[0]} x {size_px[1]} px"
        raise SurveyFileError(str(out), "size", size, "a smaller area or a coarser resolution")
    return size_px
