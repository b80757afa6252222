"""Measure codecs on the crops of the SDVD test split, which are not used for training.

    python -m research.training.emb.evaluate --data DIR

The figures are those of `python -m research.codecs --sdvd`, without misses and intervals.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from research.common.command import command_parser, run_command
from research.common.images import sdvd_crops
from research.common.measurement import create_codec
from research.common.quality import ms_ssim, psnr_db, ssim
from research.common.statistics import bd_rate_percent
from sonarpost.errors import StreamError

BUDGETS = (22, 44, 64, 88, 128, 192, 256, 384, 512)


def run(args: argparse.Namespace) -> int:
    """Print mean bytes, PSNR, SSIM and MS-SSIM of each codec and budget, and the rate differences."""
    images = [image.pixels for image in sdvd_crops(args.data / "snippets" / "sdvd").images]
    curves: dict[str, list[tuple[float, float]]] = {}
    for name in args.codecs:
        codec, curves[name] = create_codec(name, strength=0.0), []
        for budget in BUDGETS:
            try:
                streams = [codec.encode(image, budget) for image in images]
            except StreamError as error:
                print(f"{name} {budget} B: {error}")
                continue
            pairs = [(image, codec.decode(stream).image) for image, stream in zip(images, streams, strict=True)]
            length = float(np.mean([len(stream) for stream in streams]))
            psnr, similarity, multi_scale = (
                float(np.mean([metric(*pair) for pair in pairs])) for metric in (psnr_db, ssim, ms_ssim)
            )
            curves[name].append((length, psnr))
            figures = f"{psnr:.2f} dB, SSIM {similarity:.3f}, MS-SSIM {multi_scale:.3f}"
            print(f"{name} {budget} B: {length:.1f} B, {figures}", flush=True)
    first = args.codecs[0]
    for name in args.codecs[1:]:
        rates, quality = np.array(curves[first]).T
        other_rates, other_quality = np.array(curves[name]).reshape(-1, 2).T
        difference = bd_rate_percent(rates, quality, other_rates, other_quality)
        if difference is not None:
            print(f"{first} against {name}: {difference:+.1f} %")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    parser = command_parser("training.emb.evaluate", __doc__ or "")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--codecs", nargs="+", default=["emb", "spiht", "jpeg2000-packets", "jpeg2000"])
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    sys.exit(main())
