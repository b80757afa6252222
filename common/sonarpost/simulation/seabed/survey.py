"""Simulated side-scan survey with ground truth: every object in pings and samples and in geographic coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from sonarpost.errors import ConfigError
from sonarpost.simulation.seabed.echo import FloatImage, SonarSettings, Track, echo_intensity, received_amplitude
from sonarpost.simulation.seabed.targets import (
    CLUTTER_KINDS,
    MINE_LIKE_KINDS,
    ObjectKind,
    SeabedObject,
    place_object,
    random_object,
)
from sonarpost.simulation.seabed.terrain import Seabed, SeabedKind, make_seabed
from sonarpost.sonar.geometry import Position, offset_position
from sonarpost.sonar.survey import ChannelPing, Ping, Samples, Side, Survey

FloatArray = npt.NDArray[np.float64]

SONAR_NAME: Final = "simulated SSS"
_SIGN: Final = {Side.PORT: -1, Side.STARBOARD: 1}
_SAND_LEVEL: Final = 0.26
"""Level of flat sand at half range, as a fraction of full scale."""
_MARGIN_M: Final = 2.0
_MIN_DISTANCE_M: Final = 5.0
_PLACEMENT_TRIES: Final = 400


@dataclass(frozen=True, slots=True)
class SurveySpec:
    """Specification of a survey. The same values give the same survey, sample for sample.

    Attributes:
        seed: Seed of every random draw.
        pings: 1 to 10,000.
        samples: Samples per side, 64 to 8192.
        range_m: Slant range per side.
        altitude_m: Mean altitude; at most half the range.
        speed_mps: Speed over ground.
        ping_rate_hz: Pings per second; the echo must return before the next ping.
        heading_deg: Mean course, true.
        start_lat_deg: Latitude of the first ping.
        start_lon_deg: Longitude of the first ping.
        start_time_utc_s: Time of the first ping.
        seabed: Type of seabed.
        targets: Number or kinds of the mine-like objects.
        clutter: Number or kinds of the other objects.
        bits: 8 or 16 bits per sample.
        motion: Scale of the vehicle's yaw, roll and altitude variations: 0 none, 1 typical.
        water_depth_m: Mean depth of the seabed; at least the altitude.
        frequency_hz: Sonar frequency, recorded in the survey.

    Raises:
        ConfigError: A value outside these limits.
    """

    seed: int = 0
    pings: int = 1000
    samples: int = 1024
    range_m: float = 30.0
    altitude_m: float = 5.0
    speed_mps: float = 1.5
    ping_rate_hz: float = 15.0
    heading_deg: float = 40.0
    start_lat_deg: float = 56.45
    start_lon_deg: float = -5.6
    start_time_utc_s: float = 1_475_568_000.0
    seabed: SeabedKind = SeabedKind.MIXED
    targets: int | tuple[ObjectKind, ...] = 4
    clutter: int | tuple[ObjectKind, ...] = 6
    bits: int = 8
    motion: float = 1.0
    water_depth_m: float = 20.0
    frequency_hz: float = 600_000.0

    def __post_init__(self) -> None:
        limits = {
            "seed": (self.seed, 0, 2**63),
            "pings": (self.pings, 1, 10_000),
            "samples": (self.samples, 64, 8192),
            "range_m": (self.range_m, 5, 200),
            "altitude_m": (self.altitude_m, 1, self.range_m / 2),
            "speed_mps": (self.speed_mps, 0.2, 10),
            "ping_rate_hz": (self.ping_rate_hz, 0.5, 750 / self.range_m),
            "heading_deg": (self.heading_deg, 0, 360),
            "start_lat_deg": (self.start_lat_deg, -85, 85),
            "start_lon_deg": (self.start_lon_deg, -180, 180),
            "start_time_utc_s": (self.start_time_utc_s, 0, 2**33),
            "motion": (self.motion, 0, 5),
            "water_depth_m": (self.water_depth_m, self.altitude_m, 6000),
            "frequency_hz": (self.frequency_hz, 20_000, 5_000_000),
            "targets": (_count(self.targets), 0, 1000),
            "clutter": (_count(self.clutter), 0, 1000),
        }
        for name, (value, low, high) in limits.items():
            if not low <= value <= high:
                raise ConfigError("survey simulator", name, value, f"{low:g} to {high:g}")
        if self.bits not in (8, 16):
            raise ConfigError("survey simulator", "bits", self.bits, "8 or 16")

    @property
    def ping_spacing_m(self) -> float:
        """Distance between pings along the track."""
        return self.speed_mps / self.ping_rate_hz


@dataclass(frozen=True, slots=True)
class TruthObject:
    """Position of an object on the seabed and in the recording.

    Attributes:
        kind: Shape.
        is_mine_like: Whether it has the shape and size of a sea mine.
        side: Channel that records it.
        ping: Index of the ping in which it is abeam.
        sample_index: Sample of its centre at half its height; 0 is nearest the vehicle.
        lat_deg: Latitude of its centre.
        lon_deg: Longitude of its centre.
        ground_range_m: From the track to its centre.
        length_m: Along its long axis.
        width_m: Across its long axis.
        height_m: Above the seabed.
        orientation_deg: Long axis, clockwise from the course.
    """

    kind: ObjectKind
    is_mine_like: bool
    side: Side
    ping: int
    sample_index: int
    lat_deg: float
    lon_deg: float
    ground_range_m: float
    length_m: float
    width_m: float
    height_m: float
    orientation_deg: float


@dataclass(frozen=True, slots=True)
class SimulatedSurvey:
    """A survey and its ground truth."""

    survey: Survey
    truth: tuple[TruthObject, ...]


def simulate_survey(spec: SurveySpec) -> SimulatedSurvey:
    """Simulate a survey line.

    Returns:
        The survey, whose path contains the seed as there is no file, and the truth in order of pings.

    Raises:
        ConfigError: More objects than fit with the minimum distance between them.
    """
    # Separate generators: another number of targets does not change seabed, track and noise.
    seabed_rng, object_rng, track_rng, noise_rng = (
        np.random.default_rng(s) for s in np.random.SeedSequence(spec.seed).spawn(4)
    )
    length_m = spec.ping_spacing_m * (spec.pings - 1)
    reach_m = spec.range_m + _MARGIN_M
    seabed = make_seabed(
        spec.seabed,
        along_m=(-_MARGIN_M - 0.05 * reach_m, length_m + _MARGIN_M + 0.05 * reach_m),
        across_m=(-reach_m, reach_m),
        cell_m=min(max(spec.range_m / 600, 0.025), 0.15),
        rng=seabed_rng,
    )
    objects = _random_objects(spec, length_m, object_rng)
    grounds_m = [place_object(seabed, item) for item in objects]
    track, altitude_m = _simulate_track(spec, seabed, track_rng)
    settings = SonarSettings(spec.samples, spec.range_m, spec.ping_spacing_m)
    sides = {
        side: _quantised(
            received_amplitude(echo_intensity(seabed, track, settings, sign), altitude_m, settings, noise_rng),
            spec.bits,
        )
        for side, sign in _SIGN.items()
    }
    truth = [_truth(spec, track, *pair) for pair in zip(objects, grounds_m, strict=True)]
    truth.sort(key=lambda item: item.ping)
    return SimulatedSurvey(_survey(spec, track, altitude_m, sides), tuple(truth))


def _count(objects: int | tuple[ObjectKind, ...]) -> int:
    return objects if isinstance(objects, int) else len(objects)


def _kinds(
    objects: int | tuple[ObjectKind, ...], choice: tuple[ObjectKind, ...], rng: np.random.Generator
) -> list[ObjectKind]:
    """Return the kinds; for a number, each kind in turn, starting with a random one."""
    if not isinstance(objects, int):
        return list(objects)
    first = int(rng.integers(len(choice)))
    return [choice[(first + i) % len(choice)] for i in range(objects)]


def _random_objects(spec: SurveySpec, length_m: float, rng: np.random.Generator) -> list[SeabedObject]:
    """Place objects on both sides at random, away from nadir, from the far edge and from each other."""
    kinds = _kinds(spec.targets, MINE_LIKE_KINDS, rng) + _kinds(spec.clutter, CLUTTER_KINDS, rng)
    inset_m = min(4.0, length_m / 4)
    objects: list[SeabedObject] = []
    for kind in kinds:
        for _ in range(_PLACEMENT_TRIES):
            along_m = float(rng.uniform(inset_m, length_m - inset_m))
            ground_m = float(rng.uniform(1.1 * spec.altitude_m, 0.8 * spec.range_m))
            across_m = ground_m if rng.random() < 0.5 else -ground_m
            if all(math.hypot(along_m - t.along_m, across_m - t.across_m) > _MIN_DISTANCE_M for t in objects):
                objects.append(random_object(kind, along_m, across_m, rng))
                break
        else:
            expected = f"objects that fit on {length_m:.0f} m of track"
            raise ConfigError("survey simulator", "targets and clutter", len(kinds), expected)
    return objects


def _smooth_noise(count: int, scale_pings: float, rng: np.random.Generator) -> FloatArray:
    """Return noise of approximately unit variance, smoothed over `scale_pings`."""
    white = rng.standard_normal(count)
    smooth = gaussian_filter1d(white, scale_pings, mode="reflect")
    return np.asarray(smooth * math.sqrt(2 * math.sqrt(math.pi) * scale_pings), dtype=np.float64)


def _simulate_track(spec: SurveySpec, seabed: Seabed, rng: np.random.Generator) -> tuple[Track, FloatArray]:
    """Return the track and the altitude above the seabed, both per ping."""
    slow, swell = 12.0 * spec.ping_rate_hz, 1.6 * spec.ping_rate_hz
    yaw_deg = spec.motion * (1.2 * _smooth_noise(spec.pings, slow, rng) + 0.12 * _smooth_noise(spec.pings, swell, rng))
    roll_deg = spec.motion * (0.8 * _smooth_noise(spec.pings, slow, rng) + 0.4 * _smooth_noise(spec.pings, swell, rng))
    along_m = np.arange(spec.pings, dtype=np.float64) * spec.ping_spacing_m
    drift_m = np.sin(np.radians(yaw_deg)) * spec.ping_spacing_m
    across_m = np.cumsum(drift_m - drift_m.mean())
    bottom_m = np.asarray(seabed.sampled(along_m, across_m)[0], dtype=np.float64)
    # The vehicle follows the seabed with a delay of some seconds and a slowly varying error.
    followed_m = gaussian_filter1d(bottom_m, 3.0 * spec.ping_rate_hz, mode="nearest")
    slow_error, fast_error = _smooth_noise(spec.pings, slow, rng), _smooth_noise(spec.pings, swell, rng)
    altitude_factor = 1 + spec.motion * (0.08 * slow_error + 0.006 * fast_error)
    height_m = followed_m + spec.altitude_m * np.clip(altitude_factor, 0.5, 1.5)
    track = Track(along_m, across_m, height_m, np.radians(yaw_deg), np.radians(roll_deg))
    return track, height_m - bottom_m


def _quantised(amplitude: FloatImage, bits: int) -> Samples:
    full = 255 if bits == 8 else 32767  # recorders of 16 bits do not use the highest bit
    counts = np.clip(np.rint(amplitude * (_SAND_LEVEL * full)), 0, full)
    samples: Samples = counts.astype(np.uint8) if bits == 8 else counts.astype(np.uint16)
    return samples


def _geographic_position(spec: SurveySpec, along_m: float, across_m: float) -> Position:
    bearing_deg = spec.heading_deg + math.degrees(math.atan2(across_m, along_m))
    start = Position(spec.start_lat_deg, spec.start_lon_deg)
    return offset_position(start, bearing_deg, math.hypot(along_m, across_m))


def _survey(spec: SurveySpec, track: Track, altitude_m: FloatArray, sides: dict[Side, Samples]) -> Survey:
    pings = []
    for row in range(spec.pings):
        position = _geographic_position(spec, float(track.along_m[row]), float(track.across_m[row]))
        channels = tuple(
            ChannelPing(side, samples[row], spec.range_m, spec.frequency_hz) for side, samples in sides.items()
        )
        pings.append(
            Ping(
                number=row + 1,
                time_utc_s=spec.start_time_utc_s + row / spec.ping_rate_hz,
                channels=channels,
                lat_deg=position.lat_deg,
                lon_deg=position.lon_deg,
                heading_deg=(spec.heading_deg + math.degrees(track.yaw_rad[row])) % 360,
                altitude_m=float(altitude_m[row]),
                depth_m=spec.water_depth_m - float(track.height_m[row]),
                speed_mps=spec.speed_mps,
                pitch_deg=None,
                roll_deg=math.degrees(track.roll_rad[row]),
            )
        )
    name = f"simulated-{spec.seabed}-{spec.seed}"
    return Survey(Path(name), SONAR_NAME, name, tuple(pings))


def _truth(spec: SurveySpec, track: Track, item: SeabedObject, ground_m: float) -> TruthObject:
    """Return the ping in which an object is abeam, and the sample of its centre."""
    along = item.along_m - track.along_m
    across = item.across_m - track.across_m
    ahead = along * np.cos(track.yaw_rad) + across * np.sin(track.yaw_rad)
    row = int(np.argmin(np.abs(ahead)))
    abeam_m = float(across[row] * math.cos(track.yaw_rad[row]) - along[row] * math.sin(track.yaw_rad[row]))
    drop_m = float(track.height_m[row]) - ground_m - item.height_m / 2
    slant_m = math.hypot(abeam_m, drop_m)
    position = _geographic_position(spec, item.along_m, item.across_m)
    return TruthObject(
        kind=item.kind,
        is_mine_like=item.is_mine_like,
        side=Side.STARBOARD if abeam_m > 0 else Side.PORT,
        ping=row,
        sample_index=min(int(slant_m / spec.range_m * spec.samples), spec.samples - 1),
        lat_deg=position.lat_deg,
        lon_deg=position.lon_deg,
        ground_range_m=abs(abeam_m),
        length_m=item.length_m,
        width_m=item.width_m,
        height_m=item.height_m,
        orientation_deg=item.orientation_deg,
    )
