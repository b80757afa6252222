"""Time the codec on the validation pictures of 140 x 80 px, the processor's own time of one thread.

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
    pictures = np.load(args.pool)["vp140"][: args.pictures]
    for budget in BUDGETS:
        codec.decode(codec.encode(pictures[0], budget))  # compiles
        began = time.process_time()
        streams = [codec.encode(picture, budget) for picture in pictures]
        between = time.process_time()
        for stream in streams:
            codec.decode(stream)
        spent_ms = [1e3 * (b - a) / len(pictures) for a, b in ((began, between), (between, time.process_time()))]
        print(f"{budget} B: encode {spent_ms[0]:.0f} ms, decode {spent_ms[1]:.0f} ms")


if __name__ == "__main__":
    main()
