"""`python -m research.sea_trial`: the paper's Fig. 6, measured in the simulated channel at 2 to 300 m."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from research.common.command import command_parser, report_progress, run_command
from research.common.images import SampleImage, simulated_images
from research.common.plots import new_figure, save_figure
from research.sea_trial.rig import CodedSnippet, DeliveryCounts, send_images
from sonarpost.cli.shared import in_new_folder
from sonarpost.codec.vq.codebook import load_default
from sonarpost.codec.vq.codec import IndexPacking, VqCodec
from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.channel.parameters import build_parameters
from sonarpost.link.frames.contact_record import ContactSummary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BOUNDARY_M: Final = 130
"""Range at which the paper's trial changes from most packets received to most lost."""
RATES_USED: Final = (1, 4)
SIZES_PX: Final = ((140, 80), (80, 80), (40, 40))
"""Width and height; the first is the paper's, of which all images were received."""
RANGES_M: Final = (2, 30, 50, 60, 70, 80, 90, 100, 110, 120, 130, 135, 140, 145, 150, 160, 180, 200, 250, 300)

_PRESET: Final = "sea-trial"
_TILE_PX: Final = 20
_MAX_IMAGES: Final = 1000
_COLOURS: Final = ("#1b6ca8", "#d1661c", "#3a8f4d", "#8b5aa8")
_MARKERS: Final = ("o", "s", "^", "d")


@dataclass(frozen=True, slots=True)
class Cell:
    """Result for one range, rate and image size.

    Attributes:
        rate: Rate of the modem.
        width_px: Width of the images.
        height_px: Height of the images.
        range_m: Range.
        delivered: Counts of received packets and images.
    """

    rate: int
    width_px: int
    height_px: int
    range_m: int
    delivered: DeliveryCounts

    @property
    def packets(self) -> float:
        """Share of packets received with all frames."""
        return self.delivered.whole_packets / self.delivered.packets

    @property
    def images(self) -> float:
        """Share of images received completely."""
        return self.delivered.whole_images / self.delivered.images


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser(
        "sea_trial",
        description="Send images between two drivers over emulated modems in the channel of the preset sea-trial, at "
        "ranges of 2 to 300 m, in sizes like the paper's, at rates 1 and 4; count received packets and images, and "
        "compare with the paper.",
    )
    parser.add_argument(
        "--images",
        type=int,
        default=40,
        metavar="N",
        help="images a range, size and rate (default: %(default)s)",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of images and channel (default: 0)")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the result (needs matplotlib)")
    return parser


def run(args: argparse.Namespace) -> int:
    """Measure and report; return 0.

    Raises:
        ConfigError: Invalid options, or a plot without matplotlib.
        OSError: The plot cannot be written.
    """
    for option, value, low, high in (
        ("--images", args.images, 1, _MAX_IMAGES),
        ("--seed", args.seed, 0, 1_000_000),
    ):
        if not low <= value <= high:
            raise ConfigError("sea_trial", option, value, f"{low}..{high}")
    if args.plot is not None:
        in_new_folder(args.plot)
    report_progress(f"simulating {args.images} images")
    cells = measure(args.images, args.seed, RANGES_M, SIZES_PX)
    if args.plot is not None:
        save_figure(plot(cells), args.plot)
    print(table(cells))
    return 0


def measure(images: int, seed: int, ranges_m: Sequence[int], sizes_px: Sequence[tuple[int, int]]) -> list[Cell]:
    """Send images over every range, in every size, at both rates.

    Args:
        images: Number of images for each.
        seed: Seed of images and channel. Every cell has its own channel.
        ranges_m: Ranges.
        sizes_px: (width, height), at most 140 px.
    """
    channel = build_parameters({"preset": _PRESET}, "sea_trial")
    simulated = simulated_images(images, seed, max(max(size) for size in SIZES_PX)).images
    codec = VqCodec(load_default(_TILE_PX).tiles, IndexPacking.ASCII5)
    cells = []
    for width_px, height_px in sizes_px:
        snippets = _coded_snippets(simulated, codec, width_px, height_px)
        for rate in RATES_USED:
            report_progress(f"{width_px} × {height_px} px at rate {rate}")
            for range_m in ranges_m:
                own = channel.model_copy(update={"seed": _cell_seed(seed, rate, width_px, height_px, range_m)})
                cells.append(Cell(rate, width_px, height_px, range_m, send_images(own, range_m, rate, snippets)))
    return cells


def _cell_seed(*parts: int) -> int:
    return int(np.random.SeedSequence(parts).generate_state(1)[0])


def _coded_snippets(images: Iterable[SampleImage], codec: VqCodec, width_px: int, height_px: int) -> list[CodedSnippet]:
    """Cut the centre of each image and encode it."""
    snippets = []
    for number, image in enumerate(images):
        top, left = (image.pixels.shape[0] - height_px) // 2, (image.pixels.shape[1] - width_px) // 2
        cut = np.ascontiguousarray(image.pixels[top : top + height_px, left : left + width_px])
        contact = ContactSummary(
            height_px=height_px, width_px=width_px, lat_deg=44.69, lon_deg=-63.64, time_utc_s=1.4e9 + number
        )
        snippets.append(CodedSnippet(codec.encode(cut), contact))
    return snippets


def claims(cells: Sequence[Cell]) -> list[dict[str, str | float | bool]]:
    """Return the statements of the paper about rate 1, the measured values, and whether they agree.

    The paper gives no numbers apart from the 100 %. "Most" is interpreted as more than half: below the boundary at
    every range and size, beyond it for all packets together.
    """
    at_rate_1 = [cell for cell in cells if cell.rate == RATES_USED[0]]
    near = [cell for cell in at_rate_1 if cell.range_m < BOUNDARY_M]
    far = [cell for cell in at_rate_1 if cell.range_m > BOUNDARY_M]
    largest = [cell for cell in near if (cell.width_px, cell.height_px) == SIZES_PX[0]]
    smaller = [cell for cell in near if cell not in largest]
    found: list[dict[str, str | float | bool]] = []

    def add(claim: str, share: float, *, agrees: bool) -> None:
        found.append({"paper": claim, "measured": round(share, 4), "agrees": agrees})

    if near:
        share = _share([(c.delivered.whole_packets, c.delivered.packets) for c in near])
        add("below 130 m most packets are received", share, agrees=min(c.packets for c in near) > 0.5)
    if largest:
        share = _share([(c.delivered.whole_images, c.delivered.images) for c in largest])
        add("below 130 m all images of 140 × 80 px are received", share, agrees=share == 1.0)
    if smaller:
        share = _share([(c.delivered.second_lost, c.delivered.images) for c in smaller])
        only_smaller = not any(c.delivered.second_lost for c in largest)
        add("the second packet is missing of some smaller images, only", share, agrees=only_smaller and share > 0)
    if far:
        share = 1 - _share([(c.delivered.whole_packets, c.delivered.packets) for c in far])
        add("beyond 130 m most packets are lost", share, agrees=share > 0.5)
    return found


def _share(counts: Sequence[tuple[int, int]]) -> float:
    return sum(count for count, _ in counts) / sum(total for _, total in counts)


def table(cells: Sequence[Cell]) -> str:
    """Return a table for each rate, and the statements of the paper with the measured values, as Markdown."""
    lines = []
    sizes = list(dict.fromkeys((cell.width_px, cell.height_px) for cell in cells))
    for rate in dict.fromkeys(cell.rate for cell in cells):
        at_rate = [cell for cell in cells if cell.rate == rate]
        lines += [
            f"Rate {rate}: complete packets / complete images, in percent",
            "",
            "| range m | " + " | ".join(f"{width} × {height} px" for width, height in sizes) + " | the paper |",
            "|" + "---|" * (len(sizes) + 2),
        ]
        for range_m in dict.fromkeys(cell.range_m for cell in at_rate):
            row = [f"{100 * c.packets:.0f} / {100 * c.images:.0f}" for c in at_rate if c.range_m == range_m]
            lines.append(f"| {range_m} | " + " | ".join(row) + f" | {_paper_result(rate, range_m)} |")
        lines.append("")
    lines += ["| the paper, at rate 1 | measured | |", "|---|---|---|"]
    for claim in claims(cells):
        agrees = "as in the paper" if claim["agrees"] else "not as in the paper"
        lines.append(f"| {claim['paper']} | {100 * float(claim['measured']):.1f} % | {agrees} |")
    return "\n".join(lines)


def _paper_result(rate: int, range_m: int) -> str:
    if rate != RATES_USED[0]:
        return "not tested at sea"
    if range_m == BOUNDARY_M:
        return "boundary"
    return "most received" if range_m < BOUNDARY_M else "most lost"


def plot(cells: Sequence[Cell]) -> Figure:
    """Draw complete packets at each rate, and complete images at rate 1, over range.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    figure = new_figure(13.0, 4.6)
    panels = [(f"complete packets, rate {rate}", rate, _packets) for rate in RATES_USED]
    panels.append((f"complete images, rate {RATES_USED[0]}", RATES_USED[0], _images))
    axes = figure.subplots(1, len(panels), sharey=True)
    for axis, (title, rate, share) in zip(axes, panels, strict=True):
        _draw(axis, [cell for cell in cells if cell.rate == rate], share)
        axis.set_title(title)
        if rate == RATES_USED[0]:
            _draw_paper_result(axis, of_images=share is _images)
        else:
            axis.text(295, 62, "the paper: in the tank only,\n3 m, a few packets lost", ha="right", fontsize=8)
    axes[0].set_ylabel("received, % of sent")
    axes[0].legend(fontsize=8, loc="lower left", title="images", title_fontsize=8)
    count = cells[0].delivered.images
    figure.suptitle(f"Sea trial, simulated: preset sea-trial, {count} images a point", fontsize=11)
    return figure


def _packets(cell: Cell) -> float:
    return cell.packets


def _images(cell: Cell) -> float:
    return cell.images


def _draw(axis: Axes, cells: Sequence[Cell], share: Callable[[Cell], float]) -> None:
    sizes = list(dict.fromkeys((cell.width_px, cell.height_px) for cell in cells))
    for size, colour, marker in zip(sizes, _COLOURS, _MARKERS, strict=False):
        of_size = [cell for cell in cells if (cell.width_px, cell.height_px) == size]
        axis.plot(
            [cell.range_m for cell in of_size],
            [100 * share(cell) for cell in of_size],
            color=colour,
            marker=marker,
            markersize=3.5,
            linewidth=1.2,
            label=f"{size[0]} × {size[1]} px",
        )
    axis.set_xlim(0, 305)
    axis.set_ylim(-3, 103)
    axis.set_xlabel("range, m")
    axis.grid(alpha=0.3)


def _draw_paper_result(axis: Axes, *, of_images: bool) -> None:
    """Shade the region of the curve according to the paper."""
    axis.fill_between([0, BOUNDARY_M], 50, 103, color="#9ec9a5", alpha=0.35, linewidth=0)
    axis.fill_between([BOUNDARY_M, 305], -3, 50, color="#e3b0a8", alpha=0.35, linewidth=0)
    axis.axvline(BOUNDARY_M, color="#777777", linestyle="--", linewidth=1)
    if of_images:
        axis.plot([0, BOUNDARY_M], [100, 100], color="#222222", linestyle=":", linewidth=1.5)
        text = "the paper (dotted):\nbelow 130 m all images\nof 140 × 80 px"
    else:
        text = "the paper (shaded): most\nreceived below 130 m,\nmost lost beyond"
    axis.text(295, 62, text, ha="right", fontsize=8)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
