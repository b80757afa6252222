"""Measure the time of a codec on the validation images of 80 x 140 px: processor time of one thread.

OMP_NUM_THREADS=1 python -m research.training.emb.timing --pool /tmp/emb/pool.npz
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from research.common.measurement import create_codec

BUDGETS = (64, 256, 512)


def main() -> None:
    """Print the mean milliseconds of encoding and decoding."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pool", type=Path, required=True)
    parser.add_argument("--pictures", type=int, default=6)
    parser.add_argument("--codec", default="emb")
    args = parser.parse_args()
    codec = create_codec(args.codec)
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


if __name__ == "__main__":
    main()
