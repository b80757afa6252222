"""Where a sample lies and how well that is known: one error ellipse for every position.

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

from sonarpost.sonar.geometry import Position, ground_position, sample_slant_range_m, slant_to_ground_range_m
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.survey import Ping, Side

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
