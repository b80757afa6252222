"""Simulated seabeds: seeded maps of height and backscatter.

Both maps cover the surveyed strip, along and across the track. Heights are metres about a mean of zero. Backscatter is
the Lambert coefficient, linear in intensity: mud about 0.1, sand 0.3, gravel 0.6, rock 0.8 at the some hundred
kilohertz of a side-scan sonar. The shapes follow recordings: power-law relief, ripples with sharp crests that meander
and fork, patches with soft borders, rock outcrops in sand.
"""

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy.ndimage import gaussian_filter, map_coordinates

FloatMap = npt.NDArray[np.float32]

SAND_BACKSCATTER: Final = 0.3
_TALLEST_RIPPLE_M: Final = 0.12


class SeabedKind(StrEnum):
    """Type of seabed."""

    SAND = "sand"
    RIPPLES = "ripples"
    GRAVEL = "gravel"
    MUD = "mud"
    ROCK = "rock"
    MIXED = "mixed"


@dataclass(frozen=True, slots=True)
class SuspendedBody:
    """A spheroid above the seabed with a vertical axis: solid, or a cloud of fish.

    Attributes:
        along_m: Along-track coordinate of its centre.
        across_m: Across-track coordinate of its centre, starboard positive.
        height_m: Height of its centre in the strip's coordinates.
        radius_m: Horizontal radius.
        half_thickness_m: Vertical radius.
        backscatter: Lambert coefficient of a solid body; strength of one fish.
        fish: Number of fish; 0 for a solid body.
        seed: Seed of the positions of the fish.
    """

    along_m: float
    across_m: float
    height_m: float
    radius_m: float
    half_thickness_m: float
    backscatter: float
    fish: int = 0
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Seabed:
    """A strip of seabed. Placing an object changes its arrays, and adds to the bodies above the seabed.

    Attributes:
        height_m: Shape (along, across), float32, metres.
        backscatter: Same shape, float32, linear.
        cell_m: Size of a cell.
        along_start_m: Along-track coordinate of row 0.
        across_start_m: Across-track coordinate of column 0; starboard is positive.
        suspended: Bodies above the seabed.
    """

    height_m: FloatMap
    backscatter: FloatMap
    cell_m: float
    along_start_m: float
    across_start_m: float
    suspended: list[SuspendedBody] = field(default_factory=list)

    def sampled(self, along_m: npt.NDArray[np.float64], across_m: npt.NDArray[np.float64]) -> tuple[FloatMap, FloatMap]:
        """Return height and backscatter at positions, linearly interpolated; beyond the edge they are constant."""
        cells = np.stack([(along_m - self.along_start_m) / self.cell_m, (across_m - self.across_start_m) / self.cell_m])
        height = map_coordinates(self.height_m, cells, order=1, mode="nearest")
        backscatter = map_coordinates(self.backscatter, cells, order=1, mode="nearest")
        return height, backscatter


@dataclass(frozen=True, slots=True)
class RippleOptions:
    """Ripples of a seabed.

    Attributes:
        wavelength_m: Distance between crests of the main ripples; None for a random one of 0.55 to 1.1 m.
        systems: Number of superposed ripple systems; those after the first have 0.3 to 3 times the wavelength.
        seed: Seed of the systems after the first.
    """

    wavelength_m: float | None = None
    systems: int = 1
    seed: int | tuple[int, ...] = 0


@dataclass(frozen=True, slots=True)
class _Patch:
    height_m: FloatMap
    backscatter: FloatMap


class _TextureGenerator:
    """Generates textures of one size from one random generator, and further ripples from a second one."""

    def __init__(
        self, shape: tuple[int, int], cell_m: float, rng: np.random.Generator, ripples: RippleOptions | None = None
    ) -> None:
        self._shape = shape
        self._cell_m = cell_m
        self._rng = rng
        self._ripples = ripples or RippleOptions()
        along = scipy.fft.fftfreq(shape[0], cell_m).astype(np.float32)
        across = scipy.fft.rfftfreq(shape[1], cell_m).astype(np.float32)
        self._wavenumber = np.hypot(along[:, None], across[None, :])

    def fractal(
        self, exponent: float, longest_m: float, shortest_m: float, rng: np.random.Generator | None = None
    ) -> FloatMap:
        """Return unit-variance noise with power proportional to wavenumber**-exponent between two wavelengths."""
        k = self._wavenumber
        with np.errstate(divide="ignore"):
            amplitude = np.where(k > 0, k ** np.float32(-exponent / 2), np.float32(0))
        amplitude *= (k >= 1 / longest_m) * np.exp(-((k * np.float32(shortest_m) / 2) ** 2))
        white = (rng or self._rng).standard_normal(self._shape, dtype=np.float32)
        noise = scipy.fft.irfft2(scipy.fft.rfft2(white) * amplitude, s=self._shape)
        spread = float(noise.std())
        # Without a component in the band, as in a very small strip, the texture is flat.
        return np.asarray(noise / spread if spread > 0 else noise, dtype=np.float32)

    def sand(self) -> _Patch:
        height = 0.05 * self.fractal(3.2, 18.0, 0.5) + 0.004 * self.fractal(2.0, 1.0, 0.12)
        patches = 0.22 * self.fractal(3.2, 30.0, 0.8) + 0.06 * self.fractal(2.0, 1.5, 0.15)
        return _Patch(height, np.asarray(SAND_BACKSCATTER * np.exp(patches), dtype=np.float32))

    def ripples(self) -> _Patch:
        drawn_m = self._rng.uniform(0.55, 1.1)  # drawn in any case: the draws after it stay the same
        wavelength_m = self._ripples.wavelength_m or drawn_m
        profile, relief = self._ripple_system(wavelength_m, self._rng.uniform(-math.pi, math.pi))
        bed = self.sand()
        extra_rng = np.random.default_rng(self._ripples.seed)
        for _ in range(self._ripples.systems - 1):
            # Crossing ripples, weaker than the first.
            other_m, direction = wavelength_m * extra_rng.uniform(0.3, 3.0), extra_rng.uniform(-math.pi, math.pi)
            other, more = self._ripple_system(max(other_m, 0.2), direction, extra_rng)
            share = np.float32(extra_rng.uniform(0.3, 0.8))
            profile, relief = profile + share * other, relief + share * more
        # Coarse grains and shells collect in the troughs.
        coarse = np.asarray(1.15 - 0.12 * np.clip(profile, -1, 1), dtype=np.float32)
        return _Patch(relief + np.float32(0.6) * bed.height_m, bed.backscatter * coarse)

    def _ripple_system(
        self, wavelength_m: float, direction: float, rng: np.random.Generator | None = None
    ) -> tuple[npt.NDArray[np.floating], FloatMap]:
        """Return profile and relief of ripples of one wavelength and direction."""
        along = np.arange(self._shape[0], dtype=np.float32)[:, None] * self._cell_m
        across = np.arange(self._shape[1], dtype=np.float32)[None, :] * self._cell_m
        carrier = (along * math.cos(direction) + across * math.sin(direction)) / wavelength_m
        # Strong, slow phase variations make the crests meander, fork and end.
        slow_m = max(16.0, 14.5 * wavelength_m), max(2.0, 1.8 * wavelength_m)
        fast_m = max(2.5, 2.2 * wavelength_m), max(0.4, 0.35 * wavelength_m)
        phase = 2 * math.pi * carrier + 2.2 * self.fractal(3.5, *slow_m, rng) + 0.35 * self.fractal(2.0, *fast_m, rng)
        # Wave ripples have sharp crests and round troughs.
        profile = np.exp(1.1 * np.sin(phase)) - 1.26
        strength = np.clip(0.75 + 0.35 * self.fractal(3.0, 20.0, 3.0, rng), 0.15, 1.3)
        relief = np.asarray(min(wavelength_m / 38, _TALLEST_RIPPLE_M) * strength * profile, dtype=np.float32)
        return profile, relief

    def gravel(self) -> _Patch:
        stones = np.clip(self.fractal(0.8, 0.8, 0.12) - 0.9, 0, None) * 0.055
        height = stones + 0.05 * self.fractal(3.0, 12.0, 0.8) + 0.008 * self.fractal(1.0, 0.6, 0.1)
        mottled = 0.2 * self.fractal(2.4, 10.0, 0.5) + 0.22 * self.fractal(1.0, 0.6, 0.1)
        return _Patch(height, np.asarray(0.55 * np.exp(mottled), dtype=np.float32))

    def mud(self) -> _Patch:
        height = 0.04 * self.fractal(3.6, 22.0, 2.0)
        backscatter = 0.09 * np.exp(0.1 * self.fractal(3.2, 25.0, 1.0))
        pits = np.clip(self.fractal(2.0, 3.0, 0.5) - 2.9, 0, 0.8) * 0.12
        height = height - pits
        along = np.arange(self._shape[0], dtype=np.float32)[:, None] * self._cell_m
        across = np.arange(self._shape[1], dtype=np.float32)[None, :] * self._cell_m
        for _ in range(int(self._rng.integers(0, 3))):
            # Furrow of a trawl door or an anchor: a groove with spoil on one side.
            direction = self._rng.uniform(0, math.pi)
            through = (self._rng.uniform(0, self._shape[0]), self._rng.uniform(0, self._shape[1]))
            off = (along - through[0] * self._cell_m) * math.sin(direction)
            off = off - (across - through[1] * self._cell_m) * math.cos(direction)
            off = off + 0.25 * self.fractal(3.6, 30.0, 5.0)
            furrow = 0.05 * np.exp(-(((off - 0.5) / 0.2) ** 2)) - 0.07 * np.exp(-((off / 0.3) ** 2))
            height = height + np.asarray(furrow, dtype=np.float32)
        return _Patch(height, backscatter)

    def rock(self) -> _Patch:
        sand = self.sand()
        outcrop = self.fractal(3.2, 28.0, 0.7)
        ridged = 1 - np.abs(self.fractal(3.3, 7.0, 0.5))
        cover = 1 / (1 + np.exp(-6 * (outcrop - 0.15)))
        relief = np.clip(outcrop, 0, None) * 0.16 + 0.2 * ridged + 0.012 * self.fractal(2.4, 1.2, 0.15)
        strength = 0.5 * np.exp(0.25 * self.fractal(1.8, 4.0, 0.15))
        return _Patch(
            np.asarray(sand.height_m + cover * relief, dtype=np.float32),
            np.asarray(sand.backscatter * (1 - cover) + cover * strength, dtype=np.float32),
        )

    def mixed(self) -> _Patch:
        """Return sand with patches of three other types with irregular borders."""
        patches = [self.sand(), self.ripples(), self.mud() if self._rng.random() < 0.5 else self.gravel(), self.rock()]
        biases = [0.35, 0.25, 0.0, -0.35]
        scores = np.stack([bias + self.fractal(3.0, 45.0, 0.8) for bias in biases])
        weights = np.exp(9 * (scores - scores.max(axis=0)))
        weights /= weights.sum(axis=0)
        height = sum(w * p.height_m for w, p in zip(weights, patches, strict=True))
        backscatter = sum(w * p.backscatter for w, p in zip(weights, patches, strict=True))
        return _Patch(np.asarray(height, dtype=np.float32), np.asarray(backscatter, dtype=np.float32))

    def generate(self, kind: SeabedKind) -> _Patch:
        generators = {
            SeabedKind.SAND: self.sand,
            SeabedKind.RIPPLES: self.ripples,
            SeabedKind.GRAVEL: self.gravel,
            SeabedKind.MUD: self.mud,
            SeabedKind.ROCK: self.rock,
            SeabedKind.MIXED: self.mixed,
        }
        return generators[kind]()


def make_seabed(
    kind: SeabedKind,
    *,
    along_m: tuple[float, float],
    across_m: tuple[float, float],
    cell_m: float,
    rng: np.random.Generator,
    ripples: RippleOptions | None = None,
) -> Seabed:
    """Generate a seabed.

    Args:
        kind: Type; `MIXED` is sand with patches of other types.
        along_m: First and last along-track coordinate to cover.
        across_m: First and last across-track coordinate to cover, starboard positive.
        cell_m: Size of a cell.
        rng: Random generator; the same state gives the same seabed.
        ripples: Ripples of `RIPPLES` and of the patches of `MIXED`; None: the default options.

    Raises:
        ValueError: An empty strip, or one of more than 200 million cells.
    """
    if not cell_m > 0 or not along_m[1] > along_m[0] or not across_m[1] > across_m[0]:
        raise ValueError(f"strip: got {along_m} by {across_m} m in cells of {cell_m} m, expected a positive area")
    size = [math.ceil((high - low) / cell_m) + 1 for low, high in (along_m, across_m)]
    if size[0] * size[1] > 200_000_000:
        raise ValueError(f"strip: got {size[0]} x {size[1]} cells, expected at most 200 million (memory)")
    # Lengths with small prime factors make the Fourier transforms fast.
    rows, columns = (scipy.fft.next_fast_len(n, real=True) for n in size)
    patch = _TextureGenerator((rows, columns), cell_m, rng, ripples).generate(kind)
    # Relief is smooth below a few centimetres.
    height = gaussian_filter(patch.height_m, 0.02 / cell_m)
    return Seabed(
        height_m=np.ascontiguousarray(height[: size[0], : size[1]], dtype=np.float32),
        backscatter=np.ascontiguousarray(patch.backscatter[: size[0], : size[1]], dtype=np.float32),
        cell_m=cell_m,
        along_start_m=along_m[0],
        across_start_m=across_m[0],
    )
