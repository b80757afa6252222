"""`python -m research.codebook.adaptation_gain [--data DIR]`: gain of adapting the shipped codebooks to real seabeds.

Three sets of real images are cut into windows of 80 x 140 px without overlap: a Marine Sonic survey line of 2013, a
survey line of a river bed of 2009, and synthetic-aperture tiles. Both sides of a line are cut at the same pings, so the
held-out last quarter is the end of the line on both sides. Both codebooks are adapted to each set. Times are processor
time, which does not depend on the load of the machine.
"""

import argparse
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from research.codebook.adaptation import CodebookQuality, adapt, measure, split_images
from research.codebook.builder import TrainingImage
from research.common.images import missing_data
from research.common.patches import stretch
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.codec.vq.codebook import DEFAULT_TILE_PX, load_default
from sonarpost.sonar.image_files import read_image

HEIGHT_PX, WIDTH_PX = 140, 80
SETS = {
    "Marine Sonic 600 kHz, sand and a wreck": "surveys/derived/scotsman-iver2.xtf.*.png",
    "river bed, 2009": "surveys/derived/000_1236.xtf.*.png",
    "synthetic aperture, ripples and rock": "texture/sassed/*.png",
}


def main() -> int:
    """Run; return 1 if an adapted codebook is no better than its base on the held-out images."""
    parser = argparse.ArgumentParser(description="gain of adapted codebooks on real images")
    folder = os.environ.get("SONARPOST_DATA")
    parser.add_argument(
        "--data",
        type=Path,
        default=folder,
        required=folder is None,
        metavar="DIR",
        help="folder of recordings, see research/README.md#data (default: the environment variable SONARPOST_DATA)",
    )
    args = parser.parse_args()
    if os.environ.get("OMP_NUM_THREADS") != "1":
        # The libraries read this when they are loaded, so the program restarts itself.
        os.environ.update({f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")})
        os.execv(sys.executable, [sys.executable, "-m", "research.codebook.adaptation_gain", *sys.argv[1:]])
    for pattern in SETS.values():
        if not any(args.data.glob(pattern)):
            print(f"adaptation_gain: {missing_data(args.data, f'no {pattern}')}", file=sys.stderr)
            return 2
    print("| images | base | PSNR before / after | FOM before / after | better in | time, one core |")
    print("|---|---|---|---|---|---|")
    improved = True
    for title, pattern in SETS.items():
        images = list(_windows(sorted(args.data.glob(pattern))))
        for tile_px in DEFAULT_TILE_PX:
            improved &= _row(title, images, tile_px)
    return 0 if improved else 1


def _windows(paths: list[Path]) -> Iterator[TrainingImage]:
    """Cut images from top to bottom: both sides of a line together, other images one after the other."""
    views = [(path.name, read_image(path).astype(np.float64)) for path in paths]
    is_line = any("xtf" in path.name for path in paths)
    for group in [views] if is_line else [[view] for view in views]:
        for top in range(0, max(view.shape[0] for _, view in group) - HEIGHT_PX + 1, HEIGHT_PX):
            for name, view in group:
                for left in range(0, view.shape[1] - WIDTH_PX + 1, WIDTH_PX):
                    window = view[top : top + HEIGHT_PX, left : left + WIDTH_PX]
                    if window.shape[0] == HEIGHT_PX and window.min() < window.max():
                        yield _image(f"{name} {top} {left}", stretch(window))


def _image(name: str, pixels: npt.NDArray[np.uint8]) -> TrainingImage:
    return TrainingImage(name, lambda: pixels)


def _row(title: str, images: list[TrainingImage], tile_px: int) -> bool:
    base = load_default(tile_px).tiles
    training, held_out = split_images(images)
    start_s = time.process_time()
    adapted = adapt(base, training)
    duration_s = time.process_time() - start_s
    before, after = measure(base, held_out), measure(adapted.tiles, held_out)
    (psnr, fom), (new_psnr, new_fom) = _means(before), _means(after)
    better = sum(new.psnr_db > old.psnr_db for old, new in zip(before, after, strict=True))
    print(
        f"| {title}: {len(training)} + {len(held_out)} | nominal-{tile_px} | {psnr:.2f} / {new_psnr:.2f} dB "
        f"| {fom:.1f} / {new_fom:.1f} | {better} of {len(held_out)} | {duration_s:.0f} s |",
        flush=True,
    )
    return new_psnr > psnr


def _means(measured: list[CodebookQuality]) -> tuple[float, float]:
    return float(np.mean([q.psnr_db for q in measured])), float(np.mean([q.fom for q in measured]))


if __name__ == "__main__":
    with ProgressDisplay(step="adaptation_gain"):
        sys.exit(main())
