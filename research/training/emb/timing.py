"""Measure the time to encode and decode simulated snippets of 80 x 140 px with emb: processor time of one thread.

OMP_NUM_THREADS=1 python -m research.training.emb.timing

Prints medians over the snippets. The time of a snippet is the least of three runs.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from research.common.command import command_parser, run_command
from research.common.measurement import create_codec
from research.common.speckle import speckle_pairs

BUDGETS = (64, 128, 256, 512)
STRENGTHS = (0.0, 1.0)
_RUNS = 3


def run(args: argparse.Namespace) -> int:
    """Print the milliseconds of encoding and decoding."""
    images = [pair.noisy for pair in speckle_pairs(args.count)]
    for strength in STRENGTHS:
        codec = create_codec(args.codec, strength=strength)
        for budget in BUDGETS:
            streams = [codec.encode(image, budget) for image in images]  # compiles
            encode_ms = _median_ms([partial(codec.encode, image, budget) for image in images])
            decode_ms = _median_ms([partial(codec.decode, stream) for stream in streams])
            print(f"strength {strength:g}, {budget} B: encode {encode_ms:.0f} ms, decode {decode_ms:.0f} ms")
    return 0


def _median_ms(calls: Sequence[Callable[[], object]]) -> float:
    """Return the median of the times of the calls. All in turn: the codec keeps the estimate of the last image."""
    rounds = [[_time_ms(call) for call in calls] for _ in range(_RUNS)]
    return float(np.median(np.min(rounds, axis=0)))


def _time_ms(call: Callable[[], object]) -> float:
    started_s = time.process_time()
    call()
    return 1e3 * (time.process_time() - started_s)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    parser = command_parser("training.emb.timing", __doc__ or "")
    parser.add_argument("--count", type=int, default=12, help="snippets, at least 2 (default: %(default)s)")
    parser.add_argument("--codec", default="emb", help="emb or emb:structure (default: %(default)s)")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    sys.exit(main())
