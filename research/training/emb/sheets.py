"""Draw the contact sheets of docs/explanation/codecs.md: originals above, decoded below.

    python -m research.training.emb.sheets --data DIR --out docs/explanation/codecs 22 64 192
    python -m research.training.emb.sheets --data DIR --out docs/explanation/codecs \
        --codecs emb emb:structure -- 64

The images may be published: they are from the public-domain Humminbird recording (its last fifth) and the simulator.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from research.common.command import command_parser, run_command
from research.common.images import missing_data
from research.common.measurement import create_codec
from research.training.emb.pool import cut, simulated_sheets, survey_sheets

SIDE_PX, GAP_PX, COLUMNS, SEED = 80, 4, 6, 4


def run(args: argparse.Namespace) -> int:
    """Write a sheet for each budget, named after the last codec."""
    rng, pitch, rows = np.random.default_rng(SEED), SIDE_PX + GAP_PX, 1 + len(args.codecs)
    codecs = [create_codec(name, strength=0.0) for name in args.codecs]
    real = [np.nan_to_num(s) for s, group in survey_sheets(args.data) if group.startswith("pyhum")]
    if not real:
        raise missing_data(args.data / "surveys" / "derived", "no pyhum*.png")
    sources = ([s[s.shape[0] * 4 // 5 :] for s in real], simulated_sheets(range(100, 103)))
    images = [cut([(s, True) for s in sheets], (SIDE_PX, SIDE_PX), COLUMNS, rng) for sheets in sources]
    for budget in args.budgets:
        sheet = np.full((2 * rows * pitch + GAP_PX, COLUMNS * pitch + GAP_PX), 255, np.uint8)
        for i, image in enumerate(np.rint(np.concatenate(images)).astype(np.uint8)):
            y, x = GAP_PX + i // COLUMNS * rows * pitch, GAP_PX + i % COLUMNS * pitch
            for cell in (image, *(codec.decode(codec.encode(image, budget)).image for codec in codecs)):
                sheet[y : y + SIDE_PX, x : x + SIDE_PX] = cell
                y += pitch
        enlarged = Image.fromarray(sheet).resize((2 * sheet.shape[1], 2 * sheet.shape[0]), Image.Resampling.NEAREST)
        enlarged.save(args.out / f"{args.codecs[-1]}-{budget}.png", optimize=True)
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    parser = command_parser("training.emb.sheets", __doc__ or "")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--codecs", nargs="+", default=["emb"], help="one row of images each")
    parser.add_argument("budgets", type=int, nargs="+")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    sys.exit(main())
