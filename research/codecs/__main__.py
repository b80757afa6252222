"""`python -m research.codecs`: quality, size and speed of every codec at every budget."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from research.codecs.report import curves, details, json_line, miss_lines, rate_differences, result_rows, text
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
    BudgetResult,
    CodecUnderTest,
    code_image,
    measure_codec,
    scene_reference,
)
from research.common.plots import SheetCell, new_figure, save_figure, write_sheet
from research.common.quality import psnr_db
from research.common.statistics import bootstrap_weights, finite_mean
from sonarpost.cli.shared import add_fit_option, in_new_folder
from sonarpost.errors import ConfigError
from sonarpost.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

T = TypeVar("T")

_SIMULATED: Final = 48
_SHEET_IMAGES: Final = 6
_SHEET_BUDGETS: Final = 3
_TICKS_BYTES: Final = (8, 16, 32, 64, 128, 256, 512, 1024, 2048)


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
        "--crop", type=int, metavar="PX", help="side of the crops or simulated images (80); --images is SDVD then"
    )
    parser.add_argument(
        "--count", type=int, default=_SIMULATED, metavar="N", help="number of simulated images (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the simulated images (default: 0)")
    add_codec_arguments(parser)
    add_strength_argument(parser)
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw rate-distortion curves (needs matplotlib)")
    parser.add_argument(
        "--details", type=Path, metavar="FILE.json", help="write all figures: intervals, misses, variants"
    )
    parser.add_argument(
        "--cut", action="store_true", help="emb and spiht: one stream for the largest budget, truncated for the others"
    )
    parser.add_argument("--sheet", type=Path, metavar="FILE.png", help="draw images as decoded by each codec")
    parser.add_argument(
        "--codebooks",
        "--catalogues",
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
    side_px: int = 80 if args.crop is None else args.crop
    sdvd: Path | None = args.sdvd if args.crop is None or args.images is None else args.images
    if sdvd is not None:
        return sdvd_crops(sdvd, "test", side_px)
    if args.images is None:
        return simulated_images(args.count, args.seed, side_px, with_scenes=with_scenes)
    found = read_image_folder(args.images, args.fit)
    for line in found.rejected:
        warn(f"rejected: {line}")
    for line in found.notes:
        warn(line)
    return found


def run(args: argparse.Namespace) -> int:
    """Measure and report; return 0.

    Raises:
        SonarpostError: Invalid options, folders or codecs; a plot without matplotlib.
        OSError: A file cannot be written.
    """
    budgets = parse_budgets(args.budgets)
    for path in (args.plot, args.sheet, args.details):
        if path is not None:
            in_new_folder(path)
    if args.plot is not None:
        new_figure(1, 1)  # a missing extra is reported before the measurement
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
    title = f"{len(measured.images)} images of {measured.origin}"
    if args.plot is not None:
        save_figure(plot_rate_distortion(results, title), args.plot)
    if args.sheet is not None:
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


def plot_rate_distortion(results: Sequence[BudgetResult], title: str) -> Figure:
    """Draw PSNR, SSIM and MS-SSIM over bytes, one line a codec; a budget with misses has an open marker.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    figure = new_figure(15, 4.6)
    axes = figure.subplots(1, 3)
    markers = "osD^v<>Phd"
    for number, (name, curve) in enumerate(curves(results).items()):
        coded = sorted((r for r in curve if r.hits.any()), key=lambda r: finite_mean(r.stream_bytes))
        if not coded:
            continue
        rates = [finite_mean(r.stream_bytes) for r in coded]
        marker = markers[number % len(markers)]
        style = "none" if coded[0].tested.is_natural else "-"
        for axis, metric in zip(axes, ("psnr", "ssim", "msssim"), strict=True):
            means = [finite_mean(getattr(r, metric)) for r in coded]
            (line,) = axis.plot(rates, means, linestyle=style, marker=marker, markersize=5, label=name)
            with_misses = [(rate, mean) for r, rate, mean in zip(coded, rates, means, strict=True) if r.misses]
            if with_misses:
                x, y = zip(*with_misses, strict=True)
                axis.plot(x, y, "none", marker=marker, markersize=5, mfc="white", mec=line.get_color(), linestyle="")
    for axis, label in zip(axes, ("PSNR, dB", "SSIM", "MS-SSIM (3 scales)"), strict=True):
        axis.set_xscale("log", base=2)
        axis.set_xlabel("bytes an image, header included")
        axis.set_ylabel(label)
        axis.grid(visible=True, alpha=0.3)
        low, high = axis.get_xlim()
        ticks = [b for b in _TICKS_BYTES if low <= b <= high]
        axis.set_xticks(ticks, [str(b) for b in ticks])
    axes[0].legend(fontsize=8)
    figure.suptitle(title, fontsize=11)
    return figure


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
