"""Variations of the receiver: surface return, crosstalk, error of the time-varied gain, gain steps."""

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from sonarpost.extensions.simulation.seabed.spec import SurveySpec
from sonarpost.sonar.survey import Side

FloatArray = npt.NDArray[np.float64]
FloatImage = npt.NDArray[np.float32]

_SURFACE_TAIL_M: Final = 0.3
_WAVE_M: Final = 0.12
"""Standard deviation of the range of the surface return, by waves."""
_WAVE_S: Final = 0.4


def varied_amplitudes(
    amplitudes: Mapping[Side, FloatImage],
    depth_m: FloatArray,
    spec: SurveySpec,
    rng: np.random.Generator,
    *,
    speckle: bool = True,
) -> dict[Side, FloatImage]:
    """Return received amplitudes with the variations of a specification; unchanged with its default values.

    Args:
        amplitudes: For each side, shape (pings, samples), float32, at least 0.
        depth_m: Shape (pings,): depth of the vehicle.
        spec: Range, sampling and variations.
        rng: Random generator.
        speckle: False for a surface return without speckle.
    """
    surface_rng, gain_rng = rng.spawn(2)
    varied = dict(amplitudes)
    if spec.surface_return:
        for side, image in varied.items():
            surface = _surface_power(depth_m, spec, surface_rng, speckle=speckle)
            varied[side] = np.asarray(np.sqrt(image**2 + surface), dtype=np.float32)
    if spec.crosstalk_db is not None:
        leak = 10 ** (spec.crosstalk_db / 10)
        power = {side: image**2 for side, image in varied.items()}
        total: FloatImage = np.sum(list(power.values()), axis=0)
        for side, own in power.items():
            varied[side] = np.asarray(np.sqrt(own + leak * (total - own)), dtype=np.float32)
    gain = _gain(spec, gain_rng)
    if gain is not None:
        varied = {side: np.asarray(image * gain, dtype=np.float32) for side, image in varied.items()}
    return varied


def _surface_power(depth_m: FloatArray, spec: SurveySpec, rng: np.random.Generator, *, speckle: bool) -> FloatArray:
    """Return the power of the echo from the sea surface above the vehicle, shape (pings, samples)."""
    scale = max(_WAVE_S * spec.ping_rate_hz, 0.5)
    waves = gaussian_filter1d(rng.standard_normal(depth_m.shape[0]), scale) * math.sqrt(2 * math.sqrt(math.pi) * scale)
    centres_m = (np.arange(spec.samples) + 0.5) * spec.sample_m
    behind_m = centres_m - (depth_m + _WAVE_M * waves)[:, None]
    echo = np.where(behind_m >= 0, np.exp(-np.clip(behind_m, 0, None) / _SURFACE_TAIL_M), 0)
    factor = rng.gamma(2.0, 0.5, echo.shape)  # drawn in any case: the draws after it stay the same
    if speckle:
        echo = echo * factor
    smooth = gaussian_filter1d(echo, spec.pulse_sigma_samples, axis=1, mode="constant")
    return np.asarray(spec.surface_return * smooth)


def _gain(spec: SurveySpec, rng: np.random.Generator) -> FloatArray | None:
    """Return the factor of the amplitude, shape (pings, samples) or one that broadcasts to it; None for 1."""
    if not spec.tvg_error and not spec.gain_steps:
        return None
    centres = (np.arange(spec.samples) + 0.5) / spec.samples
    gain: FloatArray = ((2 * centres) ** spec.tvg_error)[None, :]
    if spec.gain_steps:
        starts = rng.integers(0, spec.pings, spec.gain_steps)
        level_db = rng.uniform(-spec.gain_step_db / 2, spec.gain_step_db / 2, spec.gain_steps + 1)
        step = np.searchsorted(np.sort(starts), np.arange(spec.pings), side="right")
        gain = gain * 10 ** (level_db[step] / 20)[:, None]
    return gain
