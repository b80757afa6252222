"""`python -m research.codebook.build_time`: time and memory to build a codebook of 16,000 tiles on one core.

    python -m research.codebook.build_time [--tile 10] [--refine 2]

500 images of 100 to 200 px a side are cut from simulated survey lines over every kind of seabed and written as TIFF.
`python -m research.codebook build` runs in its own process, bound to one core and one thread; its time, processor time
and peak resident memory are printed. The simulation is not included.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from research.common.patches import stretch
from sonarpost.codec.vq.codebook import load
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.image_files import write_tiff

LIMIT_S = 300.0
IMAGES_PER_SIDE = 25


def main() -> int:
    """Run; return 1 if the build takes five minutes or more, or the codebook is not full."""
    parser = argparse.ArgumentParser(description="time and memory of a codebook build")
    parser.add_argument("--images", type=int, default=500, metavar="N", help="default: 500")
    parser.add_argument("--max-tiles", type=int, default=16_000, metavar="N", help="default: 16000")
    parser.add_argument("--tile", type=int, default=10, metavar="PX", help="default: 10")
    parser.add_argument("--rounds", default="39:80,39:64,100:40,100:6", help="default: %(default)s")
    parser.add_argument("--refine", type=int, default=0, metavar="N", help="passes of refinement (default: 0)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print(f"{args.images} images ...", file=sys.stderr)
        pixels = _write_images(folder, args.images)
        out = folder / "out.tiles"
        arguments = ["build", "--images", str(folder), "--out", str(out), "--rounds", args.rounds]
        arguments += ["--tile", str(args.tile), "--max-tiles", str(args.max_tiles), "--refine", str(args.refine)]
        seconds, cpu_seconds, peak_mib = _run(arguments)
        tiles = load(out).tiles
    result = {
        "images": args.images,
        "megapixels": round(pixels / 1e6, 2),
        "tile_px": args.tile,
        "rounds": args.rounds,
        "refine_passes": args.refine,
        "tiles": len(tiles),
        "seconds": round(seconds, 1),
        "cpu_seconds": round(cpu_seconds, 1),
        "peak_memory_mib": round(peak_mib),
    }
    print(json.dumps(result))
    return 0 if seconds < LIMIT_S and len(tiles) >= 0.99 * args.max_tiles else 1


def _write_images(folder: Path, count: int) -> int:
    """Write the images; return their total number of pixels."""
    rng = np.random.default_rng(0)
    kinds = list(SeabedKind)
    pixels = 0
    for number in range(count):
        if number % IMAGES_PER_SIDE == 0:
            line = number // IMAGES_PER_SIDE
            spec = SurveySpec(seed=920_000 + line // 2, seabed=kinds[line // 2 % len(kinds)], targets=8, clutter=8)
            survey = simulate_survey(spec).survey
            waterfall = survey.waterfall(survey.sides()[line % 2])
        height, width = rng.integers(100, 201, 2).tolist()
        top = int(rng.integers(0, waterfall.shape[0] - height + 1))
        left = int(rng.integers(waterfall.shape[1] // 5, waterfall.shape[1] - width + 1))
        image = stretch(waterfall[top : top + height, left : left + width].astype(np.float64))
        write_tiff(folder / f"image-{number:04}.tiff", image)
        pixels += image.size
    return pixels


def _run(arguments: list[str]) -> tuple[float, float, float]:
    """Run the command on one core; return elapsed and processor time in seconds, and peak resident memory in MiB."""
    environment = os.environ | {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}
    start = time.perf_counter()
    child = subprocess.Popen([sys.executable, "-m", "research.codebook", *arguments], env=environment)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(child.pid, {max(os.sched_getaffinity(0))})
    _, status, usage = os.wait4(child.pid, 0)
    seconds = time.perf_counter() - start
    if status != 0:
        sys.exit(f"build_time: the build exited with status {os.waitstatus_to_exitcode(status)}")
    peak_mib = usage.ru_maxrss / (1024 if sys.platform != "darwin" else 1 << 20)
    return seconds, usage.ru_utime + usage.ru_stime, peak_mib


if __name__ == "__main__":
    sys.exit(main())
