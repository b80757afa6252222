"""`python -m research.paper`: the paper's Table II, Fig. 2 and Fig. 3, measured again and written as a page."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from research.codecs.__main__ import chosen_subjects, say
from research.common.command import command_parser, run_command
from research.common.images import simulated_pictures
from research.common.measurement import Coded, Subject
from research.common.plots import SheetCell, new_figure, save_figure, write_sheet
from research.paper.dimensions import DimensionPoint, sensitivity
from research.paper.figures import FIG2, FLAGSHIP, TABLE2, chosen_pictures, code_figure, code_flagship, reproduce
from research.paper.page import page
from sonarpost.codec.interface import Image
from sonarpost.codec.quality import psnr_db
from sonarpost.errors import ConfigError
from sonarpost.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TRAINING: Final = 240
_TRAINING_SEED, _TEST_SEED = 2, 3
_SIDE_PX: Final = 100
_FLAGSHIP_BYTES: Final = (343, 88, 22)


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser(
        "paper",
        description="Measure the paper's Table II, Fig. 2 and Fig. 3 again and write them beside the paper's numbers: "
        "DIR/reproduction.md with its pictures in DIR/reproduction/ (needs matplotlib).",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("docs/research"), metavar="DIR", help="where to write (docs/research)"
    )
    parser.add_argument(
        "--survey", type=Path, metavar="FILE.xtf", help="cut the pictures from this survey's contacts, not simulated"
    )
    parser.add_argument(
        "--training", type=int, default=_TRAINING, metavar="N", help="simulated pictures for Fig. 3 (%(default)s)"
    )
    parser.add_argument("--codecs", help=argparse.SUPPRESS)
    return parser


def run(args: argparse.Namespace) -> int:
    """Measure and write; return 0.

    Raises:
        SonarpostError: matplotlib is absent, the survey cannot be used, or a number is out of range.
        OSError: A file cannot be written.
    """
    new_figure(1, 1)
    if args.training < 2:
        raise ConfigError("paper", "--training", args.training, "at least 2")
    tested = chosen_subjects(args, all_packings=False)
    pictures, origin = chosen_pictures(args.survey)
    say(f"{len(pictures)} pictures: {origin}")
    table2, fig2 = reproduce(TABLE2, tested, pictures), reproduce(FIG2, tested, pictures[:1])
    training = [p.pixels for p in simulated_pictures(args.training, _TRAINING_SEED, _SIDE_PX).pictures]
    test = [p.pixels for p in simulated_pictures(max(args.training // 10, 2), _TEST_SEED, _SIDE_PX).pictures]
    say("building databases for Fig. 3")
    fig3 = sensitivity(training, test)
    folder = args.out / "reproduction"
    folder.mkdir(parents=True, exist_ok=True)
    write_sheet(folder / "fig2.png", f"Fig. 2 again: {origin}", fig2_rows(tested, pictures[0]), scale=3)
    save_figure(plot_dimensions(fig3), folder / "fig3.png")
    written = page(origin, len(pictures), table2, fig2, fig3, len(training), len(test))
    write_atomically(args.out / "reproduction.md", written.encode())
    print(args.out / "reproduction.md")
    return 0


def fig2_rows(tested: Sequence[Subject], picture: Image) -> list[list[SheetCell]]:
    """Return Fig. 2's pictures: the original and the paper's codecs, then the flagship at three of their sizes."""
    cells = [SheetCell(picture, "original", f"{picture.nbytes} B")]
    for figure in FIG2:
        coded = code_figure(figure, tested, picture)
        cells.append(_cell(picture, figure.title, coded, f"paper {figure.paper_bytes} B, {figure.paper_psnr} dB; "))
    flagship = [
        _cell(picture, FLAGSHIP, code_flagship(tested, picture, budget), f"budget {budget} B; ")
        for budget in _FLAGSHIP_BYTES
    ]
    return [cells[:3], cells[3:5], cells[5:], flagship]


def _cell(picture: Image, title: str, coded: Coded | str, before: str) -> SheetCell:
    if isinstance(coded, str):
        return SheetCell(None, title, coded)
    return SheetCell(
        coded.rebuilt, title, f"{before}here {len(coded.stream)} B, {psnr_db(picture, coded.rebuilt):.2f} dB"
    )


def plot_dimensions(points: Sequence[DimensionPoint]) -> Figure:
    """Draw Fig. 3: build time, encode time, sizes, and quality over the dimensions kept.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    figure = new_figure(11, 7)
    axes = figure.subplots(2, 2)
    dims = [p.dims for p in points]
    axes[0, 0].plot(dims, [p.build_s for p in points], "o-")
    axes[0, 0].set_ylabel("time to build the database, s")
    axes[0, 1].plot(dims, [p.encode_ms for p in points], "o-")
    axes[0, 1].set_ylabel("time to encode a picture, ms")
    axes[1, 0].plot(dims, [p.database_bytes / 1e6 for p in points], "o-", label="database, MB")
    axes[1, 0].plot(dims, [p.rotation_bytes / 1e5 for p in points], "s--", label="rotation matrix, 100 kB")
    axes[1, 0].set_ylabel("size")
    axes[1, 0].legend()
    axes[1, 1].plot(dims, [p.fom for p in points], "o-", label="FOM (100 x SSIM)")
    axes[1, 1].plot(dims, [p.psnr for p in points], "s--", label="PSNR, dB")
    axes[1, 1].set_ylabel("quality")
    axes[1, 1].legend()
    for axis in axes.flat:
        axis.set_xlabel("principal components kept")
        axis.set_ylim(bottom=0)
        axis.axvline(70, color="grey", linewidth=0.8, linestyle=":")
        axis.grid(visible=True, alpha=0.3)
    figure.suptitle("Fig. 3 again; dotted: the paper's choice of 70", fontsize=11)
    return figure


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
