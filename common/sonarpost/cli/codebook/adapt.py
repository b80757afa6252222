"""`sonarpost codebook adapt`: a codebook for one type of seabed, from a folder of images of it."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console

from sonarpost.cli.codebook.images import training_images
from sonarpost.cli.codebook.info import print_facts
from sonarpost.cli.codebook.progress import ProgressDisplay
from sonarpost.codec.vq.adaptation import CodebookQuality, adapt, measure, split
from sonarpost.codec.vq.codebook import Codebook, open_codebook, save
from sonarpost.codec.vq.training_config import MAX_TILES

EXIT_SOME_FAILED = 1


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action."""
    parser = actions.add_parser(
        "adapt",
        help="adapt a codebook to a type of seabed",
        description="Replaces the least used tiles by tiles that the images need. The last quarter of the images is "
        "not learned from: on it the gain is measured.",
    )
    parser.add_argument("base", metavar="BASE", help="nominal-10, nominal-20 or a file")
    parser.add_argument(
        "--images", type=Path, nargs="+", required=True, metavar="DIR", help="folders of TIFF or PNG images, or files"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the codebook to write")
    parser.add_argument(
        "--keep", type=int, metavar="N", help="tiles of the base that stay at least (default: half of them)"
    )
    parser.add_argument("--max-tiles", type=int, default=MAX_TILES, metavar="N", help=f"default: {MAX_TILES}")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Adapt, measure and write; return 0, or 1 if an image had to be left out.

    Raises:
        SonarpostError: Fewer than two images can be read, an argument is wrong, or the codebook cannot be written.
    """
    console = Console(stderr=True)
    base = open_codebook(args.base).tiles
    images, failed = training_images(args.images, console)
    training, held_out = split(images)
    with ProgressDisplay(console) as display:
        adapted = adapt(base, training, max_tiles=args.max_tiles, keep=args.keep, told=display.show)
        before, after = measure(base, held_out), measure(adapted.tiles, held_out)
    gain = _gain(before, after)
    notes = {
        "adapted from": f"{args.base} {base.identity}",
        "images": f"{len(training)} to learn from, {len(held_out)} held out",
        "base tiles replaced": f"{adapted.replaced} of {len(base)} ({adapted.used} were used by the images)",
        "new tiles": str(adapted.new),
        **gain,
    }
    save(args.out, Codebook(adapted.tiles, notes))
    print_facts({"tiles": str(len(adapted.tiles)), "identity": adapted.tiles.identity, **notes})
    if np.mean([quality.psnr_db for quality in after]) <= np.mean([quality.psnr_db for quality in before]):
        console.print("no gain on the images held out: the base serves this seabed as well", markup=False)
    return EXIT_SOME_FAILED if failed else 0


def _gain(before: list[CodebookQuality], after: list[CodebookQuality]) -> dict[str, str]:
    """Tell mean PSNR and figure of merit over the pictures held out, and how many of them became better."""
    gains = {}
    for name, values in (
        ("PSNR dB", [(a.psnr_db, b.psnr_db) for a, b in zip(before, after, strict=True)]),
        ("FOM", [(a.fom, b.fom) for a, b in zip(before, after, strict=True)]),
    ):
        old, new = np.mean(values, axis=0).tolist()
        better = sum(after > before for before, after in values)
        gains[f"held-out {name}"] = f"{old:.2f} before, {new:.2f} after; better in {better} of {len(values)}"
    return gains
