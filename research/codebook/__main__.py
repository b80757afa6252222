"""`python -m research.codebook`: build (the paper's Table IV), show, compare and adapt tile codebooks."""

import argparse
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from research.codebook.adaptation import CodebookQuality, adapt, measure, split_images
from research.codebook.builder import MAX_TILES, Round, TrainingImage, build, rms_distance
from research.codebook.codebook_file import save
from research.codebook.comparison import UnmatchedTiles, compare
from sonarpost.cli.main import apply_verbosity, exit_status
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import in_new_folder
from sonarpost.codec.interface import Image, to_uint8
from sonarpost.codec.vq.codebook import Codebook, open_codebook
from sonarpost.codec.vq.codec import codebook_tag
from sonarpost.codec.vq.tiles import MAX_DIMS
from sonarpost.errors import CodebookError, ConfigError, SurveyFileError
from sonarpost.sonar.image_decoding import read_any_image
from sonarpost.sonar.image_files import list_images

DEFAULT_ROUNDS = "39:16"
EXIT_SOME_FAILED = 1
EXIT_DIFFERENT = 1
_ROUND = re.compile(r"(?P<fom>\d{1,6}(\.\d{1,6})?):(?P<rms>\d{1,6}(\.\d{1,6})?)(:(?P<images>\d{1,9}))?", re.ASCII)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    parser = new_parser()
    parsed = parser.parse_args(arguments)
    apply_verbosity(parsed)
    return exit_status(lambda: run(parsed), parser.prog)


def new_parser() -> CommandParser:
    """Return the parser of this command."""
    # Not that of `research.common.command`: it loads all codecs and what they are compared with.
    parser = CommandParser(prog="python -m research.codebook", description="Build, compare and adapt tile codebooks.")
    for add in (_add_build, _add_info, _add_diff, _add_adapt):
        add(parser)
    return parser


def run(args: argparse.Namespace) -> int:
    """Run the action; return the exit status.

    Raises:
        SonarpostError: Invalid options, images or codebooks.
    """
    status: int = args.run(args)
    return status


def _add_build(whole: CommandParser) -> None:
    parser = whole.add_action("build", "build a codebook from images (the paper's Table IV)", run_build)
    _add_images_and_output(parser)
    parser.add_argument("--tile", type=int, default=10, metavar="PX", help="side of a tile (default: 10)")
    parser.add_argument(
        "--rounds",
        default=DEFAULT_ROUNDS,
        metavar="FOM:RMS[:IMAGES],...",
        help="for each round: figure of merit below which an image adds tiles, grey levels RMS from which a tile is "
        f"new, maximum number of images (default: {DEFAULT_ROUNDS}, the paper's 39 and 320 of 400-pixel tiles)",
    )
    parser.add_argument(
        "--dims", type=int, default=MAX_DIMS, metavar="N", help=f"dimensions of the basis (default: {MAX_DIMS})"
    )
    parser.add_argument(
        "--refine", type=int, default=0, metavar="N", help="refinement passes after the rounds (default: 0)"
    )
    parser.add_argument("--core", metavar="NAME_OR_FILE", help="a codebook to extend")
    parser.add_argument("--resume", action="store_true", help="resume an interrupted build")


def _add_info(whole: CommandParser) -> None:
    parser = whole.add_action("info", "show the content of a codebook", run_info)
    parser.add_argument("codebook", metavar="NAME_OR_FILE", help="nominal-10, nominal-20 or a file")


def _add_diff(whole: CommandParser) -> None:
    parser = whole.add_action(
        "diff", "compare two codebooks", run_diff, description="Compare two codebooks. Exit status 1: they differ."
    )
    parser.add_argument("first", metavar="A", help="nominal-10, nominal-20 or a file")
    parser.add_argument("second", metavar="B", help="the other codebook")


def _add_adapt(whole: CommandParser) -> None:
    parser = whole.add_action(
        "adapt",
        "adapt a codebook to a type of seabed",
        run_adapt,
        description="Replaces the least used tiles by tiles from the images. The last quarter of the images is used to "
        "measure the gain, not for training.",
    )
    parser.add_argument("base", metavar="BASE", help="nominal-10, nominal-20 or a file")
    _add_images_and_output(parser)
    parser.add_argument(
        "--keep", type=int, metavar="N", help="minimum number of base tiles that stay (default: half of them)"
    )


def _add_images_and_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--images",
        type=Path,
        nargs="+",
        required=True,
        metavar="DIR",
        help="folders of JPEG, PNG or TIFF images, or files",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the codebook to write")
    parser.add_argument(
        "--max-tiles", type=int, default=MAX_TILES, metavar="N", help=f"maximum number of tiles (default: {MAX_TILES})"
    )


def run_build(args: argparse.Namespace) -> int:
    """Build a codebook; return 0, or 1 if an image was skipped."""
    rounds = parse_rounds(args.rounds, args.tile)
    if args.refine < 0:
        raise ConfigError("--refine", "", args.refine, "zero or more passes")
    journal = in_new_folder(args.out).with_name(args.out.name + ".journal")
    if journal.exists() and not args.resume:
        raise CodebookError(str(journal), "", "an interrupted build", "--resume to continue, or remove the journal")
    console = Console(stderr=True)
    images, skipped = _training_images(args.images, console)
    core = open_codebook(args.core).tiles if args.core is not None else None
    with ProgressDisplay() as display:
        database = build(
            images,
            args.tile,
            rounds,
            max_tiles=args.max_tiles,
            dims=args.dims,
            core=core,
            passes=args.refine,
            journal_path=journal,
            progress=lambda progress: progress.show_on(display),
        )
    notes = {"images": str(len(images)), "rounds": args.rounds, "refine passes": str(args.refine)}
    if core is not None:
        notes["core"] = f"{args.core} {core.identity}"
    codebook = Codebook(database, notes)
    save(args.out, codebook)
    journal.unlink()
    _print_codebook(codebook)
    return EXIT_SOME_FAILED if skipped else 0


def parse_rounds(text: str, tile_px: int) -> tuple[Round, ...]:
    """Parse `FOM:RMS[:IMAGES],...`.

    Raises:
        ConfigError: The text does not have this form.
    """
    rounds = []
    for part in text.split(","):
        match = _ROUND.fullmatch(part.strip())
        if match is None:
            raise ConfigError("--rounds", "", part, "FOM:RMS or FOM:RMS:IMAGES, for example 39:16:500")
        max_images = int(match["images"]) if match["images"] else None
        rounds.append(Round(float(match["fom"]), rms_distance(float(match["rms"]), tile_px), max_images))
    return tuple(rounds)


def run_info(args: argparse.Namespace) -> int:
    """Print the content of a codebook; return 0."""
    _print_codebook(open_codebook(args.codebook))
    return 0


def run_diff(args: argparse.Namespace) -> int:
    """Print the differences; return 0 if the identities are equal, else 1, like `diff`."""
    first, second = open_codebook(args.first).tiles, open_codebook(args.second).tiles
    difference = compare(first, second)
    _print_table(
        {
            "identity": "the same" if difference.same_identity else f"A {first.identity}, B {second.identity}",
            "tiles": f"A {difference.first.tiles}, B {difference.second.tiles}, {difference.common} in both",
            "same number": f"{difference.same_numbers} tiles have the same number in both",
            "only in A": _unmatched_text(difference.first, "B"),
            "only in B": _unmatched_text(difference.second, "A"),
            "bases": f"{first.dims} and {second.dims} dimensions; principal angles up to "
            f"{difference.angle_max_deg:.2f} deg, {difference.angle_rms_deg:.2f} deg RMS",
            "variance of A": _variance_text(difference.first, "A", "B"),
            "variance of B": _variance_text(difference.second, "B", "A"),
        }
    )
    return 0 if difference.same_identity else EXIT_DIFFERENT


def _unmatched_text(tiles: UnmatchedTiles, other: str) -> str:
    return (
        f"{tiles.only_here} tiles; from all to the nearest in {other}: median {tiles.rms_median:.2f}, "
        f"95 % within {tiles.rms_95:.2f}, at most {tiles.rms_max:.2f} grey levels RMS"
    )


def _variance_text(tiles: UnmatchedTiles, own: str, other: str) -> str:
    own_percent, other_percent = 100 * tiles.variance_own, 100 * tiles.variance_other
    return f"{own_percent:.2f} % in the basis of {own}, {other_percent:.2f} % in that of {other}"


def run_adapt(args: argparse.Namespace) -> int:
    """Adapt a codebook and measure the gain; return 0, or 1 if an image was skipped."""
    console = Console(stderr=True)
    in_new_folder(args.out)
    base = open_codebook(args.base).tiles
    images, skipped = _training_images(args.images, console)
    training, held_out = split_images(images)
    with ProgressDisplay() as display:
        adapted = adapt(base, training, max_tiles=args.max_tiles, keep=args.keep, progress=display.show)
        before, after = measure(base, held_out), measure(adapted.tiles, held_out)
    notes = {
        "adapted from": f"{args.base} {base.identity}",
        "images": f"{len(training)} for training, {len(held_out)} held out",
        "base tiles replaced": f"{adapted.replaced} of {len(base)} ({adapted.used} were used by the images)",
        "new tiles": str(adapted.new),
        **_gain(before, after),
    }
    save(args.out, Codebook(adapted.tiles, notes))
    _print_table({"tiles": str(len(adapted.tiles)), "identity": adapted.tiles.identity, **notes})
    if np.mean([quality.psnr_db for quality in after]) <= np.mean([quality.psnr_db for quality in before]):
        console.print("no gain on the held-out images: the base codebook suits this seabed as well", markup=False)
    return EXIT_SOME_FAILED if skipped else 0


def _gain(before: list[CodebookQuality], after: list[CodebookQuality]) -> dict[str, str]:
    """Return mean PSNR and figure of merit over the held-out images, and the number of images that improved."""
    gains = {}
    for name, values in (
        ("PSNR dB", [(a.psnr_db, b.psnr_db) for a, b in zip(before, after, strict=True)]),
        ("FOM", [(a.fom, b.fom) for a, b in zip(before, after, strict=True)]),
    ):
        old, new = np.mean(values, axis=0).tolist()
        better = sum(after > before for before, after in values)
        gains[f"held-out {name}"] = f"{old:.2f} before, {new:.2f} after; better in {better} of {len(values)}"
    return gains


def _print_codebook(codebook: Codebook) -> None:
    tiles = codebook.tiles
    _print_table(
        {
            "tiles": f"{len(tiles)} of {tiles.tile_px} × {tiles.tile_px} px",
            "dimensions": f"{tiles.dims} of {tiles.tile_px**2}",
            "identity": tiles.identity,
            "tag in streams": f"{codebook_tag(tiles):#06x}",
            **codebook.notes,
        }
    )


def _print_table(rows: dict[str, str]) -> None:
    """Print names and values in two columns."""
    width = max(len(name) for name in rows)
    for name, value in rows.items():
        print(f"{name:{width}}  {value}")


def _training_images(sources: list[Path], console: Console) -> tuple[list[TrainingImage], int]:
    """Return the readable images of folders and files, sorted within each folder, and the number of unreadable ones.

    The codebook depends on the order. Images are read again when needed: a folder may be larger than memory.
    """
    images, skipped = [], 0
    for source in sources:
        paths: tuple[Path, ...] = (source,)
        if source.is_dir():
            found = list_images(source)
            paths = found.images
            for line in found.unused:
                console.print(line, markup=False, soft_wrap=True)
        for path in paths:
            try:
                image = read_any_image(path)
            except SurveyFileError as error:
                skipped += 1
                console.print(f"skipped: {error}", markup=False, soft_wrap=True)
                continue
            for note in image.notes:
                console.print(f"{path}: {note}", markup=False, soft_wrap=True)
            pixels = image.pixels
            images.append(TrainingImage(f"{path} {pixels.shape} {pixels.dtype}", _loader(path)))
    return images, skipped


def _loader(path: Path) -> Callable[[], Image]:
    return lambda: to_uint8(read_any_image(path).pixels)


if __name__ == "__main__":
    sys.exit(main())
