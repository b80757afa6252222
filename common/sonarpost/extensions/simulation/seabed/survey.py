"""Simulated side-scan survey with ground truth: every object in pings and samples and in geographic coordinates.

The echo is computed by ray casting, with the effects of receiver and water. For each ping the bottom abeam is a profile
of height over ground range. A cell is insonified when no nearer cell rises above the line from the sonar to it. It
returns backscatter x cos^2 of its local angle of incidence (Lambert's law) times its true surface, plus a narrow
specular part, weighted by the vertical beam. Its energy is added to the sample of its slant range: shadow, layover, the
dark water column and the first bottom return follow from geometry.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.seabed.midwater import SonarPath, body_echoes, slices, unblocked
from sonarpost.extensions.simulation.seabed.objects import (
    CLUTTER_KINDS,
    MINE_LIKE_KINDS,
    STRUCTURE_KINDS,
    SUSPENDED_KINDS,
    ObjectKind,
    SeabedObject,
    random_object,
    settled,
)
from sonarpost.extensions.simulation.seabed.receiver_variations import varied_amplitudes
from sonarpost.extensions.simulation.seabed.scattering import bin_by_range, scattered, vertical_beam
from sonarpost.extensions.simulation.seabed.spec import SurveySpec
from sonarpost.extensions.simulation.seabed.targets import place_object
from sonarpost.extensions.simulation.seabed.terrain import SAND_BACKSCATTER, RippleOptions, Seabed, make_seabed
from sonarpost.sonar.geometry import Position, offset_position
from sonarpost.sonar.survey import ChannelPing, Ping, Samples, Side, Survey

__all__ = ["SimulatedSurvey", "SurveySpec", "TruthObject", "echo_intensity", "received_amplitude", "simulate_survey"]

FloatArray = npt.NDArray[np.float64]
FloatImage = npt.NDArray[np.float32]

SONAR_NAME: Final = "simulated SSS"
_SIGN: Final = {Side.PORT: -1, Side.STARBOARD: 1}
_SAND_LEVEL: Final = 0.26
"""Level of flat sand at half range, as a fraction of full scale."""
_MARGIN_M: Final = 2.0
_MIN_DISTANCE_M: Final = 5.0
_PLACEMENT_TRIES: Final = 400
_TALLEST: Final = 0.6
"""Greatest height of a structure or of an object above the seabed, as a fraction of the altitude."""

_CELLS_PER_SAMPLE: Final = 2
_CHUNK_PINGS: Final = 128
_APERTURE_M: Final = 0.12
"""Near the vehicle the beam is as wide as the effective length of the array."""
_TVG_POWER: Final = 2.1
"""Time-varied gain; it also compensates part of the decrease with grazing angle by Lambert's law."""
_SPECKLE_LOOKS: Final = 2
_NOISE: Final = 0.012
"""Noise at full range after gain, in the intensity of sand at half range."""


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


def simulate_survey(spec: SurveySpec, *, speckle: bool = True) -> SimulatedSurvey:
    """Simulate a survey line.

    Args:
        spec: Specification of the survey.
        speckle: False for the same survey without speckle. All other random draws are the same.

    Returns:
        The survey, whose path contains the seed as there is no file, and the truth in order of pings.

    Raises:
        ConfigError: More objects than fit with the minimum distance between them.
    """
    # Separate generators: another number of targets does not change seabed, track and noise.
    seabed_rng, object_rng, track_rng, noise_rng, settling_rng, receiver_rng = (
        np.random.default_rng(s) for s in np.random.SeedSequence(spec.seed).spawn(6)
    )
    length_m = spec.ping_spacing_m * (spec.pings - 1)
    reach_m = spec.range_m + _MARGIN_M
    seabed = make_seabed(
        spec.seabed,
        along_m=(-_MARGIN_M - 0.05 * reach_m, length_m + _MARGIN_M + 0.05 * reach_m),
        across_m=(-reach_m, reach_m),
        cell_m=min(max(spec.range_m / 600, 0.025), 0.15),
        rng=seabed_rng,
        ripples=RippleOptions(spec.ripple_wavelength_m, spec.ripple_systems, (spec.seed, 1)),
    )
    current_deg = float(settling_rng.uniform(0, 360))
    objects = [
        settled(item, spec.burial, spec.tilt_deg, spec.scour, current_deg, settling_rng)
        for item in _random_objects(spec, length_m, object_rng)
    ]
    grounds_m = [place_object(seabed, item) for item in objects]
    track, altitude_m = _simulate_track(spec, seabed, track_rng)
    amplitudes = {
        side: received_amplitude(
            echo_intensity(seabed, track, spec, sign), altitude_m, spec, noise_rng, speckle=speckle
        )
        for side, sign in _SIGN.items()
    }
    depth_m = spec.water_depth_m - track.height_m
    varied = varied_amplitudes(amplitudes, depth_m, spec, receiver_rng, speckle=speckle)
    sides = {side: _quantised(amplitude, spec.bits) for side, amplitude in varied.items()}
    truth = [_truth(spec, track, *pair) for pair in zip(objects, grounds_m, strict=True)]
    truth.sort(key=lambda item: item.ping)
    return SimulatedSurvey(_survey(spec, track, altitude_m, sides), tuple(truth))


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
    # Structures first: they find no place between many small objects.
    kinds.sort(key=lambda kind: kind not in STRUCTURE_KINDS)
    inset_m = min(4.0, length_m / 4)
    objects: list[SeabedObject] = []
    for kind in kinds:
        for _ in range(_PLACEMENT_TRIES):
            along_m = float(rng.uniform(inset_m, length_m - inset_m))
            ground_m = float(rng.uniform(1.1 * spec.altitude_m, 0.8 * spec.range_m))
            across_m = ground_m if rng.random() < 0.5 else -ground_m
            if kind in STRUCTURE_KINDS:
                structure = _limited_height(random_object(kind, along_m, across_m, rng), spec)
                # The vehicle does not pass over a structure.
                nearest_m = float(np.min(np.sign(across_m) * _axis_m(structure)[:, 1])) - structure.width_m / 2
                if nearest_m > 0.5 * spec.altitude_m and all(_gap_m(structure, t) > _MIN_DISTANCE_M for t in objects):
                    objects.append(structure)
                    break
            elif all(_distance_m(t, along_m, across_m) > _MIN_DISTANCE_M for t in objects):
                objects.append(_limited_height(random_object(kind, along_m, across_m, rng), spec))
                break
        else:
            expected = f"objects that fit on {length_m:.0f} m of track"
            raise ConfigError("survey simulator", "targets and clutter", len(kinds), expected)
    return objects


def _limited_height(item: SeabedObject, spec: SurveySpec) -> SeabedObject:
    """Return a structure or an object above the seabed, lowered to stay below the vehicle."""
    if not (item.is_structure or item.kind in SUSPENDED_KINDS):
        return item
    lowest_m = item.thickness_m if item.kind in SUSPENDED_KINDS else 0.0
    return replace(item, height_m=max(min(item.height_m, _TALLEST * spec.altitude_m), lowest_m))


def _axis_m(item: SeabedObject) -> FloatArray:
    """Return points of an object, shape (points, 2), along and across: its centre, or the long axis of a structure."""
    half_m = item.length_m / 2 if item.is_structure else 0.0
    at_m = np.linspace(-half_m, half_m, 1 + 2 * math.ceil(half_m))
    turn = math.radians(item.orientation_deg)
    return np.stack([item.along_m + at_m * math.cos(turn), item.across_m + at_m * math.sin(turn)], axis=1)


def _distance_m(item: SeabedObject, along_m: float, across_m: float) -> float:
    """Return the distance of a position from the centre of an object, or from the side of a structure."""
    if not item.is_structure:
        return math.hypot(along_m - item.along_m, across_m - item.across_m)
    off = _axis_m(item) - (along_m, across_m)
    return float(np.hypot(off[:, 0], off[:, 1]).min()) - item.width_m / 2


def _gap_m(one: SeabedObject, other: SeabedObject) -> float:
    return min(_distance_m(other, *map(float, point)) for point in _axis_m(one)) - one.width_m / 2


def _smooth_noise(count: int, scale_pings: float, rng: np.random.Generator) -> FloatArray:
    """Return noise of approximately unit variance, smoothed over `scale_pings`."""
    white = rng.standard_normal(count)
    smooth = gaussian_filter1d(white, scale_pings, mode="reflect")
    return np.asarray(smooth * math.sqrt(2 * math.sqrt(math.pi) * scale_pings), dtype=np.float64)


def _simulate_track(spec: SurveySpec, seabed: Seabed, rng: np.random.Generator) -> tuple[SonarPath, FloatArray]:
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
    track = SonarPath(along_m, across_m, height_m, np.radians(yaw_deg), np.radians(roll_deg))
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


def _survey(spec: SurveySpec, track: SonarPath, altitude_m: FloatArray, sides: dict[Side, Samples]) -> Survey:
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


def _truth(spec: SurveySpec, track: SonarPath, item: SeabedObject, ground_m: float) -> TruthObject:
    """Return the ping in which an object is abeam, and the sample of its centre."""
    along = item.along_m - track.along_m
    across = item.across_m - track.across_m
    ahead = along * np.cos(track.yaw_rad) + across * np.sin(track.yaw_rad)
    row = int(np.argmin(np.abs(ahead)))
    abeam_m = float(across[row] * math.cos(track.yaw_rad[row]) - along[row] * math.sin(track.yaw_rad[row]))
    drop_m = float(track.height_m[row]) - ground_m - item.centre_height_m
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


def echo_intensity(seabed: Seabed, track: SonarPath, spec: SurveySpec, sign: int) -> FloatImage:
    """Return the mean echo intensity of one side, without speckle and noise: 1 is flat sand at half range.

    `sign` is 1 for starboard, -1 for port.

    Returns:
        Shape (pings, samples), float32; sample 0 is nearest the vehicle.
    """
    pings = track.along_m.shape[0]
    image = np.empty((pings, spec.samples), dtype=np.float32)
    for first in range(0, pings, _CHUNK_PINGS):
        last = min(first + _CHUNK_PINGS, pings)
        image[first:last] = _cast_rays(seabed, track, spec, sign, (first, last))
    image = gaussian_filter1d(image, spec.pulse_sigma_samples, axis=1, mode="constant")
    return _spread_beam(image, spec)


def _cast_rays(seabed: Seabed, track: SonarPath, spec: SurveySpec, sign: int, pings: tuple[int, int]) -> FloatImage:
    cell_m = spec.sample_m / _CELLS_PER_SAMPLE
    ground_m = (np.arange(spec.samples * _CELLS_PER_SAMPLE) + 0.5) * cell_m
    rows = slice(*pings)
    # With yaw, the rays are not perpendicular to the strip.
    yaw = track.yaw_rad[rows, None]
    along = track.along_m[rows, None] - sign * np.sin(yaw) * ground_m
    across = track.across_m[rows, None] + sign * np.cos(yaw) * ground_m
    height, backscatter = seabed.sampled(along, across)
    ahead, _ = seabed.sampled(along + seabed.cell_m, across)
    slope_along = (ahead - height) / np.float32(seabed.cell_m)
    drop_m = (track.height_m[rows, None] - height).astype(np.float32)
    insonified: npt.NDArray[np.bool_ | np.floating] = _insonified(drop_m, ground_m.astype(np.float32))
    sliced = slices(seabed.suspended, track, sign, pings)
    if sliced:
        insonified = insonified * unblocked(sliced, drop_m, ground_m)
    slant_m = np.hypot(drop_m, ground_m.astype(np.float32))
    slope = np.gradient(height, np.float32(cell_m), axis=1)
    stretch = np.sqrt(1 + slope**2 + slope_along**2)
    incidence = np.clip((ground_m.astype(np.float32) * slope + drop_m) / (slant_m * stretch), 0, 1)
    echo = scattered(backscatter, incidence)
    depression = np.arctan2(drop_m, ground_m.astype(np.float32)) + sign * track.roll_rad[rows, None]
    energy = insonified * echo * stretch * vertical_beam(depression)
    binned = bin_by_range(energy, np.asarray(slant_m / np.float32(spec.sample_m)), spec.samples)
    if sliced:
        binned += body_echoes(sliced, cell_m, spec)
    # Per unit of slant range, with the gain of the receiver, relative to flat sand at half range.
    centres_m = (np.arange(spec.samples) + 0.5) * spec.sample_m
    gain = (centres_m / (spec.range_m / 2)) ** _TVG_POWER / _CELLS_PER_SAMPLE
    reference = SAND_BACKSCATTER * (np.median(drop_m) / (spec.range_m / 2)) ** 2
    return np.asarray(binned * (gain / reference), dtype=np.float32)


def _insonified(drop_m: FloatImage, ground_m: FloatImage) -> npt.NDArray[np.bool_]:
    """Return the cells that the sonar insonifies: those on or above every nearer line of sight."""
    rise = -drop_m / ground_m
    horizon = np.maximum.accumulate(rise, axis=1)
    return np.asarray(rise >= horizon)


def _spread_beam(image: FloatImage, spec: SurveySpec) -> FloatImage:
    """Blur along the track as the horizontal beam widens with range."""
    centres_m = (np.arange(spec.samples) + 0.5) * spec.sample_m
    width_m = np.hypot(_APERTURE_M, centres_m * math.radians(spec.beam_width_deg))
    sigma_pings = width_m / 2.355 / spec.ping_spacing_m
    levels = np.linspace(sigma_pings.min(), sigma_pings.max(), 4)
    step = max(float(levels[1] - levels[0]), 1e-9)
    out = np.zeros_like(image)
    for level in levels:
        share = np.clip(1 - np.abs(sigma_pings - level) / step, 0, 1).astype(np.float32)
        out += share * gaussian_filter1d(image, level, axis=0, mode="nearest")
    return out


def received_amplitude(
    intensity: FloatImage,
    altitude_m: FloatArray,
    spec: SurveySpec,
    rng: np.random.Generator,
    *,
    speckle: bool = True,
) -> FloatImage:
    """Return the received amplitude for a mean intensity, with speckle, noise, ringing and gain variation.

    Args:
        intensity: From `echo_intensity`.
        altitude_m: Shape (pings,); scattering in the water ends at the bottom.
        spec: Range and sampling.
        rng: Random generator.
        speckle: False for a speckle factor of 1. The other random draws are the same.

    Returns:
        Same shape, float32, at least 0; 1 is approximately flat sand at half range.
    """
    centres = (np.arange(spec.samples) + 0.5) / spec.samples
    noise = _NOISE * (0.004 + 0.03 * centres + centres**4)
    drift = gaussian_filter1d(rng.standard_normal(intensity.shape[0]), 8.0) * 0.3
    gain = np.exp(drift + 0.015 * rng.standard_normal(intensity.shape[0]))[:, None]
    # Faint clouds of plankton and bubbles in the water column.
    cloud = gaussian_filter1d(gaussian_filter1d(rng.standard_normal(intensity.shape), 30.0, axis=0), 12.0, axis=1)
    water = 0.0004 * np.exp(14.0 * cloud) * (centres * spec.range_m < altitude_m[:, None])
    drawn_speckle = _speckle(
        intensity.shape, rng, max(0.75, spec.pulse_sigma_samples)
    )  # drawn in any case: the draws after it stay the same
    power = gain * (intensity + water) * (drawn_speckle if speckle else np.float32(1.0))
    power += noise * rng.standard_exponential(intensity.shape, dtype=np.float32)
    amplitude = np.sqrt(power)
    amplitude += 6.0 * np.exp(-centres * spec.range_m / 0.05)
    return np.asarray(amplitude, dtype=np.float32)


def _speckle(shape: tuple[int, ...], rng: np.random.Generator, sigma_samples: float) -> FloatImage:
    """Return multi-look speckle of mean 1, correlated over a pulse length.

    Real recordings show an amplitude standard deviation of 0.35 to 0.4 of the mean and a correlation of about 0.4
    between neighbouring samples.
    """
    total = np.zeros(shape, dtype=np.float32)
    for _ in range(2 * _SPECKLE_LOOKS):
        field = gaussian_filter1d(rng.standard_normal(shape, dtype=np.float32), sigma_samples, axis=1, mode="wrap")
        total += field**2
    return total / np.float32(total.mean())
