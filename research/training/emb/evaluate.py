"""Measure codecs on the real snippets that nothing was trained on: real bytes, headers included.

    python -m research.training.emb.evaluate --data ../shared/data

Pictures: of each tile of the test split two windows of 120 x 120 px (around the target, or at random), at 80 x 80.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy.interpolate import PchipInterpolator

from research.common.measurement import create_codec
from research.common.quality import ms_ssim
from sonarpost.codec.quality import psnr_db, ssim
from sonarpost.errors import StreamError

BUDGETS = (22, 44, 64, 88, 128, 192, 256, 384, 512)
Curve = list[tuple[float, float]]


def snippets(root: Path) -> npt.NDArray[np.uint8]:
    """Shape (138, 80, 80)."""
    rng = np.random.default_rng(0)
    out = []
    with (root / "snippets/sdvd/index.csv").open() as file:
        entries = list(csv.DictReader(file))
    for split, windows in (("train", 6), ("test", 2)):  # the first split only moves the chance on
        for entry in (e for e in entries if e["split"] == split):
            picture = Image.open(root / f"snippets/sdvd/{split}/images/{entry['image']}").convert("L")
            for _ in range(windows):
                if int(entry["target_px"]):
                    x = (int(entry["x0"]) + int(entry["x1"])) // 2 + int(rng.integers(-12, 13))
                    y = (int(entry["y0"]) + int(entry["y1"])) // 2 + int(rng.integers(-12, 13))
                else:
                    x, y = (int(n) for n in rng.integers(60, 196, 2))
                x, y = min(max(x, 60), 196), min(max(y, 60), 196)
                if split == "test":
                    window = picture.crop((x - 60, y - 60, x + 60, y + 60))
                    out.append(np.asarray(window.resize((80, 80), Image.Resampling.LANCZOS)))
    return np.stack(out)


def rate_difference(curve: Curve, other: Curve) -> float:
    """Mean difference of log rate over the quality both reach, in per cent (Bjontegaard), piecewise cubic."""
    low = max(min(q for _, q in c) for c in (curve, other))
    high = min(max(q for _, q in c) for c in (curve, other))
    at = np.linspace(low, high, 500)
    first, second = (PchipInterpolator([q for _, q in c], np.log([r for r, _ in c]))(at) for c in (curve, other))
    return float(100 * np.expm1(np.mean(first - second)))


def main() -> None:
    """Print mean bytes, PSNR, SSIM and MS-SSIM of each codec and budget, and the rate differences."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--codecs", nargs="+", default=["emb", "spiht", "jpeg2000-packets", "jpeg2000"])
    args = parser.parse_args()
    pictures = snippets(args.data)
    curves: dict[str, Curve] = {}
    for name in args.codecs:
        codec, curves[name] = create_codec(name), []
        for budget in BUDGETS:
            try:
                streams = [codec.encode(p, budget) for p in pictures]
            except StreamError as error:
                print(f"{name} {budget} B: {error}")
                continue
            decoded = [codec.decode(s).image for s in streams]
            length = float(np.mean([len(s) for s in streams]))
            psnr = float(np.mean([psnr_db(p, d) for p, d in zip(pictures, decoded, strict=True)]))
            like = float(np.mean([ssim(p, d) for p, d in zip(pictures, decoded, strict=True)]))
            curves[name].append((length, psnr))
            multi = float(np.mean([ms_ssim(p, d) for p, d in zip(pictures, decoded, strict=True)]))
            print(f"{name} {budget} B: {length:.1f} B, {psnr:.2f} dB, SSIM {like:.3f}, MS-SSIM {multi:.3f}", flush=True)
    for name in args.codecs[1:]:
        if len(curves[name]) > 1:
            print(f"{args.codecs[0]} against {name}: {rate_difference(curves[args.codecs[0]], curves[name]):+.1f} %")


if __name__ == "__main__":
    main()
