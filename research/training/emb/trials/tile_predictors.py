"""Trial: tiles of the codebooks as predictors.

    python -m research.training.emb.trials.tile_predictors --data DIR

Three uses, each with the best of all tiles for each place, at the bytes that remain of the budget:

- before: the best tile of each of some blocks is subtracted, the coder codes the difference;
- after: a tile, times a factor, is added to blocks of the decoded image;
- nearest: as after, with one of the 16 tiles nearest to the decoded block, which the decoder knows: shorter indices.

A tile costs its index, the block's number, and two bits for the factor; the factor itself is not rounded.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from research.common.command import command_parser, run_command
from research.common.images import sdvd_crops
from research.common.quality import psnr_db
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.interface import Image
from sonarpost.codec.vq.codebook import open_codebook

Floats = npt.NDArray[np.float32]
COUNTS: Final = (1, 4)
NEAREST: Final = 16
_FACTOR_BITS: Final = 2


def to_blocks(image: npt.NDArray[np.generic], side: int) -> Floats:
    """Return square blocks as rows, shape (blocks, side * side). The sides of the image are multiples of `side`."""
    rows, columns = image.shape[0] // side, image.shape[1] // side
    cut = image.astype(np.float32).reshape(rows, side, columns, side).transpose(0, 2, 1, 3)
    return cut.reshape(rows * columns, side * side)


def from_blocks(blocks: Floats, shape: tuple[int, ...], side: int) -> Floats:
    """Invert `to_blocks`."""
    cut = blocks.reshape(shape[0] // side, shape[1] // side, side, side)
    return np.asarray(cut.transpose(0, 2, 1, 3).reshape(shape))


def bytes_of(count: int, blocks: int, choices: int) -> int:
    """Return the bytes of `count` tiles, rounded up."""
    return int(np.ceil(count * (np.log2(blocks) + np.log2(choices) + _FACTOR_BITS) / 8))


def best_corrections(residual: Floats, units: Floats, nearest_to: Floats | None = None) -> tuple[Floats, Floats]:
    """Return the best multiple of a tile for each block, and the squared error that it removes.

    Args:
        residual: What to approximate, shape (blocks, pixels).
        units: The tiles without their means, of unit norm, shape (tiles, pixels).
        nearest_to: Blocks of the same shape: only the `NEAREST` tiles most similar to each may be used; None: all.
    """
    product = residual @ units.T
    gain = product**2
    if nearest_to is not None:
        similar = nearest_to @ units.T
        least = np.partition(similar, -NEAREST, axis=1)[:, -NEAREST, None]
        gain[similar < least] = -1
    best = gain.argmax(1)
    place = np.arange(len(best))
    return units[best] * product[place, best, None], gain[place, best]


def corrected(blocks: Floats, correction: Floats, gain: Floats, count: int) -> Floats:
    """Return the blocks with the corrections of the `count` best ones."""
    out = blocks.copy()
    best = np.argsort(-gain)[:count]
    out[best] += correction[best]
    return out


def psnr_with_tiles(image: Image, budget: int, units: Floats, use: str, count: int) -> float:
    """Return the PSNR of an image with `count` tiles within the budget."""
    side, codec = int(np.sqrt(units.shape[1])), EmbCodec()
    original = to_blocks(image, side)
    rest = budget - bytes_of(count, len(original), NEAREST if use == "nearest" else len(units))
    if use == "before":
        correction, gain = best_corrections(original - original.mean(1, keepdims=True), units)
        tiles = from_blocks(corrected(np.zeros_like(original), correction, gain, count), image.shape, side)
        difference = np.clip(np.rint(image - tiles), 0, 255).astype(np.uint8)
        result = codec.decode(codec.encode(difference, rest)).image + tiles
    else:
        decoded = to_blocks(codec.decode(codec.encode(image, rest)).image, side)
        correction, gain = best_corrections(original - decoded, units, decoded if use == "nearest" else None)
        result = from_blocks(corrected(decoded, correction, gain, count), image.shape, side)
    return psnr_db(image, np.clip(np.rint(result), 0, 255).astype(np.uint8))


def unit_tiles(name: str) -> Floats:
    """Return the tiles of a codebook without their means, of unit norm, shape (tiles, pixels)."""
    tiles = open_codebook(name).tiles.tiles.astype(np.float32)
    tiles -= tiles.mean(1, keepdims=True)
    tiles /= np.maximum(np.linalg.norm(tiles, axis=1, keepdims=True), 1e-6)
    return tiles


def run(args: argparse.Namespace) -> int:
    """Print the change of the mean PSNR by budget, size of the tiles, use and number of tiles."""
    images = [i.pixels for i in sdvd_crops(args.data / "snippets" / "sdvd").images][:: args.every]
    codec, tiles = EmbCodec(), {name: unit_tiles(name) for name in ("nominal-10", "nominal-20")}
    for budget in args.budgets:
        plain = np.array([psnr_db(i, codec.decode(codec.encode(i, budget)).image) for i in images])
        print(f"{len(images)} images, {budget} B: {plain.mean():.3f} dB", flush=True)
        for name, units in tiles.items():
            for use in ("before", "after", "nearest"):
                gains = [np.mean([psnr_with_tiles(i, budget, units, use, n) for i in images] - plain) for n in COUNTS]
                print(f"  {name}, {use}, {COUNTS} tiles: {np.round(gains, 3).tolist()} dB", flush=True)
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    parser = command_parser("training.emb.trials.tile_predictors", __doc__ or "")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--budgets", type=int, nargs="+", default=[64, 128])
    parser.add_argument("--every", type=int, default=3, help="use every n-th of the 138 crops")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    sys.exit(main())
