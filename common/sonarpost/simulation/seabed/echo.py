"""Echo of one side of a side-scan sonar, by ray casting, and the effects of receiver and water.

For each ping the bottom abeam is a profile of height over ground range. A cell is insonified when no nearer cell rises
above the line from the sonar to it. It returns backscatter x cos^2 of its local angle of incidence (Lambert's law)
times its true surface, plus a narrow specular part, weighted by the vertical beam. Its energy is added to the sample of
its slant range: shadow, layover, the dark water column and the first bottom return follow from geometry.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from sonarpost.simulation.seabed.terrain import SAND_BACKSCATTER, Seabed

FloatArray = npt.NDArray[np.float64]
FloatImage = npt.NDArray[np.float32]

_CELLS_PER_SAMPLE: Final = 2
_CHUNK_PINGS: Final = 128
_PULSE_SIGMA_SAMPLES: Final = 0.7
_BEAM_WIDTH_DEG: Final = 0.5
_APERTURE_M: Final = 0.12
"""Near the vehicle the beam is as wide as the effective length of the array."""
_MAIN_LOBE_DEG: Final = 22.0
_LOBE_WIDTH_DEG: Final = 34.0
_BACK_LOBE: Final = 0.02
"""Response of the vertical beam far outside its main lobe, in intensity."""
_SPECULAR: Final = 1.5
_SPECULAR_POWER: Final = 40
_TVG_POWER: Final = 2.1
"""Time-varied gain; it also compensates part of the decrease with grazing angle by Lambert's law."""
_SPECKLE_LOOKS: Final = 2
_NOISE: Final = 0.012
"""Noise at full range after gain, in the intensity of sand at half range."""


@dataclass(frozen=True, slots=True)
class Track:
    """Position and attitude of the sonar at each ping, in the strip's coordinates; arrays (pings,), float64."""

    along_m: FloatArray
    across_m: FloatArray
    height_m: FloatArray
    yaw_rad: FloatArray
    roll_rad: FloatArray


@dataclass(frozen=True, slots=True)
class SonarSettings:
    """Range and sampling of one side."""

    samples: int
    range_m: float
    ping_spacing_m: float

    @property
    def sample_m(self) -> float:
        """Slant range of one sample."""
        return self.range_m / self.samples


def echo_intensity(seabed: Seabed, track: Track, settings: SonarSettings, sign: int) -> FloatImage:
    """Return the mean echo intensity of one side, without speckle and noise: 1 is flat sand at half range.

    `sign` is 1 for starboard, -1 for port.

    Returns:
        Shape (pings, samples), float32; sample 0 is nearest the vehicle.
    """
    pings = track.along_m.shape[0]
    image = np.empty((pings, settings.samples), dtype=np.float32)
    for first in range(0, pings, _CHUNK_PINGS):
        last = min(first + _CHUNK_PINGS, pings)
        image[first:last] = _cast_rays(seabed, track, settings, sign, (first, last))
    image = gaussian_filter1d(image, _PULSE_SIGMA_SAMPLES, axis=1, mode="constant")
    return _spread_beam(image, settings)


def _cast_rays(seabed: Seabed, track: Track, settings: SonarSettings, sign: int, pings: tuple[int, int]) -> FloatImage:
    cell_m = settings.sample_m / _CELLS_PER_SAMPLE
    ground_m = (np.arange(settings.samples * _CELLS_PER_SAMPLE) + 0.5) * cell_m
    rows = slice(*pings)
    # With yaw, the rays are not perpendicular to the strip.
    yaw = track.yaw_rad[rows, None]
    along = track.along_m[rows, None] - sign * np.sin(yaw) * ground_m
    across = track.across_m[rows, None] + sign * np.cos(yaw) * ground_m
    height, backscatter = seabed.sampled(along, across)
    ahead, _ = seabed.sampled(along + seabed.cell_m, across)
    slope_along = (ahead - height) / np.float32(seabed.cell_m)
    drop_m = (track.height_m[rows, None] - height).astype(np.float32)
    insonified = _insonified(drop_m, ground_m.astype(np.float32))
    slant_m = np.hypot(drop_m, ground_m.astype(np.float32))
    slope = np.gradient(height, np.float32(cell_m), axis=1)
    stretch = np.sqrt(1 + slope**2 + slope_along**2)
    incidence = np.clip((ground_m.astype(np.float32) * slope + drop_m) / (slant_m * stretch), 0, 1)
    scattered = backscatter * (incidence**2 + np.float32(_SPECULAR) * incidence**_SPECULAR_POWER)
    depression = np.arctan2(drop_m, ground_m.astype(np.float32)) + sign * track.roll_rad[rows, None]
    energy = insonified * scattered * stretch * _vertical_beam(depression)
    binned = _bin_by_range(energy, np.asarray(slant_m / np.float32(settings.sample_m)), settings.samples)
    # Per unit of slant range, with the gain of the receiver, relative to flat sand at half range.
    centres_m = (np.arange(settings.samples) + 0.5) * settings.sample_m
    gain = (centres_m / (settings.range_m / 2)) ** _TVG_POWER / _CELLS_PER_SAMPLE
    reference = SAND_BACKSCATTER * (np.median(drop_m) / (settings.range_m / 2)) ** 2
    return np.asarray(binned * (gain / reference), dtype=np.float32)


def _insonified(drop_m: FloatImage, ground_m: FloatImage) -> npt.NDArray[np.bool_]:
    """Return the cells that the sonar insonifies: those on or above every nearer line of sight."""
    rise = -drop_m / ground_m
    horizon = np.maximum.accumulate(rise, axis=1)
    return np.asarray(rise >= horizon)


def _vertical_beam(depression_rad: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return the two-way beam pattern over the depression angle: a broad main lobe and a constant side level."""
    off = (np.degrees(depression_rad) - _MAIN_LOBE_DEG) / _LOBE_WIDTH_DEG
    return np.asarray((1 - _BACK_LOBE) * np.exp(-(off**2)) + _BACK_LOBE)


def _bin_by_range(energy: npt.NDArray[np.floating], position: npt.NDArray[np.floating], samples: int) -> FloatArray:
    """Divide the energy of each cell between the two samples next to its slant range (`position`, in samples)."""
    shifted = position - np.float32(0.5)
    left = np.floor(shifted).astype(np.int64)
    share = shifted - left
    row = np.arange(energy.shape[0], dtype=np.int64)[:, None] * (samples + 2)
    total = np.zeros(energy.shape[0] * (samples + 2))
    for index, part in ((left, 1 - share), (left + 1, share)):
        # One column before and one after the samples collect the energy outside the range.
        flat = (row + np.clip(index + 1, 0, samples + 1)).ravel()
        total += np.bincount(flat, weights=(energy * part).ravel(), minlength=total.shape[0])
    return total.reshape(energy.shape[0], samples + 2)[:, 1:-1]


def _spread_beam(image: FloatImage, settings: SonarSettings) -> FloatImage:
    """Blur along the track as the horizontal beam widens with range."""
    centres_m = (np.arange(settings.samples) + 0.5) * settings.sample_m
    width_m = np.hypot(_APERTURE_M, centres_m * math.radians(_BEAM_WIDTH_DEG))
    sigma_pings = width_m / 2.355 / settings.ping_spacing_m
    levels = np.linspace(sigma_pings.min(), sigma_pings.max(), 4)
    step = max(float(levels[1] - levels[0]), 1e-9)
    out = np.zeros_like(image)
    for level in levels:
        share = np.clip(1 - np.abs(sigma_pings - level) / step, 0, 1).astype(np.float32)
        out += share * gaussian_filter1d(image, level, axis=0, mode="nearest")
    return out


def received_amplitude(
    intensity: FloatImage, altitude_m: FloatArray, settings: SonarSettings, rng: np.random.Generator
) -> FloatImage:
    """Return the received amplitude for a mean intensity, with speckle, noise, ringing and gain variation.

    Args:
        intensity: From `echo_intensity`.
        altitude_m: Shape (pings,); scattering in the water ends at the bottom.
        settings: Range and sampling.
        rng: Random generator.

    Returns:
        Same shape, float32, at least 0; 1 is approximately flat sand at half range.
    """
    centres = (np.arange(settings.samples) + 0.5) / settings.samples
    noise = _NOISE * (0.004 + 0.03 * centres + centres**4)
    drift = gaussian_filter1d(rng.standard_normal(intensity.shape[0]), 8.0) * 0.3
    gain = np.exp(drift + 0.015 * rng.standard_normal(intensity.shape[0]))[:, None]
    # Faint clouds of plankton and bubbles in the water column.
    cloud = gaussian_filter1d(gaussian_filter1d(rng.standard_normal(intensity.shape), 30.0, axis=0), 12.0, axis=1)
    water = 0.0004 * np.exp(14.0 * cloud) * (centres * settings.range_m < altitude_m[:, None])
    power = gain * (intensity + water) * _speckle(intensity.shape, rng)
    power += noise * rng.standard_exponential(intensity.shape, dtype=np.float32)
    amplitude = np.sqrt(power)
    amplitude += 6.0 * np.exp(-centres * settings.range_m / 0.05)
    return np.asarray(amplitude, dtype=np.float32)


def _speckle(shape: tuple[int, ...], rng: np.random.Generator) -> FloatImage:
    """Return multi-look speckle of mean 1, correlated over a pulse length.

    Real recordings show an amplitude standard deviation of 0.35 to 0.4 of the mean and a correlation of about 0.4
    between neighbouring samples.
    """
    total = np.zeros(shape, dtype=np.float32)
    for _ in range(2 * _SPECKLE_LOOKS):
        field = gaussian_filter1d(rng.standard_normal(shape, dtype=np.float32), 0.75, axis=1, mode="wrap")
        total += field**2
    return total / np.float32(total.mean())
