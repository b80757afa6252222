"""`sonarpost codebook build`: the paper's Table IV over folders of images."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from rich.console import Console

from sonarpost.cli.codebook.images import training_images
from sonarpost.cli.codebook.info import show
from sonarpost.cli.codebook.progress import ProgressDisplay
from sonarpost.codec.vq.builder import build
from sonarpost.codec.vq.codebook import Codebook, open_codebook, save
from sonarpost.codec.vq.tiles import MAX_DIMS
from sonarpost.codec.vq.training_config import MAX_TILES, Round, rms_distance
from sonarpost.errors import CodebookError, ConfigError

DEFAULT_ROUNDS = "39:16"
EXIT_SOME_FAILED = 1
_ROUND = re.compile(r"(?P<fom>\d{1,6}(\.\d{1,6})?):(?P<rms>\d{1,6}(\.\d{1,6})?)(:(?P<images>\d{1,9}))?", re.ASCII)


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action."""
    parser = actions.add_parser("build", help="build a codebook from images (the paper's Table IV)")
    parser.add_argument(
        "--images", type=Path, nargs="+", required=True, metavar="DIR", help="folders of TIFF or PNG images, or files"
    )
    parser.add_argument("--tile", type=int, default=10, metavar="PX", help="side of a tile (default: 10)")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the codebook to write")
    parser.add_argument(
        "--rounds",
        default=DEFAULT_ROUNDS,
        metavar="FOM:RMS[:IMAGES],...",
        help="images below this figure of merit give tiles farther than this many grey levels RMS; "
        f"most images (default: {DEFAULT_ROUNDS}, the paper's 39 and 320 of 400-pixel tiles)",
    )
    parser.add_argument("--max-tiles", type=int, default=MAX_TILES, metavar="N", help=f"default: {MAX_TILES}")
    parser.add_argument(
        "--dims", type=int, default=MAX_DIMS, metavar="N", help=f"dimensions kept (default: {MAX_DIMS})"
    )
    parser.add_argument(
        "--refine", type=int, default=0, metavar="N", help="passes of refinement afterwards (default: 0)"
    )
    parser.add_argument("--core", metavar="NAME_OR_FILE", help="a codebook to add to")
    parser.add_argument("--resume", action="store_true", help="go on with a build that was stopped")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Build; return 0, or 1 if an image had to be left out.

    Raises:
        SonarpostError: No image can be read, an argument is wrong, or the codebook cannot be written.
    """
    rounds = parse_rounds(args.rounds, args.tile)
    if args.refine < 0:
        raise ConfigError("--refine", "", args.refine, "zero or more passes")
    journal = args.out.with_name(args.out.name + ".journal")
    if journal.exists() and not args.resume:
        raise CodebookError(str(journal), "", "a build that was stopped", "--resume to go on, or remove the journal")
    console = Console(stderr=True)
    images, failed = training_images(args.images, console)
    core = open_codebook(args.core).tiles if args.core is not None else None
    with ProgressDisplay(console) as display:
        database = build(
            images,
            args.tile,
            rounds,
            max_tiles=args.max_tiles,
            dims=args.dims,
            core=core,
            passes=args.refine,
            journal_path=journal,
            progress=display.build,
        )
    notes = {"images": str(len(images)), "rounds": args.rounds, "refine passes": str(args.refine)}
    if core is not None:
        notes["core"] = f"{args.core} {core.identity}"
    codebook = Codebook(database, notes)
    save(args.out, codebook)
    journal.unlink()
    show(codebook)
    return EXIT_SOME_FAILED if failed else 0


def parse_rounds(text: str, tile_px: int) -> tuple[Round, ...]:
    """Read `FOM:RMS[:IMAGES],...`.

    Raises:
        ConfigError: It is not of this form.
    """
    rounds = []
    for part in text.split(","):
        match = _ROUND.fullmatch(part.strip())
        if match is None:
            raise ConfigError("--rounds", "", part, "FOM:RMS or FOM:RMS:IMAGES, for example 39:16:500")
        most = int(match["images"]) if match["images"] else None
        rounds.append(Round(float(match["fom"]), rms_distance(float(match["rms"]), tile_px), most))
    return tuple(rounds)
