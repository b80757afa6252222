"""Scattering, vertical beam and sampling of the simulated echo."""

from typing import Final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

_MAIN_LOBE_DEG: Final = 22.0
_LOBE_WIDTH_DEG: Final = 34.0
_BACK_LOBE: Final = 0.02
"""Response of the vertical beam far outside its main lobe, in intensity."""
_SPECULAR: Final = 1.5
_SPECULAR_POWER: Final = 40


def scattered(
    backscatter: npt.NDArray[np.floating] | float, incidence: npt.NDArray[np.floating]
) -> npt.NDArray[np.floating]:
    """Return the echo of a surface for the cosine of its angle of incidence: Lambert's law and a specular part."""
    return np.asarray(backscatter * (incidence**2 + np.float32(_SPECULAR) * incidence**_SPECULAR_POWER))


def vertical_beam(depression_rad: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return the two-way beam pattern over the depression angle: a broad main lobe and a constant side level."""
    off = (np.degrees(depression_rad) - _MAIN_LOBE_DEG) / _LOBE_WIDTH_DEG
    return np.asarray((1 - _BACK_LOBE) * np.exp(-(off**2)) + _BACK_LOBE)


def bin_by_range(energy: npt.NDArray[np.floating], position: npt.NDArray[np.floating], samples: int) -> FloatArray:
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
