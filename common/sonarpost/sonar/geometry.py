"""Where a sample lies: slant range to ground range, to latitude and longitude.

Positions are WGS-84. Distances within a survey (under about 1 km) use the local tangent plane with the ellipsoid's
radii of curvature at the middle latitude, which agrees with the geodesic to well under a centimetre at 500 m.


## sonarpost.sonar.geometry
Where a sample lies and how well that is known: one error ellipse for every position.

Contributions, as standard deviations across (c) and along (a) the track at ground range g, altitude h, slant range
r = sqrt(g^2 + h^2), each independent of the others:

* position of the carrier, p: c, a
* heading, s radians: a = g s (the sample swings about the sonar)
* slant range, from the speed of sound (a fraction v) and half a sample (q, uniform): r v r/g and q/sqrt(12) r/g in c
* altitude, e: c = e h/g; near the nadir, where h/g grows without limit, it is held to what g can be at most
* slope of the bottom, b radians: the bottom at g is g tan(b) higher or lower, which counts as an altitude error
* time of the position against the ping, t: a = speed t
* layback, l, where there is one: a
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


_MAX_LATITUDE_DEG = 89.0
_UNKNOWN_SPEED_MPS = 2.0
"""What a survey vehicle makes, for the time's share where the ping has no speed."""


@dataclass(frozen=True, slots=True)
class GeoReference:
    """A sample's position on the bottom.

    Attributes:
        position: WGS-84.
        ground_range_m: From the sonar's track to it, over a flat bottom.
        across_sigma_m: One standard deviation across the track.
        along_sigma_m: One standard deviation along the track.
        bearing_deg: From the sonar to it, from true north; the direction of `across_sigma_m`.
    """

    position: Position
    ground_range_m: float
    across_sigma_m: float
    along_sigma_m: float
    bearing_deg: float

    @property
    def drms_m(self) -> float:
        """Root mean square distance of the true place from `position`, in metres."""
        return math.hypot(self.across_sigma_m, self.along_sigma_m)


def georeference(
    ping: Ping, side: Side, sample_index: float, options: SurveyOptions, *, tracked_altitude_m: float | None = None
) -> GeoReference | None:
    """Return where on the bottom a sample's echo came from, and how well that is known.

    Args:
        ping: The ping, with the mounting applied (as every `SurveySource` gives it).
        side: The channel.
        sample_index: The sample, 0 nearest the vehicle; may be fractional.
        options: For `errors`, and for whether there is a layback.
        tracked_altitude_m: An altitude from `track_bottom`, for a ping without its own.

    Returns:
        The position; None where the ping has no fix, heading, altitude or channel, where the sample is not one of
        the channel's, lies in the water column, or the ping lies within a degree of a pole, where the tangent plane
        does not hold.
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
    place = None if math.isnan(ground_m) else ground_position(ping, side, ground_m)
    if place is None:
        return None
    budget = options.errors
    altitude_sigma_m = budget.altitude_m if ping.altitude_m is not None else budget.tracked_altitude_m
    range_sigma_m = math.hypot(slant_m * budget.sound_speed, channel.sample_spacing_m / math.sqrt(12))
    slope_m = ground_m * math.tan(math.radians(budget.bottom_slope_deg))
    height_sigma_m = math.hypot(altitude_sigma_m, slope_m)
    across_m = math.hypot(
        budget.position_m, _ground_sigma_m(ground_m, altitude_m, slant_m, range_sigma_m, height_sigma_m)
    )
    speed_mps = _UNKNOWN_SPEED_MPS if ping.speed_mps is None else ping.speed_mps
    along_m = math.hypot(
        budget.position_m,
        ground_m * math.radians(budget.heading_deg),
        speed_mps * budget.time_s,
        budget.layback_m if options.mounting.layback_m else 0.0,
    )
    bearing_deg = (ping.heading_deg + (90 if side is Side.STARBOARD else -90)) % 360
    return GeoReference(place, ground_m, across_m, along_m, bearing_deg)


def _ground_sigma_m(
    ground_m: float, altitude_m: float, slant_m: float, range_sigma_m: float, height_sigma_m: float
) -> float:
    """Return the deviation of the ground range.

    The derivative of sqrt(r^2 - h^2) is used while it describes the function; near the nadir it is unbounded, and
    the range of values within one deviation of r^2 - h^2 is taken: sqrt of its deviation.
    """
    squared_sigma = 2 * math.hypot(slant_m * range_sigma_m, altitude_m * height_sigma_m)
    return min(squared_sigma / (2 * ground_m), math.sqrt(squared_sigma)) if ground_m > 0 else math.sqrt(squared_sigma)
