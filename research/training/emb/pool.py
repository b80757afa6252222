"""Create the training and validation images.

    python -m research.training.emb.pool --data DIR --out /tmp/emb/pool.npz

Sources are surveys (file values, and the same mapped to grey like a snippet), synthetic-aperture tiles and simulations.
Highlights with shadows are added to half of the images. Validation images come from separate parts of the same sources:
the last fifth of every recording, every sixth tile, other seeds of the simulator.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from research.common.command import command_parser, run_command
from research.common.images import missing_data
from sonarpost.detection.snippets import to_grey
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.readers import read_survey

Floats = npt.NDArray[np.float64]
SEED = 20240611
SCALES = (1.0, 1.5, 0.67, 0.5, 0.33)
SIZES_PX = {"p80": (80, 80), "p140": (140, 80), "p112": (112, 96)}
TRAIN_COUNTS = {"p80": 5000, "p140": 1600, "p112": 1600}
VALIDATION_COUNTS = {"p80": 150, "p140": 40, "p112": 0}


def survey_sheets(root: Path) -> list[tuple[Floats, str]]:
    """Return the waterfalls of the recordings, one a side, in file values, with the name of the recording."""
    sheets = []
    for path in sorted(root.glob("surveys/*.xtf")):
        survey = read_survey(path)
        sheets += [(np.asarray(survey.waterfall(side), np.float64), path.stem) for side in survey.sides()]
    for path in sorted(root.glob("surveys/derived/pyhum*.png")):
        sheets.append((np.asarray(Image.open(path), np.float64), path.stem))
    if not sheets:
        raise missing_data(root / "surveys", "no recording")
    return sheets


def simulated_sheets(seeds: range) -> list[Floats]:
    """Return the waterfalls of simulated surveys over every kind of seabed."""
    kinds = list(SeabedKind)
    sheets = []
    for seed in seeds:
        spec = SurveySpec(
            seed=seed, pings=500, samples=768, range_m=25.0, seabed=kinds[seed % len(kinds)], targets=10, clutter=10
        )
        survey = simulate_survey(spec).survey
        sheets += [np.asarray(survey.waterfall(side), np.float64) for side in survey.sides()]
    return sheets


def stretched(sheet: Floats) -> Floats:
    """Map a sheet to 0..255: percentiles 1 and 99.5, power 0.6."""
    low, high = np.nanpercentile(sheet, (1, 99.5))
    return np.asarray(np.clip((np.nan_to_num(sheet) - low) / max(high - low, 1e-9), 0, 1) ** 0.6 * 255)


def sheets_of(root: Path, *, validation: bool) -> list[tuple[Floats, bool]]:
    """Return all sheets, and whether their windows are mapped to grey separately."""
    sheets: list[tuple[Floats, bool]] = []
    for sheet, _ in survey_sheets(root):
        rows = sheet.shape[0] * 4 // 5
        part = sheet[rows:] if validation else sheet[: rows - 8]
        sheets += [(stretched(part), False), (np.nan_to_num(part), True)]
    for i, path in enumerate(sorted(root.glob("texture/sassed/*.png"))):
        if (i % 6 == 5) == validation:
            sheets.append((np.asarray(Image.open(path).convert("L"), np.float64), False))
    for sheet in simulated_sheets(range(100, 103) if validation else range(12)):
        sheets += [(stretched(sheet), False), (sheet, True)]
    resized = [(_resized(s, f), grey) for s, grey in sheets for f in SCALES[1:] if min(s.shape) * f >= 90]
    return sheets + resized


def _resized(sheet: Floats, factor: float) -> Floats:
    height, width = (int(n * factor) for n in sheet.shape)
    return np.asarray(
        Image.fromarray(sheet.astype(np.float32)).resize((width, height), Image.Resampling.LANCZOS), np.float64
    ).clip(0)


def cut(sheets: list[tuple[Floats, bool]], size: tuple[int, int], count: int, rng: np.random.Generator) -> Floats:
    """Cut windows at random places, rotated, mirrored, with random contrast, brightness and noise."""
    height, width = size
    usable = [s for s in sheets if s[0].shape[0] >= height and s[0].shape[1] >= width]
    weight = np.array([s.size for s, _ in usable]) ** 0.5
    out = np.empty((count, height, width))
    done = 0
    while done < count:
        sheet, by_window = usable[rng.choice(len(usable), p=weight / weight.sum())]
        if rng.random() < 0.4 and sheet.shape[0] >= width and sheet.shape[1] >= height:
            sheet = sheet.T
        y = int(rng.integers(sheet.shape[0] - height + 1))
        x = int(rng.integers(sheet.shape[1] - width + 1))
        window = sheet[y : y + height, x : x + width]
        if by_window:
            window = to_grey(np.rint(window).astype(np.uint32), np.ones(size, np.bool_)).astype(np.float64)
        if window.std() < 4 and rng.random() < 0.9:
            continue
        if rng.random() < 0.5:
            window = window[:, ::-1]
        if rng.random() < 0.5:
            window = window[::-1]
        shaped = 255 * (window / 255).clip(0, 1) ** np.exp(rng.normal(0, 0.3)) * np.exp(rng.normal(0, 0.25))
        out[done] = np.clip(shaped + rng.normal(0, 4 * rng.random()), 0, 255)
        done += 1
    return out


def paint_objects(images: Floats, rng: np.random.Generator, share: float = 0.5) -> None:
    """Add highlights with shadows to a share of the images, by multiplication."""
    _, height, width = images.shape
    yy, xx = np.mgrid[:height, :width].astype(np.float64)
    for i in range(len(images)):
        if rng.random() > share:
            continue
        images[i] *= rng.uniform(45, 110) / max(images[i].mean(), 1)
        for _ in range(rng.integers(1, 3)):
            row, column = rng.uniform(0.15, 0.85) * height, rng.uniform(0.15, 0.85) * width
            turn, long, wide = rng.uniform(0, np.pi), rng.uniform(2, 20), rng.uniform(1.5, 8)
            away = rng.choice((-1, 1)) * (rng.uniform(3, 16) + min(long, 8))
            boxy = bool(rng.random() < 0.5)
            shadow = _blob(
                yy - row - rng.uniform(-4, 4), xx - column - away, turn, long * rng.uniform(0.8, 2), wide, boxy
            )
            light = _blob(yy - row, xx - column, turn + rng.normal(0, 0.2), long, wide, boxy)
            if rng.random() < 0.85:
                images[i] *= 1 - shadow * rng.uniform(0.5, 0.95)
            if rng.random() < 0.9:
                images[i] *= 1 + light * rng.uniform(0.2, 4)
    np.clip(images, 0, 255, out=images)


def _blob(dy: Floats, dx: Floats, turn: float, long: float, wide: float, boxy: bool) -> Floats:  # noqa: FBT001
    u = (dx * np.cos(turn) + dy * np.sin(turn)) / long
    v = (dy * np.cos(turn) - dx * np.sin(turn)) / wide
    reach = np.maximum(abs(u), abs(v)) ** 4 if boxy else u * u + v * v
    return np.asarray(1 / (1 + np.exp(np.clip(5 * (reach - 1), -30, 30))))


def run(args: argparse.Namespace) -> int:
    """Write the pool."""
    out = {}
    for validation, counts in ((False, TRAIN_COUNTS), (True, VALIDATION_COUNTS)):
        rng = np.random.default_rng(SEED + validation)
        sheets = sheets_of(args.data, validation=validation)
        for name, size in SIZES_PX.items():
            if counts[name]:
                images = cut(sheets, size, counts[name], rng)
                paint_objects(images, rng)
                out[("v" if validation else "t") + name] = np.rint(images).astype(np.uint8)
    np.savez(args.out, allow_pickle=False, **out)
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    parser = command_parser("training.emb.pool", __doc__ or "")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    sys.exit(main())
