"""Bodies above the seabed in the ray casting: their echo, and the shadow that they cast on the seabed behind them.

The plane of each ping cuts a body in an ellipse. Rays that cross the ellipse do not reach the seabed behind it, or only
in part when the body is a school of fish. The near side of a solid body returns an echo as the seabed does; every fish
returns an echo in the ping nearest to it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.extensions.simulation.seabed.scattering import bin_by_range, scattered, vertical_beam
from sonarpost.extensions.simulation.seabed.spec import SurveySpec
from sonarpost.extensions.simulation.seabed.terrain import SuspendedBody

FloatArray = npt.NDArray[np.float64]

_ARC_POINTS: Final = 64
_FISH_ECHO_M: Final = 0.012
"""Echo of a fish of strength 1, as the length of a Lambert surface of backscatter 1 at vertical incidence."""
_SCHOOL_ATTENUATION: Final = 0.9
"""Attenuation of intensity, in nepers, on both ways through the middle of a school of fish."""


@dataclass(frozen=True, slots=True)
class SonarPath:
    """Position and attitude of the sonar at each ping, in the strip's coordinates; arrays (pings,), float64."""

    along_m: FloatArray
    across_m: FloatArray
    height_m: FloatArray
    yaw_rad: FloatArray
    roll_rad: FloatArray


@dataclass(frozen=True, slots=True)
class Slices:
    """A body cut by the planes of pings, relative to the sonar.

    Attributes:
        body: The body.
        ahead_m: Shape (pings,): its centre along the heading.
        ground_m: Shape (pings,): its centre abeam, positive on the side that is computed.
        above_m: Shape (pings,): its centre above the sonar.
        yaw_rad: Shape (pings,): heading of the vehicle in the strip.
        roll_rad: Shape (pings,): roll towards the side that is computed.
        sign: 1 for starboard, -1 for port.
    """

    body: SuspendedBody
    ahead_m: FloatArray
    ground_m: FloatArray
    above_m: FloatArray
    yaw_rad: FloatArray
    roll_rad: FloatArray
    sign: int

    def scale(self) -> FloatArray:
        """Return the size of each ellipse as a fraction of that through the centre; 0 where the plane misses."""
        return np.asarray(np.sqrt(np.clip(1 - (self.ahead_m / self.body.radius_m) ** 2, 0, None)))


def slices(bodies: Sequence[SuspendedBody], track: SonarPath, sign: int, pings: tuple[int, int]) -> list[Slices]:
    """Return the bodies that the planes of pings [first, last) cut on one side; `sign` is 1 for starboard."""
    rows = slice(*pings)
    cut = []
    for body in bodies:
        along, across = body.along_m - track.along_m[rows], body.across_m - track.across_m[rows]
        cosine, sine = np.cos(track.yaw_rad[rows]), np.sin(track.yaw_rad[rows])
        ahead_m, ground_m = along * cosine + across * sine, sign * (across * cosine - along * sine)
        if np.any((np.abs(ahead_m) < body.radius_m) & (ground_m > 0)):
            above_m = body.height_m - track.height_m[rows]
            roll_rad = sign * track.roll_rad[rows]
            cut.append(Slices(body, ahead_m, ground_m, above_m, track.yaw_rad[rows], roll_rad, sign))
    return cut


def unblocked(
    cut: Sequence[Slices], drop_m: npt.NDArray[np.floating], ground_m: npt.NDArray[np.floating]
) -> npt.NDArray[np.float32]:
    """Return the share of intensity that passes the bodies to the seabed and back.

    Args:
        cut: From `slices`.
        drop_m: Shape (pings, cells): depth of the seabed below the sonar.
        ground_m: Shape (cells,): ground range.

    Returns:
        Shape (pings, cells), float32, 0 to 1.
    """
    share = np.ones(drop_m.shape, dtype=np.float32)
    for item in cut:
        scale = item.scale()
        rows = np.flatnonzero((scale > 0) & (item.ground_m > 0))
        # With heights scaled by this factor, the ellipse is a circle.
        factor = item.body.radius_m / item.body.half_thickness_m
        depth = drop_m[rows] * factor
        ray_m = np.hypot(depth, ground_m)
        centre_m, above_m = item.ground_m[rows, None], item.above_m[rows, None] * factor
        along_ray_m = (centre_m * ground_m - above_m * depth) / ray_m
        off_ray_m = np.abs(centre_m * depth + above_m * ground_m) / ray_m
        half_chord_m = np.sqrt(np.clip((item.body.radius_m * scale[rows, None]) ** 2 - off_ray_m**2, 0, None))
        crossed = (half_chord_m > 0) & (along_ray_m < ray_m)
        passing = np.exp(-_SCHOOL_ATTENUATION * half_chord_m / item.body.radius_m) if item.body.fish else 0.0
        share[rows] *= np.where(crossed, passing, 1.0).astype(np.float32)
    return share


def body_echoes(cut: Sequence[Slices], cell_m: float, spec: SurveySpec) -> FloatArray:
    """Return the energy of the bodies in each sample, in the unit of seabed cells of a length.

    Args:
        cut: From `slices`; at least one.
        cell_m: Length of a cell of the seabed.
        spec: Range, sampling and ping spacing.

    Returns:
        Shape (pings, samples), float64.
    """
    total = np.zeros((cut[0].ahead_m.shape[0], spec.samples))
    for item in cut:
        total += _school_echo(item, cell_m, spec) if item.body.fish else _solid_echo(item, cell_m, spec)
    return total


def _solid_echo(item: Slices, cell_m: float, spec: SurveySpec) -> FloatArray:
    scale = (item.scale() * (item.ground_m > 0))[:, None]
    step = math.pi / _ARC_POINTS
    angle = -math.pi / 2 + step * (np.arange(_ARC_POINTS) + 0.5)
    towards = np.arctan2(-item.above_m, -item.ground_m)[:, None] + angle
    ground_m = item.ground_m[:, None] + scale * item.body.radius_m * np.cos(towards)
    above_m = item.above_m[:, None] + scale * item.body.half_thickness_m * np.sin(towards)
    # The surface of a sphere is oblique to the plane of a ping that does not go through its centre.
    incidence = scale * np.cos(angle)
    arc_cells = item.body.radius_m * step / cell_m
    energy = np.where(scale > 0, scattered(item.body.backscatter, incidence) * arc_cells, 0)
    energy = energy * vertical_beam(np.arctan2(-above_m, ground_m) + item.roll_rad[:, None])
    return bin_by_range(energy, np.hypot(ground_m, above_m) / spec.sample_m, spec.samples)


def _school_echo(item: Slices, cell_m: float, spec: SurveySpec) -> FloatArray:
    rng = np.random.default_rng(item.body.seed)
    direction = rng.standard_normal((item.body.fish, 3))
    radius = rng.random((item.body.fish, 1)) ** (1 / 3)
    along, across, up = (radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)).T
    cosine, sine = np.cos(item.yaw_rad)[:, None], np.sin(item.yaw_rad)[:, None]
    ahead_m = item.ahead_m[:, None] + item.body.radius_m * (along * cosine + across * sine)
    ground_m = item.ground_m[:, None] + item.sign * item.body.radius_m * (across * cosine - along * sine)
    above_m = item.above_m[:, None] + item.body.half_thickness_m * up
    strength = item.body.backscatter * rng.standard_exponential(item.body.fish) * _FISH_ECHO_M / cell_m
    energy = np.where((np.abs(ahead_m) <= spec.ping_spacing_m / 2) & (ground_m > 0), strength, 0)
    energy = energy * vertical_beam(np.arctan2(-above_m, ground_m) + item.roll_rad[:, None])
    return bin_by_range(energy, np.hypot(ground_m, above_m) / spec.sample_m, spec.samples)
