"""Geometry of a survey: slant range, ground range, positions of samples with their error ellipse.

Positions are WGS-84. Distances within a survey (under about 1 km) use the local tangent plane with the ellipsoid's
radii of curvature at the middle latitude, which agrees with the geodesic to well under a centimetre at 500 m.

The error ellipse of a sample has these independent contributions, as standard deviations across (c) and along (a) the
track, at ground range g, altitude h and slant range r = sqrt(g^2 + h^2):

* position of the carrier, p: c, a
* heading, s radians: a = g s (the sample rotates about the sonar)
* slant range, from the sound speed (a fraction v) and half a sample (q, uniform): r v r/g and q/sqrt(12) r/g in c
* altitude, e: c = e h/g; near the nadir, where h/g has no bound, limited to the possible range of g
* slope of the bottom, b radians: the bottom at g is g tan(b) higher or lower, which is an altitude error
* time of the position relative to the ping, t: a = speed t
* layback of a towed body: a = l and 5 % of the layback; c = the layback times the swing of the body (3 degrees)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

FloatArray = npt.NDArray[np.float64]

WGS84_EQUATORIAL_RADIUS_M: Final = 6_378_137.0
WGS84_FLATTENING: Final = 1 / 298.257_223_563
_ECCENTRICITY_SQUARED: Final = WGS84_FLATTENING * (2 - WGS84_FLATTENING)
_TRACK_SMOOTHING_S: Final = 4.0
"""Averaging time of the track: fixes are often rounded to metres and repeated over many pings."""
_MAX_SPEED_RATIO: Final = 1.5
"""Maximum ratio of the distances by speed and by positions; a confusion of knots and m/s is 1.94."""
_MAX_LATITUDE_DEG: Final = 89.0
_LAYBACK_SIGMA: Final = 0.05
"""Standard deviation of a layback as a fraction: the cable sags."""
_TOW_SWING_RAD: Final = math.radians(3)
"""Standard deviation of the direction of a towed body, seen from the ship, relative to the track."""
_DEFAULT_SPEED_MPS: Final = 2.0
"""Typical speed of a survey vehicle, for the time contribution of a ping without speed."""


@dataclass(frozen=True, slots=True)
class Position:
    """A WGS-84 position in degrees; longitude from -180 (included) to 180."""

    lat_deg: float
    lon_deg: float


def slant_to_ground_range_m(slant_range_m: npt.ArrayLike, altitude_m: npt.ArrayLike) -> FloatArray:
    """Return the ground range of an echo over a flat bottom: sqrt(slant^2 - altitude^2).

    Args:
        slant_range_m: Slant range in metres, any shape.
        altitude_m: Altitude of the sonar above the bottom in metres, broadcastable shape.

    Returns:
        float64 of the broadcast shape; NaN in the water column, where slant range is less than altitude.
    """
    slant = np.asarray(slant_range_m, dtype=np.float64)
    squared = slant**2 - np.asarray(altitude_m, dtype=np.float64) ** 2
    return np.sqrt(np.where(squared >= 0, squared, np.nan))


def ground_to_slant_range_m(ground_range_m: npt.ArrayLike, altitude_m: npt.ArrayLike) -> FloatArray:
    """Return the slant range of a point on a flat bottom, float64; the inverse of `slant_to_ground_range_m`."""
    return np.hypot(np.asarray(ground_range_m, dtype=np.float64), np.asarray(altitude_m, dtype=np.float64))


def sample_slant_range_m(channel: ChannelPing, sample_index: float) -> float:
    """Return the slant range of the middle of a sample, in metres."""
    return (sample_index + 0.5) * channel.sample_spacing_m


def _radii_of_curvature_m(lat_rad: float) -> tuple[float, float]:
    """Return the meridional radius and the prime-vertical radius of WGS-84 at a latitude."""
    w = 1 - _ECCENTRICITY_SQUARED * math.sin(lat_rad) ** 2
    meridional = WGS84_EQUATORIAL_RADIUS_M * (1 - _ECCENTRICITY_SQUARED) / w**1.5
    return meridional, WGS84_EQUATORIAL_RADIUS_M / math.sqrt(w)


def offset_position(origin: Position, bearing_deg: float, distance_m: float) -> Position:
    """Return the position at `distance_m` from `origin` and bearing `bearing_deg` (from true north, clockwise).

    Accurate to centimetres up to 500 m, except within a few kilometres of a pole.
    """
    north = distance_m * math.cos(math.radians(bearing_deg))
    east = distance_m * math.sin(math.radians(bearing_deg))
    lat = math.radians(origin.lat_deg)
    meridional, _ = _radii_of_curvature_m(lat)
    middle = lat + north / meridional / 2
    meridional, prime_vertical = _radii_of_curvature_m(middle)
    # A straight line east on the tangent plane ends slightly nearer the equator.
    bow = east**2 * math.tan(lat) / (2 * prime_vertical * meridional)
    lat_deg = math.degrees(lat + north / meridional - bow)
    # The east leg is at the latitude of the end of the north leg.
    lon_deg = origin.lon_deg + math.degrees(east / (prime_vertical * math.cos(lat + north / meridional)))
    return Position(lat_deg, (lon_deg + 180) % 360 - 180)


def offset_between_m(origin: Position, other: Position) -> tuple[float, float]:
    """Return the distances north and east from `origin` to `other` on the tangent plane, in metres."""
    lat = math.radians(origin.lat_deg)
    other_lat = math.radians(other.lat_deg)
    meridional, prime_vertical = _radii_of_curvature_m((lat + other_lat) / 2)
    lon_step = math.radians((other.lon_deg - origin.lon_deg + 180) % 360 - 180)
    east = lon_step * prime_vertical * math.cos(other_lat)
    bow = east**2 * math.tan(lat) / (2 * prime_vertical)
    return (other_lat - lat) * meridional + bow, east


def ground_position(ping: Ping, side: Side, ground_range_m: float) -> Position | None:
    """Return the position abeam of the vehicle at a ground range; None if the ping has no fix or heading."""
    if ping.lat_deg is None or ping.lon_deg is None or ping.heading_deg is None:
        return None
    abeam_deg = ping.heading_deg + (90 if side is Side.STARBOARD else -90)
    return offset_position(Position(ping.lat_deg, ping.lon_deg), abeam_deg, ground_range_m)


def along_track_m(survey: Survey) -> FloatArray | None:
    """Return the distance along the track since the first ping.

    The sources are, in this order, what the file states in metres, so that neither a projection nor missing positions
    change the distance:

    1. speed and time, if at least half of the pings have a speed,
    2. coordinates in metres,
    3. fixes in degrees,
    4. speed and time of fewer pings.

    A speed that contradicts the positions (more than 1.5 times or less than two thirds of their distance: another
    unit, a constant of the recorder) is not used. Positions are smoothed over a few seconds and interpolated over pings
    without one.

    Returns:
        Shape (pings,), float64, not decreasing, starting at 0; None if the file has none of them.
    """
    times = np.array([ping.time_utc_s for ping in survey.pings], dtype=np.float64)
    speed_m = _distance_by_speed_m(survey, times)
    track = _track_m(survey)
    if track is None:
        return speed_m
    window = _window_pings(times)
    smooth = np.stack([_moving_average(track[:, axis], window) for axis in (0, 1)], axis=1)
    track_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(smooth, axis=0).T))])
    has_speed = 2 * sum(ping.speed_mps is not None for ping in survey.pings) >= len(survey.pings)
    if speed_m is None or not has_speed or not _agree(float(speed_m[-1]), float(track_m[-1])):
        return track_m
    return speed_m


def ping_spacing_m(survey: Survey) -> float | None:
    """Return the mean distance between pings along the track, in metres; None without navigation."""
    distance_m = along_track_m(survey)
    if distance_m is None or len(distance_m) < 2 or distance_m[-1] <= 0:
        return None
    return float(distance_m[-1]) / (len(distance_m) - 1)


def _distance_by_speed_m(survey: Survey, times: FloatArray) -> FloatArray | None:
    """Return the distance of every ping from speed and time, shape (pings,); None without a speed."""
    speeds = np.array([np.nan if p.speed_mps is None else p.speed_mps for p in survey.pings], dtype=np.float64)
    known = np.flatnonzero(np.isfinite(speeds))
    if not known.size:
        return None
    filled = np.interp(np.arange(len(speeds)), known, speeds[known])
    steps = np.maximum(np.diff(times), 0) * (filled[1:] + filled[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps)])


def _agree(speed_m: float, track_m: float) -> bool:
    """Return whether a distance by speed is plausible beside the length of the track."""
    return speed_m > 0 and (track_m <= 0 or 1 / _MAX_SPEED_RATIO <= speed_m / track_m <= _MAX_SPEED_RATIO)


def _track_m(survey: Survey) -> FloatArray | None:
    """Return (north, east) of every ping, shape (pings, 2), interpolated and extrapolated; None below two positions."""
    points: dict[int, tuple[float, float]] = {
        row: (ping.grid_m[1], ping.grid_m[0]) for row, ping in enumerate(survey.pings) if ping.grid_m is not None
    }
    if len(points) < 2:
        fixes = {
            row: Position(ping.lat_deg, ping.lon_deg)
            for row, ping in enumerate(survey.pings)
            if ping.lat_deg is not None and ping.lon_deg is not None
        }
        first = next(iter(fixes.values()), None)
        points = {row: offset_between_m(first, fix) for row, fix in fixes.items() if first is not None}
    if len(points) < 2:
        return None
    fixed = list(points)
    known = np.array(list(points.values()), dtype=np.float64)
    rows = np.arange(len(survey.pings))
    track = np.stack([np.interp(rows, fixed, known[:, axis]) for axis in (0, 1)], axis=1)
    step = (known[-1] - known[0]) / (fixed[-1] - fixed[0])
    # Before the first fix and after the last one the track continues at its mean speed.
    track[: fixed[0]] = known[0] + (rows[: fixed[0]] - fixed[0])[:, None] * step
    track[fixed[-1] + 1 :] = known[-1] + (rows[fixed[-1] + 1 :] - fixed[-1])[:, None] * step
    return track


def _window_pings(times: FloatArray) -> int:
    """Return the odd number of pings of the averaging time."""
    span_s = float(times[-1] - times[0])
    rate_hz = (len(times) - 1) / span_s if span_s > 0 else 0.0
    return 2 * min(round(_TRACK_SMOOTHING_S * rate_hz / 2), (len(times) - 1) // 4) + 1


def _moving_average(values: FloatArray, window: int) -> FloatArray:
    """Return the moving average over `window` (odd). Point-mirrored ends preserve a straight line."""
    half = window // 2
    if half == 0:
        return values
    front = 2 * values[0] - values[half:0:-1]
    back = 2 * values[-1] - values[-2 : -half - 2 : -1]
    return np.convolve(np.concatenate([front, values, back]), np.full(window, 1 / window), mode="valid")


@dataclass(frozen=True, slots=True)
class GeoReference:
    """Position of a sample on the bottom with its error ellipse.

    Attributes:
        position: WGS-84 position.
        ground_range_m: Distance from the track over a flat bottom.
        across_sigma_m: Standard deviation across the track.
        along_sigma_m: Standard deviation along the track.
    """

    position: Position
    ground_range_m: float
    across_sigma_m: float
    along_sigma_m: float

    @property
    def sigma_m(self) -> float:
        """Standard deviation along the worse axis of the error ellipse, in metres."""
        return max(self.across_sigma_m, self.along_sigma_m)


def georeference(
    ping: Ping, side: Side, sample_index: float, options: SurveyOptions, *, tracked_altitude_m: float | None = None
) -> GeoReference | None:
    """Return the position of a sample on the bottom with its error ellipse.

    Args:
        ping: The ping, with the mounting applied (as every `SurveySource` does).
        side: The channel.
        sample_index: The sample, 0 nearest the vehicle; may be fractional.
        options: For the error budget and the layback.
        tracked_altitude_m: An altitude from `track_bottom`, for a ping without its own.

    Returns:
        The position. None if the ping has no fix, heading, altitude or channel, if the sample is outside the channel
        or in the water column, or within a degree of a pole, where the tangent plane is not valid.
    """
    channel = ping.channel(side)
    altitude_m = ping.altitude_m if ping.altitude_m is not None else tracked_altitude_m
    if channel is None or altitude_m is None or not math.isfinite(altitude_m) or ping.heading_deg is None:
        return None
    if ping.lat_deg is None or abs(ping.lat_deg) > _MAX_LATITUDE_DEG:
        return None
    if not -0.5 <= sample_index <= len(channel.samples) - 0.5:
        return None
    slant_m = sample_slant_range_m(channel, sample_index)
    ground_m = float(slant_to_ground_range_m(slant_m, altitude_m))
    position = None if math.isnan(ground_m) else ground_position(ping, side, ground_m)
    if position is None:
        return None
    budget = options.errors
    altitude_sigma_m = budget.altitude_m if ping.altitude_m is not None else budget.tracked_altitude_m
    range_sigma_m = math.hypot(slant_m * budget.sound_speed, channel.sample_spacing_m / math.sqrt(12))
    slope_m = ground_m * math.tan(math.radians(budget.bottom_slope_deg))
    height_sigma_m = math.hypot(altitude_sigma_m, slope_m)
    speed_mps = _DEFAULT_SPEED_MPS if ping.speed_mps is None else ping.speed_mps
    heading_sigma_deg = budget.heading_deg if ping.heading_sigma_deg is None else ping.heading_sigma_deg
    layback_m = options.mounting.layback_m + (ping.layback_m or 0.0)
    across_m = math.hypot(
        budget.position_m,
        _ground_sigma_m(ground_m, altitude_m, slant_m, range_sigma_m, height_sigma_m),
        layback_m * math.sin(_TOW_SWING_RAD),
    )
    along_m = math.hypot(
        budget.position_m,
        ground_m * math.radians(heading_sigma_deg),
        speed_mps * budget.time_s,
        budget.layback_m if layback_m else 0.0,
        layback_m * _LAYBACK_SIGMA,
    )
    return GeoReference(position, ground_m, across_m, along_m)


def _ground_sigma_m(
    ground_m: float, altitude_m: float, slant_m: float, range_sigma_m: float, height_sigma_m: float
) -> float:
    """Return the standard deviation of the ground range.

    It follows from the derivative of sqrt(r^2 - h^2). Near the nadir the derivative has no bound; there the result is
    limited to the square root of the deviation of r^2 - h^2.
    """
    squared_sigma = 2 * math.hypot(slant_m * range_sigma_m, altitude_m * height_sigma_m)
    return min(squared_sigma / (2 * ground_m), math.sqrt(squared_sigma)) if ground_m > 0 else math.sqrt(squared_sigma)
