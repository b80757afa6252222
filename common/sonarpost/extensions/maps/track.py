"""Pings in projected metres: place of the sonar, direction to starboard, and far ends of the swath."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.bottom_track import altitudes_m
from sonarpost.sonar.geometry import Position, ground_position
from sonarpost.sonar.projection import Projection
from sonarpost.sonar.source import SurveySource, strips
from sonarpost.sonar.survey import Side, Survey

FloatArray = npt.NDArray[np.float64]

MAX_GAP_M: Final = 5.0
MAX_GAP_S: Final = 5.0
"""Greatest distance and time between two pings between which the seabed is filled."""
_STRIP_PINGS: Final = 1000
_OVERLAP_PINGS: Final = 64
_REFERENCE_M: Final = 50.0


@dataclass(frozen=True, slots=True)
class Track:
    """Consecutive pings of a strip in projected metres; the first one may be the last of the part before it.

    Attributes:
        survey: The pings.
        first_row: Row of the first ping in the recording.
        centre_m: Easting and northing of the sonar, shape (pings, 2).
        starboard: Easting and northing of one metre to starboard, shape (pings, 2).
        altitude_m: Shape (pings,).
        is_known: Whether position, heading and altitude are known, shape (pings,).
        is_continued: Whether the first ping is the last one of the part before it.
    """

    survey: Survey
    first_row: int
    centre_m: FloatArray
    starboard: FloatArray
    altitude_m: FloatArray
    is_known: npt.NDArray[np.bool_]
    is_continued: bool

    def part(self, rows: slice) -> "Track":
        """Return the pings of a range of rows, counted from the first one of this track."""
        begin, end, _ = rows.indices(len(self.survey.pings))
        return Track(
            replace(self.survey, pings=self.survey.pings[rows]),
            self.first_row + begin,
            self.centre_m[rows],
            self.starboard[rows],
            self.altitude_m[rows],
            self.is_known[rows],
            is_continued=self.is_continued and begin == 0 < end,
        )


def utm_epsg(position: Position) -> int:
    """Return the EPSG number of the UTM zone of a position, without the exceptions of Norway and Svalbard."""
    zone = min(int((position.lon_deg + 180) // 6) + 1, 60)
    return (32_600 if position.lat_deg >= 0 else 32_700) + zone


def first_position(sources: Sequence[SurveySource]) -> Position:
    """Return the first position of the recordings.

    Raises:
        SurveyFileError: None of them has a position, or one cannot be read.
    """
    for source in sources:
        for ping in source.pings():
            if ping.lat_deg is not None and ping.lon_deg is not None:
                return Position(ping.lat_deg, ping.lon_deg)
    raise no_positions(sources)


def no_positions(sources: Sequence[SurveySource]) -> SurveyFileError:
    """Return the error for recordings without a ping with position, heading and altitude."""
    where = ", ".join(str(source.info.path) for source in sources)
    return SurveyFileError(where, "pings", "none", "with position, heading and altitude (see sonarpost survey info)")


def tracks(source: SurveySource, projection: Projection) -> Iterator[Track]:
    """Yield the pings of a recording in strips; bottom tracking uses the pings around each."""
    info = source.info
    done = 0
    for strip in strips(source.pings(), _STRIP_PINGS, _OVERLAP_PINGS):
        end = strip.first_row + len(strip.pings) - (0 if strip.is_last else _OVERLAP_PINGS // 2)
        survey = Survey(info.path, info.sonar_id, info.line_name, strip.pings)
        track = track_of(survey, altitudes_m(survey), projection)
        first = max(done - 1, 0) - strip.first_row
        rows = slice(first, end - strip.first_row)
        yield replace(track.part(rows), first_row=max(done - 1, 0), is_continued=done > 0)
        done = end


def track_of(survey: Survey, altitude_m: FloatArray, projection: Projection) -> Track:
    """Return pings in projected metres.

    Args:
        survey: The pings.
        altitude_m: Altitude of each ping, shape (pings,); NaN if unknown.
        projection: Projected coordinate system.
    """
    count = len(survey.pings)
    centre_m, starboard = np.full((count, 2), np.nan), np.full((count, 2), np.nan)
    for row, ping in enumerate(survey.pings):
        abeam = ground_position(ping, Side.STARBOARD, _REFERENCE_M)
        if abeam is None or ping.lat_deg is None or ping.lon_deg is None:
            continue
        centre_m[row] = projection.coordinates(Position(ping.lat_deg, ping.lon_deg))
        starboard[row] = (np.array(projection.coordinates(abeam)) - centre_m[row]) / _REFERENCE_M
    is_known = np.isfinite(centre_m).all(axis=1) & np.isfinite(starboard).all(axis=1) & (altitude_m > 0)
    return Track(survey, 0, _without_steps(centre_m), starboard, altitude_m, is_known, is_continued=False)


def _without_steps(centre_m: FloatArray) -> FloatArray:
    """Interpolate positions that a recorder repeats over several pings."""
    rows = np.flatnonzero(np.isfinite(centre_m).all(axis=1))
    if len(rows) < 2:
        return centre_m
    steps = np.flatnonzero((np.diff(centre_m[rows], axis=0) != 0).any(axis=1)) + 1
    fixes = rows[np.concatenate([[0], steps])]
    smooth = centre_m.copy()
    for axis in (0, 1):
        smooth[rows, axis] = np.interp(rows, fixes, centre_m[fixes, axis])
    return smooth


def is_gap(step_m: FloatArray, step_s: float) -> bool:
    """Return whether the seabed between two pings was not recorded, by their distance in metres and in time."""
    return bool(np.hypot(*step_m) > MAX_GAP_M) or abs(step_s) > MAX_GAP_S


def far_m(track: Track, row: int, side: Side) -> FloatArray | None:
    """Return easting and northing of the end of a side; None without the side or without seabed in it."""
    channel = track.survey.pings[row].channel(side)
    altitude_m = float(track.altitude_m[row])
    if channel is None or channel.slant_range_m <= altitude_m:
        return None
    ground_m = math.sqrt(channel.slant_range_m**2 - altitude_m**2)
    sign = 1 if side is Side.STARBOARD else -1
    far: FloatArray = track.centre_m[row] + sign * ground_m * track.starboard[row]
    return far
