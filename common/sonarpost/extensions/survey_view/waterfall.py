"""The waterfall of a recording on disk: rendered once, read in tiles, with the place of every pixel.

Memory does not depend on the length of the recording. The disk space is about 2 kB a row.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from PIL import Image

from sonarpost.cli.survey.plot import GreyScale, both_sides, parts_with_altitude
from sonarpost.detection.picks import Pick
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.sonar.geometry import georeference, ping_spacing_m, sample_slant_range_m, slant_to_ground_range_m
from sonarpost.sonar.image_files import encode_png
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.source import SurveySource
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

TILE_ROWS: Final = 512
MAX_ROWS: Final = 200_000
"""A longer recording has several pings a row."""
MAX_SIDE_PX: Final = 1000
SNIPPET_PX: Final = 120
_SCALE_PINGS: Final = 512
"""Pings, distributed over the recording, that define the grey scale."""
_ASSUMED_ALONG_M: Final = 0.2
_MAX_STRETCH: Final = 10.0

Grey = npt.NDArray[np.uint8]

_NAVIGATION: Final = ("lat_deg", "lon_deg", "heading_deg", "altitude_m", "depth_m", "speed_mps")
_ROW: Final = np.dtype(
    [
        ("number", np.int64),
        ("time_utc_s", np.float64),
        ("tracked_altitude_m", np.float64),
        *((name, np.float64) for name in _NAVIGATION),
        *((f"{side.value}_samples", np.int32) for side in Side),
        *((f"{side.value}_range_m", np.float64) for side in Side),
    ]
)
"""What is kept of the middle ping of a row; NaN if unknown."""


@dataclass(frozen=True, slots=True)
class PixelPlace:
    """The place of a pixel.

    Attributes:
        pick: The place as a pick.
        ping_number: Number of the ping in the file.
        ping_index: Index of the ping in the file.
        time_utc_s: Time of the ping.
        slant_range_m: Slant range of the sample.
        ground_range_m: The same on a flat bottom; None in the water column and without altitude.
        lat_deg: Latitude of the place; None if unknown.
        lon_deg: Longitude of the place; None if unknown.
        position_sigma_m: One standard deviation of the position; None without it.
    """

    pick: Pick
    ping_number: int
    ping_index: int
    time_utc_s: float
    slant_range_m: float
    ground_range_m: float | None
    lat_deg: float | None
    lon_deg: float | None
    position_sigma_m: float | None


class Waterfall:
    """A rendered recording. Reading is safe in several threads.

    Attributes:
        rows: Rows of the image.
        pings_per_row: Pings averaged in a row.
        side_px: Columns of one side; port is mirrored to the left.
        max_range_m: Slant range of the outer edges.
        stretch: Height of a row over the width of a column, in metres on the bottom; 0.1 to 10.

    Args:
        source: The open recording; it is read twice.
        folder: Empty folder for the data, which the caller removes.

    Raises:
        SurveyFileError: The recording cannot be read, or has no samples.
        OSError: The folder cannot be written.
    """

    def __init__(self, source: SurveySource, folder: Path) -> None:
        self._options: SurveyOptions = source.options
        self._ping_count = count = source.info.ping_count
        self.pings_per_row = math.ceil(count / MAX_ROWS)
        self.rows = math.ceil(count / self.pings_per_row)
        scale_survey = self._survey_limits(source)
        unscaled = both_sides(scale_survey, np.zeros(len(scale_survey.pings)), self.max_range_m, self.side_px)
        self._scale = GreyScale.of(unscaled)
        shape = (self.rows, 2 * self.side_px)
        self._grey: np.memmap[tuple[int, ...], np.dtype[np.uint8]] = np.memmap(
            folder / "waterfall", dtype=np.uint8, mode="w+", shape=shape
        )
        self._places = np.memmap(folder / "places", dtype=_ROW, mode="w+", shape=(self.rows,))
        along_m = self._render(source)
        across_m = self.max_range_m / self.side_px
        self.stretch = min(max(along_m * self.pings_per_row / across_m, 1 / _MAX_STRETCH), _MAX_STRETCH)
        numbers, counts = np.unique(self._places["number"], return_counts=True)
        self._repeated = frozenset(numbers[counts > 1].tolist())

    def _survey_limits(self, source: SurveySource) -> Survey:
        """Set range and columns; return pings that are distributed over the recording."""
        kept: list[Ping] = []
        every, max_range_m, samples = 1, 0.0, 0
        for row, ping in enumerate(source.pings()):
            max_range_m = max(max_range_m, ping.max_slant_range_m() or 0.0)
            samples = max([samples, *(len(c.samples) for side in Side if (c := ping.channel(side)) is not None)])
            if row % every == 0:
                kept.append(ping)
                if len(kept) >= 2 * _SCALE_PINGS:
                    kept, every = kept[::2], every * 2
        if max_range_m <= 0 or samples == 0:
            raise SurveyFileError(str(source.info.path), "samples", samples, "a recording with samples")
        self.max_range_m = max_range_m
        self.side_px = min(samples, MAX_SIDE_PX)
        return Survey(source.info.path, source.info.sonar_id, source.info.line_name, tuple(kept))

    def _render(self, source: SurveySource) -> float:
        """Write image and places; return the mean distance between pings."""
        total = np.zeros((0, 2 * self.side_px))
        spacings_m = []
        first = 0
        for survey, altitude_m in parts_with_altitude(source):
            image = both_sides(survey, np.zeros_like(altitude_m), self.max_range_m, self.side_px)
            spacing_m = ping_spacing_m(survey)
            spacings_m += [spacing_m] if spacing_m is not None else []
            for index, ping in enumerate(survey.pings, start=first):
                if index == self.ping_index(index // self.pings_per_row):
                    self._places[index // self.pings_per_row] = _place_of(ping, float(altitude_m[index - first]))
            first += len(survey.pings)
            total = np.vstack([total, image])
            complete = len(total) // self.pings_per_row if first < source.info.ping_count else None
            total = self._write(total, first, complete)
        return float(np.median(spacings_m)) if spacings_m else _ASSUMED_ALONG_M

    def ping_index(self, row: int) -> int:
        """Return the index in the file of the middle ping of a row: its place is that of the row."""
        first = row * self.pings_per_row
        return first + min(self.pings_per_row, self._ping_count - first) // 2

    def _write(self, echo: npt.NDArray[np.float64], end: int, complete: int | None) -> npt.NDArray[np.float64]:
        """Write the complete rows of the pings before `end`, all for None; return the pings that remain."""
        per_row = self.pings_per_row
        row = (end - len(echo)) // per_row
        rows = math.ceil(len(echo) / per_row) if complete is None else complete
        padded = echo[: rows * per_row]
        missing = rows * per_row - len(padded)
        padded = np.vstack([padded, np.full((missing, echo.shape[1]), np.nan)])
        blocks = padded.reshape(rows, per_row, echo.shape[1])
        known = np.isfinite(blocks)
        count = known.sum(axis=1)
        mean = np.where(count > 0, np.where(known, blocks, 0).sum(axis=1) / np.maximum(count, 1), np.nan)
        self._grey[row : row + rows] = self._scale.grey(mean)
        return echo[rows * per_row :]

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return math.ceil(self.rows / TILE_ROWS)

    def tile(self, number: int) -> bytes:
        """Return rows `number * TILE_ROWS` and the following as PNG.

        Raises:
            IndexError: There is no such tile.
        """
        if not 0 <= number < self.tiles:
            raise IndexError(f"tile: got {number}, expected 0 to {self.tiles - 1}")
        return _png(np.asarray(self._grey[number * TILE_ROWS : (number + 1) * TILE_ROWS]))

    def snippet(self, row: int, column: int) -> bytes:
        """Return the image around a pixel as PNG, `SNIPPET_PX` columns or less; rows as their height requires.

        Raises:
            IndexError: The pixel is outside the image.
        """
        self._check(row, column)
        top, height = _window(row, max(8, round(SNIPPET_PX / self.stretch)), self.rows)
        left, width = _window(column, SNIPPET_PX, 2 * self.side_px)
        return _png(np.asarray(self._grey[top : top + height, left : left + width]))

    def place(self, row: int, column: int) -> PixelPlace | None:
        """Return the place of a pixel; None where nothing was recorded.

        Raises:
            IndexError: The pixel is outside the image.
        """
        self._check(row, column)
        side = Side.PORT if column < self.side_px else Side.STARBOARD
        distance_px = (self.side_px - column if side is Side.PORT else column + 1 - self.side_px) - 0.5
        ping, tracked_m = self._ping(row)
        channel = ping.channel(side)
        if channel is None:
            return None
        sample = int(distance_px / self.side_px * self.max_range_m / channel.sample_spacing_m)
        if sample >= len(channel.samples):
            return None
        slant_m = sample_slant_range_m(channel, sample)
        altitude_m = ping.altitude_m if ping.altitude_m is not None else tracked_m
        ground_m = math.nan if altitude_m is None else float(slant_to_ground_range_m(slant_m, altitude_m))
        reference = georeference(ping, side, sample, self._options, tracked_altitude_m=tracked_m)
        index = self.ping_index(row)
        by_index = self.pings_per_row > 1 or ping.number in self._repeated or ping.number < 0
        return PixelPlace(
            pick=Pick(index if by_index else ping.number, side, sample, by_index),
            ping_number=ping.number,
            ping_index=index,
            time_utc_s=ping.time_utc_s,
            slant_range_m=slant_m,
            ground_range_m=None if math.isnan(ground_m) else ground_m,
            lat_deg=None if reference is None else reference.position.lat_deg,
            lon_deg=None if reference is None else reference.position.lon_deg,
            position_sigma_m=None if reference is None else reference.sigma_m,
        )

    def ping_index_of(self, pick: Pick) -> int:
        """Return the index in the file of a pick's ping.

        Raises:
            ConfigError: No row has this ping number, several have it, or the ping has no such sample.
        """
        index = pick.ping
        if not pick.by_index:
            rows = np.flatnonzero(self._places["number"] == pick.ping)
            if len(rows) != 1:
                raise ConfigError("picks", "ping", pick.ping, "the number of one ping")
            index = self.ping_index(int(rows[0]))
        if index >= self._ping_count:
            raise ConfigError("picks", "ping", index, f"an index from 0 to {self._ping_count - 1}")
        channel = self._ping(index // self.pings_per_row)[0].channel(pick.side)
        samples = 0 if channel is None else len(channel.samples)
        if pick.sample >= samples:
            raise ConfigError("picks", "sample", pick.sample, f"less than {samples}")
        return index

    def pixel(self, ping_index: int, side: Side, sample: int) -> tuple[int, int]:
        """Return row and column of a sample of a ping; limited to the image."""
        row = min(ping_index // self.pings_per_row, self.rows - 1)
        channel = self._ping(row)[0].channel(side)
        range_m = 0.0 if channel is None else sample_slant_range_m(channel, sample)
        return row, self.column(side, range_m)

    def column(self, side: Side, slant_range_m: float) -> int:
        """Return the column of a slant range, limited to the image."""
        distance = min(int(slant_range_m / self.max_range_m * self.side_px), self.side_px - 1)
        return self.side_px - 1 - distance if side is Side.PORT else self.side_px + distance

    def _check(self, row: int, column: int) -> None:
        if not (0 <= row < self.rows and 0 <= column < 2 * self.side_px):
            raise IndexError(f"row, column: got {row}, {column}, expected below {self.rows}, {2 * self.side_px}")

    def _ping(self, row: int) -> tuple[Ping, float | None]:
        """Return the ping of a row with channels of zeros, and its altitude by the first bottom return."""
        stored = self._places[row]
        channels = tuple(
            ChannelPing(
                side,
                np.broadcast_to(np.uint8(0), (int(stored[f"{side.value}_samples"]),)),
                float(stored[f"{side.value}_range_m"]),
            )
            for side in Side
            if stored[f"{side.value}_samples"] > 0
        )
        lat, lon, heading, altitude, depth, speed = (_known(stored[name]) for name in _NAVIGATION)
        ping = Ping(
            number=int(stored["number"]),
            time_utc_s=float(stored["time_utc_s"]),
            channels=channels,
            lat_deg=lat,
            lon_deg=lon,
            heading_deg=heading,
            altitude_m=altitude,
            depth_m=depth,
            speed_mps=speed,
        )
        return ping, _known(stored["tracked_altitude_m"])


def _place_of(ping: Ping, altitude_m: float) -> tuple[float, ...]:
    """Return a ping as a `_ROW`."""
    channels = [ping.channel(side) for side in Side]
    navigation = (getattr(ping, name) for name in _NAVIGATION)
    return (
        ping.number,
        ping.time_utc_s,
        altitude_m,
        *(math.nan if value is None else value for value in navigation),
        *(0 if c is None else len(c.samples) for c in channels),
        *(0.0 if c is None else c.slant_range_m for c in channels),
    )


def _known(value: np.float64) -> float | None:
    return None if np.isnan(value) else float(value)


def _window(centre: int, size: int, limit: int) -> tuple[int, int]:
    """Return first index and length of a window around `centre`, shifted to lie within `limit`."""
    length = min(size, limit)
    return min(max(centre - length // 2, 0), limit - length), length


def _png(image: Grey) -> bytes:
    return encode_png(Image.fromarray(image))
