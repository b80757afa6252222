"""Scenes without speckle, and examples of noisy and clean images made from them.

    python -m research.training.despeckle.scenes --data DIR --out /tmp/despeckle/scenes.npz

Scenes are crops of the mean echo intensity of simulated surveys, and recordings averaged over blocks. Each example gets
speckle with a random number of looks and random correlation, receiver noise, gain variation, quantisation, saturation
and a grey mapping; some get thin bright lines and points. Pairs of neighbouring pings of recordings are examples too:
their noise is independent, so one predicts the scene of the other (Lehtinen et al., "Noise2Noise", 2018).
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from research.common.command import command_parser, run_command
from research.training.emb.pool import survey_sheets
from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.seabed import survey as simulator
from sonarpost.extensions.simulation.seabed.targets import place_object
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind, make_seabed
from sonarpost.sonar.survey import Side

Floats = npt.NDArray[np.float32]
SEEDS: Final = range(100_000, 100_260)
"""Seeds of the simulated surveys. Tests and benchmarks use others."""
HEIGHT_PX, WIDTH_PX = 128, 176
CROP_PX: Final = 96
PATCH_PX: Final = 64
_RANDOM_CROPS: Final = 5
_MAX_ROW_CORRELATION: Final = 0.15


def simulated_scenes(seed: int) -> tuple[Floats, Floats]:
    """Return crops of a simulated survey.

    Returns:
        Mean echo intensity, shape (crops, HEIGHT_PX, WIDTH_PX), and noise by column, shape (crops, WIDTH_PX).
    """
    rng = np.random.default_rng(seed + 77)
    range_m = float(rng.choice([20, 30, 40, 50, 75]))
    kinds = list(SeabedKind)
    spec = simulator.SurveySpec(
        seed=seed,
        pings=520,
        samples=int(rng.choice([512, 768, 1024, 1400])),
        range_m=range_m,
        altitude_m=float(range_m * rng.uniform(0.08, 0.25)),
        ping_rate_hz=float(min(rng.choice([8.0, 12.0, 15.0, 25.0]), 740 / range_m)),
        seabed=kinds[seed % len(kinds)],
        targets=8,
        clutter=8,
        motion=float(rng.uniform(0, 1.5)),
    )
    parts = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4)]
    length_m, reach_m = spec.ping_spacing_m * (spec.pings - 1), spec.range_m + 2
    seabed = make_seabed(
        spec.seabed,
        along_m=(-2 - 0.05 * reach_m, length_m + 2 + 0.05 * reach_m),
        across_m=(-reach_m, reach_m),
        cell_m=min(max(spec.range_m / 600, 0.025), 0.15),
        rng=parts[0],
    )
    try:
        objects = simulator._random_objects(spec, length_m, parts[1])  # noqa: SLF001
    except ConfigError:  # a short track
        objects = simulator._random_objects(  # noqa: SLF001
            dataclasses.replace(spec, targets=2, clutter=2), length_m, parts[1]
        )
    grounds_m = [place_object(seabed, item) for item in objects]
    track, altitude_m = simulator._simulate_track(spec, seabed, parts[2])  # noqa: SLF001
    truth = [simulator._truth(spec, track, *pair) for pair in zip(objects, grounds_m, strict=True)]  # noqa: SLF001
    centres = (np.arange(spec.samples) + 0.5) / spec.samples
    noise = simulator._NOISE * (0.004 + 0.03 * centres + centres**4)  # noqa: SLF001
    crops, floors = [], []
    for side, sign in ((Side.PORT, -1), (Side.STARBOARD, 1)):
        image = simulator.echo_intensity(seabed, track, spec, sign)
        image = image + 0.0004 * (centres * spec.range_m < altitude_m[:, None])
        places = [
            (
                item.ping - HEIGHT_PX // 2 + int(rng.integers(-30, 31)),
                item.sample_index - WIDTH_PX // 2 + int(rng.integers(-40, 41)),
            )
            for item in truth
            if item.side == side
        ]
        limits = spec.pings - HEIGHT_PX, spec.samples - WIDTH_PX
        places += [(int(rng.integers(limits[0])), int(rng.integers(limits[1]))) for _ in range(_RANDOM_CROPS)]
        for y, x in places:
            row, column = int(np.clip(y, 0, limits[0])), int(np.clip(x, 0, limits[1]))
            crops.append(image[row : row + HEIGHT_PX, column : column + WIDTH_PX].astype(np.float32))
            floors.append(noise[column : column + WIDTH_PX].astype(np.float32))
    return np.stack(crops), np.stack(floors)


def recorded_sheets(root: Path) -> list[Floats]:
    """Return the first four fifths of each recording and five of six tiles, in file values."""
    sheets = []
    for sheet, _ in survey_sheets(root):
        sheets.append(np.nan_to_num(sheet[: sheet.shape[0] * 4 // 5 - 8]).astype(np.float32))
    for i, path in enumerate(sorted(root.glob("texture/sassed/*.png"))):
        if i % 6 != 5:
            sheets.append(np.asarray(Image.open(path).convert("L"), np.float32))
    return sheets


def averaged(sheet: Floats, block: int) -> Floats:
    """Return the mean power over blocks, relative to its median: nearly free of speckle, at a coarser scale."""
    rows, columns = sheet.shape[0] // block, sheet.shape[1] // block
    power = sheet[: rows * block, : columns * block] ** 2
    mean = power.reshape(rows, block, columns, block).mean((1, 3))
    return np.asarray(mean / np.median(mean), np.float32)


def row_correlation(sheet: Floats) -> float:
    """Return the correlation between the noise of neighbouring pings."""
    root = np.sqrt(np.maximum(sheet, 0))
    noise = root - gaussian_filter(root, 2)
    return float((noise[1:] * noise[:-1]).mean() / (noise * noise).mean())


class Examples:
    """Draws examples.

    Args:
        path: File that this module writes.
        seed: Seed of every random draw.
    """

    def __init__(self, path: Path, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        with np.load(path) as file:
            self._scenes, self._floors = file["scene"], file["floor"]
            sheets = [file[name] for name in file.files if name.startswith("sheet")]
        self._averaged = [averaged(sheet, 4 if max(sheet.shape) > 600 else 3) for sheet in sheets]
        self._sheets = [sheet for sheet in sheets if row_correlation(sheet) < _MAX_ROW_CORRELATION]

    def draw(self) -> tuple[Floats, Floats, float]:
        """Return a noisy and a clean image, shape (PATCH_PX, PATCH_PX), 0..1, and the weight of the example."""
        rng = self._rng
        kind = rng.random()
        if kind < 0.07 and self._sheets:
            return (*self._neighbours(), 0.3)
        power, floor = self._scene((CROP_PX, CROP_PX), simulated=kind < 0.86)
        # Below 0.55: the noise of the simulator; otherwise random noise.
        noisy, clean = self._observed(power, floor, product=bool(kind < 0.55))
        y, x = (int(rng.integers(0, side - PATCH_PX + 1)) for side in noisy.shape)
        noisy, clean = (a[y : y + PATCH_PX, x : x + PATCH_PX] for a in (noisy, clean))
        for axis in (0, 1):
            if rng.random() < 0.5:
                noisy, clean = np.flip(noisy, axis), np.flip(clean, axis)
        if rng.random() < 0.2:
            noisy, clean = noisy.T, clean.T
        return noisy, clean, 1.0

    def _observed(self, power: Floats, floor: Floats, *, product: bool) -> tuple[Floats, Floats]:
        """Return noisy and clean grey images of a scene, 0..1."""
        rng = self._rng
        if not product:
            floor = floor * rng.choice([0, 1, 1, 4, 15])
        if rng.random() < 0.3:
            add_points(power, rng)
        if rng.random() < 0.3:
            power = with_lines(power, rng)
        gain = gaussian_filter1d(rng.standard_normal(len(power)), 8.0) * 0.3 + 0.015 * rng.standard_normal(len(power))
        power = power * np.exp(gain)[:, None].astype(np.float32)
        noise = floor * rng.standard_exponential(power.shape, dtype=np.float32)
        noisy = np.sqrt(power * speckle(power.shape, rng, product=product) + noise)
        return to_grey(noisy, np.sqrt(power + 0.8 * floor), rng, product=product)

    def _scene(self, shape: tuple[int, int], *, simulated: bool) -> tuple[Floats, Floats]:
        """Return the mean intensity and the noise by column of a scene; a recording may be smaller than `shape`."""
        rng, (height, width) = self._rng, shape
        if simulated or not self._averaged:
            i = int(rng.integers(len(self._scenes)))
            y, x = int(rng.integers(0, HEIGHT_PX - height + 1)), int(rng.integers(0, WIDTH_PX - width + 1))
            return self._scenes[i, y : y + height, x : x + width].copy(), self._floors[i, x : x + width]
        sheet = self._averaged[int(rng.integers(len(self._averaged)))]
        height, width = min(height, sheet.shape[0]), min(width, sheet.shape[1])
        y, x = int(rng.integers(0, sheet.shape[0] - height + 1)), int(rng.integers(0, sheet.shape[1] - width + 1))
        return sheet[y : y + height, x : x + width].copy(), np.full(width, rng.choice([0, 0.003, 0.02]), np.float32)

    def _neighbours(self) -> tuple[Floats, Floats]:
        """Return alternate pings of a recording: the odd ones and the even ones."""
        rng = self._rng
        sheet = self._sheets[int(rng.integers(len(self._sheets)))]
        y = int(rng.integers(0, sheet.shape[0] - 2 * PATCH_PX))
        x = int(rng.integers(0, sheet.shape[1] - PATCH_PX))
        crop = sheet[y : y + 2 * PATCH_PX, x : x + PATCH_PX]
        if rng.random() < 0.5:
            crop = np.sqrt(crop)
        low, high = np.percentile(crop, (0.5, 99.5))
        crop = np.asarray(np.clip((crop - low) / max(high - low, 1e-6), 0, 1), np.float32)
        first = int(rng.integers(2))
        return np.asarray(np.rint(crop[first::2] * 255) / 255, np.float32), crop[1 - first :: 2]


def speckle(shape: tuple[int, ...], rng: np.random.Generator, *, product: bool) -> Floats:
    """Return speckle in power, mean 1: that of the simulator, or with random looks and correlation."""
    fields, across, along = 4, 0.75, 0.0
    if not product:
        fields = int(rng.choice([2, 3, 4, 4, 6, 8, 12]))
        across, along = float(rng.uniform(0, 1.1)), float(rng.choice([0, 0, rng.uniform(0, 0.8)]))
    noise = rng.standard_normal((fields, *shape), dtype=np.float32)
    for axis, sigma in ((2, across), (1, along)):
        if sigma > 0.2:
            noise = gaussian_filter1d(noise, sigma, axis=axis, mode="wrap")
    total = (noise * noise).sum(0)
    return np.asarray(total / total.mean(), np.float32)


def with_lines(power: Floats, rng: np.random.Generator) -> Floats:
    """Return the scene with one or two thin bright lines, as of cables, some with a shadow beside them."""
    y, x = np.mgrid[0 : power.shape[0], 0 : power.shape[1]].astype(np.float32)
    for _ in range(int(rng.integers(1, 3))):
        angle = rng.uniform(0, np.pi)
        dy, dx = y - rng.uniform(0, power.shape[0]), x - rng.uniform(0, power.shape[1])
        along = dx * np.cos(angle) + dy * np.sin(angle)
        wave = rng.uniform(0, 1.5) * np.sin(along / rng.uniform(6, 20) + rng.uniform(0, 6))
        off = dy * np.cos(angle) - dx * np.sin(angle) - 0.004 * rng.normal() * along**2 - wave
        inside = np.abs(along) < rng.uniform(8, 80)
        level = rng.uniform(0.5, 8) * np.median(power)
        power = power + level * np.exp(-((off / rng.uniform(0.5, 1.2)) ** 2)) * inside
        if rng.random() < 0.4:
            power = power * (1 - 0.8 * np.exp(-((off - 2.2) ** 2)) * inside)
    return power.astype(np.float32)


def add_points(power: Floats, rng: np.random.Generator) -> None:
    """Add one to four small bright echoes, most with a short shadow."""
    height, width = power.shape
    for _ in range(int(rng.integers(1, 5))):
        y, x = int(rng.integers(0, height)), int(rng.integers(0, width))
        length, rows = int(rng.integers(0, 14)), int(rng.integers(1, 4))
        if length and rng.random() < 0.7:
            power[max(y - rows // 2, 0) : y + rows - rows // 2, x + 1 : x + 1 + length] *= rng.uniform(0.02, 0.3)
        down, across = rng.uniform(0.5, 1.3, 2)
        rows_near = np.arange(max(y - 4, 0), min(y + 5, height))
        columns_near = np.arange(max(x - 4, 0), min(x + 5, width))
        shape = np.exp(-(((rows_near[:, None] - y) / down) ** 2) / 2 - ((columns_near - x) / across) ** 2 / 2)
        power[np.ix_(rows_near, columns_near)] += rng.uniform(2, 30) * np.median(power) * shape


def to_grey(noisy: Floats, clean: Floats, rng: np.random.Generator, *, product: bool) -> tuple[Floats, Floats]:
    """Map amplitudes to grey 0..1 as recorders and snippets do; the noisy image is rounded to 8 bits."""
    if rng.random() < 0.5:
        full = 255 if rng.random() < 0.5 else 32767
        level = 0.26 * full * (1 if product else rng.uniform(0.6, 1.6))
        noisy, clean = np.clip(np.rint(noisy * level), 0, full) / level, np.minimum(clean, full / level)
    if rng.random() < 0.5:
        noisy, clean = np.sqrt(noisy), np.sqrt(clean)
    low, high = np.percentile(noisy, (0.5, 99.5 if product else rng.uniform(98.5, 99.9)))
    if rng.random() < 0.4:
        low = 0
    noisy, clean = (np.asarray(np.clip((a - low) / max(high - low, 1e-6), 0, 1), np.float32) for a in (noisy, clean))
    return np.asarray(np.rint(noisy * 255) / 255, np.float32), clean


def run(args: argparse.Namespace) -> int:
    """Read the recordings, simulate, write the file."""
    sheets = {f"sheet{i}": sheet for i, sheet in enumerate(recorded_sheets(args.data))}
    crops, floors = zip(*(simulated_scenes(seed) for seed in SEEDS), strict=True)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez(args.out, allow_pickle=False, scene=np.concatenate(crops), floor=np.concatenate(floors), **sheets)
    print(f"{sum(len(c) for c in crops)} scenes, {len(sheets)} recordings")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = command_parser("training.despeckle.scenes", __doc__ or "")
    parser.add_argument("--data", type=Path, required=True, help="folder of the recordings (research/README.md)")
    parser.add_argument("--out", type=Path, required=True)
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    sys.exit(main())
