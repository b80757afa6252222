"""`python -m research.codecs`: quality, size and speed of every codec at every budget."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final, TypeVar

from research.codecs.report import details, json_line, miss_lines, rate_differences, result_rows, text
from research.common.command import (
    add_codec_arguments,
    add_strength_argument,
    command_parser,
    parse_budgets,
    report_progress,
    run_command,
    selected_codecs,
    warn,
)
from research.common.images import ImageSet, SampleImage, read_image_folder, sdvd_crops, simulated_images
from research.common.measurement import (
    SHIPPED_CODEBOOKS,
    CodecUnderTest,
    code_image,
    measure_codec,
    scene_reference,
)
from research.common.plots import SheetCell, write_sheet
from research.common.quality import psnr_db
from research.common.statistics import bootstrap_weights
from sonarpost.cli.shared import add_fit_option, in_new_folder
from sonarpost.errors import ConfigError
from sonarpost.files import write_atomically

T = TypeVar("T")

_SIMULATED: Final = 48
_SHEET_IMAGES: Final = 6
_SHEET_BUDGETS: Final = 3


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser(
        "codecs",
        description="Encode and decode images with every codec at every budget. Without --images or --sdvd the "
        "images are cut from simulated surveys.",
    )
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--images", type=Path, metavar="DIR", help="JPEG, PNG or TIFF images of any depth and colour")
    source.add_argument("--sdvd", type=Path, metavar="DIR", help="the SDVD data set: crops of its test split")
    add_fit_option(parser)
    parser.add_argument(
        "--count", type=int, default=_SIMULATED, metavar="N", help="number of simulated images (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the simulated images (default: 0)")
    add_codec_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    add_strength_argument(parser)
    parser.add_argument(
        "--details", type=Path, metavar="FILE.json", help="write all figures: intervals, misses, variants"
    )
    parser.add_argument(
        "--cut", action="store_true", help="emb and spiht: one stream for the largest budget, truncated for the others"
    )
    parser.add_argument("--sheet", type=Path, metavar="FILE.png", help="draw images as decoded by each codec")
    parser.add_argument(
        "--codebooks",
        nargs="+",
        default=SHIPPED_CODEBOOKS,
        metavar="NAME_OR_FILE",
        help="codebooks of vq (default: nominal-10 nominal-20)",
    )
    return parser


def selected_images(args: argparse.Namespace, *, with_scenes: bool = False) -> ImageSet:
    """Return the images of the options; print rejected files to standard error.

    Args:
        args: The parsed options.
        with_scenes: Whether simulated images have their speckle-free scenes.

    Raises:
        SurveyFileError: The folder or the data set cannot be read.
        ConfigError: A number out of range.
    """
    if not 0 <= args.seed <= 1_000_000:
        raise ConfigError("research", "--seed", args.seed, "0..1000000")
    if args.sdvd is not None:
        return sdvd_crops(args.sdvd)
    if args.images is None:
        return simulated_images(args.count, args.seed, with_scenes=with_scenes)
    found = read_image_folder(args.images, args.fit)
    for line in found.rejected:
        warn(f"rejected: {line}")
    for line in found.notes:
        warn(line)
    return found


def run(args: argparse.Namespace) -> int:
    """Measure and report; return 0.

    Raises:
        SonarpostError: Invalid options, folders or codecs.
        OSError: A file cannot be written.
    """
    budgets = parse_budgets(args.budgets)
    for path in (args.sheet, args.details):
        if path is not None:
            in_new_folder(path)
    tested = selected_codecs(args, cut=args.cut, codebooks=args.codebooks)
    with_scenes = args.json or args.details is not None  # the tables do not show these measures
    measured = selected_images(args, with_scenes=with_scenes)
    references = [scene_reference(image) for image in measured.images] if with_scenes else []
    results = [
        result
        for codec in tested
        for result in measure_codec(codec, measured.images, budgets, report_progress, references)
    ]
    weights = bootstrap_weights([image.source for image in measured.images])
    if args.sheet is not None:
        title = f"{len(measured.images)} images of {measured.origin}"
        write_sheet(args.sheet, title, sheet_rows(tested, measured.images, budgets))
    differences = rate_differences(results, weights)
    if args.details is not None:
        write_atomically(args.details, details(results, budgets, measured, weights, differences).encode())
    if args.json:
        print(json_line(result_rows(results, budgets), len(measured.images), differences))
        for line in miss_lines(results):
            warn(line)
    else:
        print(text(results, measured, weights, differences))
    return 0


def sheet_rows(
    tested: Sequence[CodecUnderTest], images: Sequence[SampleImage], budgets: Sequence[int]
) -> list[list[SheetCell]]:
    """Return the cells of a contact sheet: one row an image and budget, the original first.

    The sheet has up to six images of the set and up to three budgets, and the shortest packing of vq.
    """
    columns = [t for t in tested if not t.is_natural or t.variant.endswith("14bit")]
    sheet_budgets = spread(budgets, _SHEET_BUDGETS)
    rows = []
    for number, image in enumerate(spread(images, _SHEET_IMAGES)):
        budget = sheet_budgets[number % len(sheet_budgets)]
        row = [SheetCell(image.pixels, "original", f"budget {budget} B")]
        for codec in columns:
            coded = code_image(codec, image.pixels, [budget])[0]
            if isinstance(coded, str):
                row.append(SheetCell(None, codec.label))
                continue
            detail = f"{len(coded.stream)} B, {psnr_db(image.pixels, coded.decoded):.2f} dB"
            row.append(SheetCell(coded.decoded, codec.label, detail))
        rows.append(row)
    return rows


def spread(items: Sequence[T], limit: int) -> list[T]:
    """Return at most `limit` items, evenly distributed from the first to the last."""
    count = min(limit, len(items))
    return [items[i * (len(items) - 1) // max(count - 1, 1)] for i in range(count)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
