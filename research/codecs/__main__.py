"""`python -m research.codecs`: quality, real bytes and speed of every codec at every budget."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final, TypeVar

from research.codecs.report import details, json_line, miss_lines, rate_differences, result_rows, text
from research.common.command import command_parser, run_command
from research.common.images import BenchPicture, PictureSet, read_folder, simulated_pictures
from research.common.measurement import SHIPPED_CODEBOOKS, Subject, code, measure, subjects
from research.common.plots import SheetCell, new_figure, plot_rate_distortion, save_figure, write_sheet
from research.common.sdvd import sdvd_crops
from research.common.statistics import bootstrap_weights
from sonarpost.codec.quality import psnr_db
from sonarpost.codec.registry import default_registry
from sonarpost.errors import ConfigError
from sonarpost.files import write_atomically

T = TypeVar("T")

DEFAULT_BUDGETS: Final = "22,44,64,88,128,192,256,384,512"
MAX_BUDGET_BYTES: Final = 1 << 20
_SIMULATED: Final = 48
_SHEET_PICTURES: Final = 6
_SHEET_BUDGETS: Final = 3


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser(
        "codecs",
        description="Encode and decode pictures with every codec at every budget. Without --images or --sdvd the "
        "pictures are cut from simulated surveys.",
    )
    add_picture_arguments(parser)
    add_codec_arguments(parser)
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw rate-distortion curves (needs matplotlib)")
    parser.add_argument(
        "--details", type=Path, metavar="FILE.json", help="write everything measured: intervals, misses, variants"
    )
    parser.add_argument(
        "--cut", action="store_true", help="emb and spiht: one stream for the largest budget, cut for the others"
    )
    parser.add_argument("--sheet", type=Path, metavar="FILE.png", help="draw pictures as each codec rebuilds them")
    parser.add_argument(
        "--codebooks",
        "--catalogues",
        nargs="+",
        default=SHIPPED_CODEBOOKS,
        metavar="NAME_OR_FILE",
        help="that vq is measured with (default: nominal-10 nominal-20)",
    )
    return parser


def add_picture_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that say which pictures."""
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "--images", type=Path, metavar="DIR", help="grey PNG, JPEG or TIFF pictures of 16..512 px a side, at any depth"
    )
    source.add_argument(
        "--sdvd", type=Path, metavar="DIR", help="the SDVD data set: crops of its test split, cut in memory"
    )
    parser.add_argument(
        "--crop", type=int, metavar="PX", help="side of the crops or simulated pictures (80); --images is SDVD then"
    )
    parser.add_argument(
        "--count", type=int, default=_SIMULATED, metavar="N", help="how many simulated pictures (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of simulated pictures (default: 0)")


def add_codec_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that say which codecs and budgets."""
    parser.add_argument(
        "--budgets", default=DEFAULT_BUDGETS, metavar="B,B,…", help="most bytes of a stream (default: %(default)s)"
    )
    parser.add_argument("--codecs", metavar="NAME,…", help="default: all that can be made here")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")


def chosen_pictures(args: argparse.Namespace) -> PictureSet:
    """Return the pictures that the options ask for; say on stderr what was refused.

    Raises:
        SurveyFileError: The folder or the data set cannot be read.
        ConfigError: A number out of range.
    """
    if not 0 <= args.seed <= 1_000_000:
        raise ConfigError("research", "--seed", args.seed, "0..1000000")
    side_px: int = 80 if args.crop is None else args.crop
    sdvd: Path | None = args.sdvd if args.crop is None or args.images is None else args.images
    if sdvd is not None:
        return sdvd_crops(sdvd, "test", side_px)
    if args.images is None:
        return simulated_pictures(args.count, args.seed, side_px)
    found = read_folder(args.images)
    for line in found.refused:
        say(f"refused: {line}")
    return found


def chosen_subjects(
    args: argparse.Namespace,
    *,
    all_packings: bool = True,
    cut: bool = False,
    codebooks: Sequence[str] = SHIPPED_CODEBOOKS,
) -> list[Subject]:
    """Return the codecs that the options ask for; say on stderr which cannot be made here.

    Raises:
        ConfigError: A codec asked for is unknown or cannot be made.
        CodebookError: A codebook cannot be read.
    """
    names = None if args.codecs is None else [name.strip() for name in args.codecs.split(",")]
    found, absent = subjects(default_registry(), names, all_packings=all_packings, cut=cut, codebooks=codebooks)
    for line in absent:
        say(f"left out: {line}")
    return found


def parse_budgets(written: str) -> tuple[int, ...]:
    """Read `22,44,…`; return the budgets in rising order, none twice.

    Raises:
        ConfigError: Something else than whole numbers from 1 to 1,048,576.
    """
    parts = [part.strip() for part in written.split(",")]
    for part in parts:
        if not (part.isascii() and part.isdigit() and len(part) < 9 and 1 <= int(part) <= MAX_BUDGET_BYTES):
            raise ConfigError(
                "research", "--budgets", part, f"whole numbers 1..{MAX_BUDGET_BYTES}, separated by commas"
            )
    return tuple(sorted({int(part) for part in parts}))


def run(args: argparse.Namespace) -> int:
    """Measure and report; return 0.

    Raises:
        SonarpostError: Wrong options, folders or codecs; matplotlib absent where a plot is asked for.
        OSError: A file cannot be written.
    """
    budgets = parse_budgets(args.budgets)
    _check_folders(args)
    if args.plot is not None:
        new_figure(1, 1)  # an absent extra is said before the work, not after it
    tested = chosen_subjects(args, cut=args.cut, codebooks=args.codebooks)
    measured = chosen_pictures(args)
    points = [point for subject in tested for point in measure(subject, measured.pictures, budgets, say)]
    weights = bootstrap_weights([picture.source for picture in measured.pictures])
    title = f"{len(measured.pictures)} pictures of {measured.origin}"
    if args.plot is not None:
        save_figure(plot_rate_distortion(points, title), args.plot)
    if args.sheet is not None:
        write_sheet(args.sheet, title, sheet_rows(tested, measured.pictures, budgets))
    differences = rate_differences(points, weights)
    if args.details is not None:
        write_atomically(args.details, details(points, budgets, measured, weights, differences).encode())
    if args.json:
        print(json_line(result_rows(points, budgets), len(measured.pictures), differences))
        for line in miss_lines(points):
            say(line)
    else:
        print(text(points, measured, weights, differences))
    return 0


def _check_folders(args: argparse.Namespace) -> None:
    """Say that a file cannot be written before the work, not after it."""
    for option in ("plot", "sheet", "details"):
        path: Path | None = getattr(args, option)
        if path is not None and not path.absolute().parent.is_dir():
            raise ConfigError("research", f"--{option}", str(path), "a file in a folder that exists")


def sheet_rows(
    tested: Sequence[Subject], pictures: Sequence[BenchPicture], budgets: Sequence[int]
) -> list[list[SheetCell]]:
    """Return a contact sheet's cells: one row a picture and budget, the original first.

    Six pictures spread over the set and three budgets spread over the budgets are shown; of vq the tightest packing.
    """
    shown = [s for s in tested if not s.is_natural or s.variant.endswith("14bit")]
    some_budgets = spread(budgets, _SHEET_BUDGETS)
    rows = []
    for number, picture in enumerate(spread(pictures, _SHEET_PICTURES)):
        budget = some_budgets[number % len(some_budgets)]
        row = [SheetCell(picture.pixels, "original", f"budget {budget} B")]
        for subject in shown:
            coded = code(subject, picture.pixels, [budget])[0]
            if isinstance(coded, str):
                row.append(SheetCell(None, subject.label))
                continue
            detail = f"{len(coded.stream)} B, {psnr_db(picture.pixels, coded.rebuilt):.2f} dB"
            row.append(SheetCell(coded.rebuilt, subject.label, detail))
        rows.append(row)
    return rows


def spread(items: Sequence[T], wanted: int) -> list[T]:
    """Return at most `wanted` items, evenly spread from the first to the last."""
    count = min(wanted, len(items))
    return [items[i * (len(items) - 1) // max(count - 1, 1)] for i in range(count)]


def say(line: str) -> None:
    """Tell the user how far things are, apart from the results."""
    print(line, file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
