"""Where a sample lies: slant range to ground range, to latitude and longitude.

Positions are WGS-84. Distances within a survey (under about 1 km) use the local tangent plane with the ellipsoid's
radii of curvature at the middle latitude, which agrees with the geodesic to well under a centimetre at 500 m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

FloatArray = npt.NDArray[np.float64]

WGS84_EQUATORIAL_RADIUS_M: Final = 6_378_137.0
WGS84_FLATTENING: Final = 1 / 298.257_223_563
_ECCENTRICITY_SQUARED: Final = WGS84_FLATTENING * (2 - WGS84_FLATTENING)
_TRACK_SMOOTHING_S: Final = 4.0
"""Navigation is averaged over this long: fixes are often rounded to metres and repeated over many pings."""


@dataclass(frozen=True, slots=True)
class Position:
    """A place on WGS-84, in degrees; longitude within -180 (included) and 180."""

    lat_deg: float
    lon_deg: float


def slant_to_ground_range_m(slant_range_m: npt.ArrayLike, altitude_m: npt.ArrayLike) -> FloatArray:
    """Return the ground range of an echo over a flat bottom: sqrt(slant^2 - altitude^2).

    Args:
        slant_range_m: Slant range in metres, any shape.
        altitude_m: Height of the sonar over the bottom in metres, of a shape that broadcasts with it.

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
    """Return the place `distance_m` away from `origin` in the direction `bearing_deg` (from true north, clockwise).

    Good to centimetres under 500 m, except within a few kilometres of a pole.
    """
    north = distance_m * math.cos(math.radians(bearing_deg))
    east = distance_m * math.sin(math.radians(bearing_deg))
    lat = math.radians(origin.lat_deg)
    meridional, _ = _radii_of_curvature_m(lat)
    middle = lat + north / meridional / 2
    meridional, prime_vertical = _radii_of_curvature_m(middle)
    # A step east along the tangent plane ends a little nearer the equator than it began.
    bow = east**2 * math.tan(lat) / (2 * prime_vertical * meridional)
    lat_deg = math.degrees(lat + north / meridional - bow)
    # The meridians have converged by the end of the leg north; the mean of both parallels is what counts.
    lon_deg = origin.lon_deg + math.degrees(east / (prime_vertical * math.cos(lat + north / meridional)))
    return Position(lat_deg, (lon_deg + 180) % 360 - 180)


def offset_between_m(origin: Position, other: Position) -> tuple[float, float]:
    """Return how far `other` lies north and east of `origin` on the tangent plane, in metres."""
    lat = math.radians(origin.lat_deg)
    other_lat = math.radians(other.lat_deg)
    meridional, prime_vertical = _radii_of_curvature_m((lat + other_lat) / 2)
    lon_step = math.radians((other.lon_deg - origin.lon_deg + 180) % 360 - 180)
    east = lon_step * prime_vertical * math.cos(other_lat)
    bow = east**2 * math.tan(lat) / (2 * prime_vertical)
    return (other_lat - lat) * meridional + bow, east


def sample_position(ping: Ping, side: Side, sample_index: float, *, altitude_m: float | None = None) -> Position | None:
    """Return where on the bottom a sample's echo came from.

    Args:
        ping: The ping, with position and heading.
        side: The channel.
        sample_index: The sample, 0 nearest the vehicle; may be fractional.
        altitude_m: Height over the bottom to use in place of the ping's own (for one from `track_bottom`).

    Returns:
        The position; None where the ping has no fix, heading, altitude or channel, or the sample lies in the water
        column.
    """
    channel = ping.channel(side)
    height_m = ping.altitude_m if altitude_m is None else altitude_m
    if channel is None or height_m is None:
        return None
    ground_m = float(slant_to_ground_range_m(sample_slant_range_m(channel, sample_index), height_m))
    return None if math.isnan(ground_m) else ground_position(ping, side, ground_m)


def ground_position(ping: Ping, side: Side, ground_range_m: float) -> Position | None:
    """Return the place abeam of the vehicle at a ground range; None where the ping has no fix or heading."""
    if ping.lat_deg is None or ping.lon_deg is None or ping.heading_deg is None:
        return None
    abeam_deg = ping.heading_deg + (90 if side is Side.STARBOARD else -90)
    return offset_position(Position(ping.lat_deg, ping.lon_deg), abeam_deg, ground_range_m)


def along_track_m(survey: Survey) -> FloatArray | None:
    """Return the distance travelled since the first ping.

    From navigation, smoothed over a few seconds since fixes are often coarse and repeated, and interpolated over
    pings without one; else from speed and time.

    Returns:
        Shape (pings,), float64, not decreasing, starting at 0; None where the file gives neither.
    """
    times = np.array([ping.time_utc_s for ping in survey.pings], dtype=np.float64)
    fixed = [row for row, ping in enumerate(survey.pings) if ping.lat_deg is not None and ping.lon_deg is not None]
    if len(fixed) >= 2:
        track = _track_m(survey, fixed)
        window = _window_pings(times)
        smooth = np.stack([_moving_average(track[:, axis], window) for axis in (0, 1)], axis=1)
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(smooth, axis=0).T))])
    speeds = np.array([np.nan if p.speed_mps is None else p.speed_mps for p in survey.pings], dtype=np.float64)
    known = np.flatnonzero(np.isfinite(speeds))
    if not known.size:
        return None
    filled = np.interp(np.arange(len(speeds)), known, speeds[known])
    steps = np.maximum(np.diff(times), 0) * (filled[1:] + filled[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps)])


def ping_spacing_m(survey: Survey) -> float | None:
    """Return the mean distance between pings along the track, in metres; None where navigation does not tell."""
    distance_m = along_track_m(survey)
    if distance_m is None or len(distance_m) < 2 or distance_m[-1] <= 0:
        return None
    return float(distance_m[-1]) / (len(distance_m) - 1)


def _track_m(survey: Survey, fixed: list[int]) -> FloatArray:
    """Return (north, east) of every ping, shape (pings, 2), interpolated and extrapolated over missing fixes."""
    places = [_place(survey.pings[row]) for row in fixed]
    known = np.array([offset_between_m(places[0], place) for place in places], dtype=np.float64)
    rows = np.arange(len(survey.pings))
    track = np.stack([np.interp(rows, fixed, known[:, axis]) for axis in (0, 1)], axis=1)
    step = (known[-1] - known[0]) / (fixed[-1] - fixed[0])
    # The track goes on at its mean pace before the first fix and after the last.
    track[: fixed[0]] = known[0] + (rows[: fixed[0]] - fixed[0])[:, None] * step
    track[fixed[-1] + 1 :] = known[-1] + (rows[fixed[-1] + 1 :] - fixed[-1])[:, None] * step
    return track


def _place(ping: Ping) -> Position:
    assert ping.lat_deg is not None
    assert ping.lon_deg is not None
    return Position(ping.lat_deg, ping.lon_deg)


def _window_pings(times: FloatArray) -> int:
    """Return the odd number of pings that smoothing takes, from the ping rate."""
    span_s = float(times[-1] - times[0])
    rate_hz = (len(times) - 1) / span_s if span_s > 0 else 0.0
    return 2 * min(round(_TRACK_SMOOTHING_S * rate_hz / 2), (len(times) - 1) // 4) + 1


def _moving_average(values: FloatArray, window: int) -> FloatArray:
    """Average over `window` (odd) with the ends mirrored through their end points, so that a straight line stays."""
    half = window // 2
    if half == 0:
        return values
    front = 2 * values[0] - values[half:0:-1]
    back = 2 * values[-1] - values[-2 : -half - 2 : -1]
    return np.convolve(np.concatenate([front, values, back]), np.full(window, 1 / window), mode="valid")
