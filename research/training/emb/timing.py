"""Measure the time of a codec on the validation images, 80 px wide and 140 px high: processor time of one thread.

OMP_NUM_THREADS=1 python -m research.training.emb.timing --pool /tmp/emb/pool.npz
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from research.common.command import command_parser, run_command
from research.common.measurement import create_codec

BUDGETS = (64, 256, 512)


def run(args: argparse.Namespace) -> int:
    """Print the mean milliseconds of encoding and decoding."""
    codec = create_codec(args.codec, strength=0.0)
    images = np.load(args.pool)["vp140"][: args.pictures]
    for budget in BUDGETS:
        codec.decode(codec.encode(images[0], budget))  # compiles
        started_s = time.process_time()
        streams = [codec.encode(image, budget) for image in images]
        encoded_s = time.process_time()
        for stream in streams:
            codec.decode(stream)
        times_ms = [1e3 * (b - a) / len(images) for a, b in ((started_s, encoded_s), (encoded_s, time.process_time()))]
        print(f"{budget} B: encode {times_ms[0]:.0f} ms, decode {times_ms[1]:.0f} ms")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    parser = command_parser("training.emb.timing", __doc__ or "")
    parser.add_argument("--pool", type=Path, required=True)
    parser.add_argument("--pictures", type=int, default=6)
    parser.add_argument("--codec", default="emb")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    sys.exit(main())
