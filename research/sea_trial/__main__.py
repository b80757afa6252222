"""`python -m research.sea_trial`: Fig. 6 of the paper again, what arrives of pictures over 2 to 300 m."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np

from research.codecs.__main__ import say
from research.common.command import command_parser, run_command
from research.common.images import BenchPicture, simulated_pictures
from research.sea_trial.rig import Delivered, Sample, cross
from sonarpost.codec.vq.codebook import load_default
from sonarpost.codec.vq.codec import IndexPacking, VqCodec
from sonarpost.errors import ConfigError
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.simulation.channel.parameters import build_parameters

BOUNDARY_M: Final = 130
"""Where the paper's trial turns."""
RATES_USED: Final = (1, 4)
SIZES_PX: Final = ((140, 80), (80, 80), (40, 40))
"""Width and height; the first is the paper's, of which everything arrived."""
RANGES_M: Final = (2, 30, 50, 60, 70, 80, 90, 100, 110, 120, 130, 135, 140, 145, 150, 160, 180, 200, 250, 300)

_PRESET: Final = "sea-trial"
_TILE_PX: Final = 20
_MAX_PICTURES: Final = 1000


@dataclass(frozen=True, slots=True)
class Cell:
    """One range, rate and picture size.

    Attributes:
        rate: Of the modem.
        width_px, height_px: Of the pictures.
        range_m: Distance.
        delivered: What arrived.
    """

    rate: int
    width_px: int
    height_px: int
    range_m: int
    delivered: Delivered

    @property
    def packets(self) -> float:
        """Share of packets that came whole."""
        return self.delivered.whole_packets / self.delivered.packets

    @property
    def pictures(self) -> float:
        """Share of pictures that came whole."""
        return self.delivered.whole_pictures / self.delivered.pictures


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser(
        "sea_trial",
        description="Send pictures from a driver to another over emulated modems through the water of the preset "
        "sea-trial, at ranges of 2 to 300 m, sizes of the paper's kind and rates 1 and 4; count packets and pictures "
        "that arrive, and compare with what the paper reports.",
    )
    parser.add_argument(
        "--pictures", type=int, default=40, metavar="N", help="for each range, size and rate (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of pictures and water (default: 0)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw it (needs matplotlib)")
    return parser


def run(args: argparse.Namespace) -> int:
    """Measure and report; return 0.

    Raises:
        ConfigError: Wrong options; matplotlib absent where a plot is asked for.
        OSError: The plot cannot be written.
    """
    for option, value, low, high in (
        ("--pictures", args.pictures, 1, _MAX_PICTURES),
        ("--seed", args.seed, 0, 1_000_000),
    ):
        if not low <= value <= high:
            raise ConfigError("sea-trial", option, value, f"{low}..{high}")
    say(f"simulating {args.pictures} pictures")
    cells = measure(args.pictures, args.seed, RANGES_M, SIZES_PX)
    if args.plot is not None:
        from research.common.plots import save_figure  # noqa: PLC0415 (needed for a plot only)
        from research.sea_trial.plot import plot  # noqa: PLC0415

        save_figure(plot(cells), args.plot)
    if args.json:
        results = [_row(cell) for cell in cells]
        print(json.dumps({"water": _PRESET, "seed": args.seed, "results": results, "claims": claims(cells)}))
    else:
        print(table(cells))
    return 0


def measure(pictures: int, seed: int, ranges_m: Sequence[int], sizes_px: Sequence[tuple[int, int]]) -> list[Cell]:
    """Send pictures over every range, in every size, at both rates.

    Args:
        pictures: How many for each.
        seed: Of pictures and water. Every cell has water of its own.
        ranges_m: Distances.
        sizes_px: (width, height), 140 px at most.
    """
    water = build_parameters({"preset": _PRESET}, "bench sea-trial")
    drawn = simulated_pictures(pictures, seed, max(max(size) for size in SIZES_PX)).pictures
    codec = VqCodec(load_default(_TILE_PX).tiles, IndexPacking.ASCII5)
    cells = []
    for width_px, height_px in sizes_px:
        samples = _samples(drawn, codec, width_px, height_px)
        for rate in RATES_USED:
            say(f"{width_px} x {height_px} px at rate {rate}")
            for range_m in ranges_m:
                own = water.model_copy(update={"seed": _cell_seed(seed, rate, width_px, height_px, range_m)})
                cells.append(Cell(rate, width_px, height_px, range_m, cross(own, range_m, rate, samples)))
    return cells


def _cell_seed(*parts: int) -> int:
    return int(np.random.SeedSequence(parts).generate_state(1)[0])


def _samples(drawn: Iterable[BenchPicture], codec: VqCodec, width_px: int, height_px: int) -> list[Sample]:
    """Cut the middle of each picture and encode it."""
    samples = []
    for number, picture in enumerate(drawn):
        top, left = (picture.pixels.shape[0] - height_px) // 2, (picture.pixels.shape[1] - width_px) // 2
        cut = np.ascontiguousarray(picture.pixels[top : top + height_px, left : left + width_px])
        contact = ContactSummary(
            height_px=height_px, width_px=width_px, lat_deg=44.69, lon_deg=-63.64, time_utc_s=1.4e9 + number
        )
        samples.append(Sample(codec.encode(cut), contact))
    return samples


def claims(cells: Sequence[Cell]) -> list[dict[str, str | float | bool]]:
    """Return what the paper says of rate 1, what was measured, and whether it agrees.

    The paper gives words, no numbers, apart from the 100 %. "Most" is taken as more than half: below the boundary at
    every range and size, beyond it of all packets together.
    """
    used = [cell for cell in cells if cell.rate == RATES_USED[0]]
    near = [cell for cell in used if cell.range_m < BOUNDARY_M]
    far = [cell for cell in used if cell.range_m > BOUNDARY_M]
    largest = [cell for cell in near if (cell.width_px, cell.height_px) == SIZES_PX[0]]
    smaller = [cell for cell in near if cell not in largest]
    found: list[dict[str, str | float | bool]] = []

    def say_of(claim: str, share: float, *, agrees: bool) -> None:
        found.append({"paper": claim, "measured": round(share, 4), "agrees": agrees})

    if near:
        share = _share([(c.delivered.whole_packets, c.delivered.packets) for c in near])
        say_of("below 130 m most packets are received", share, agrees=min(c.packets for c in near) > 0.5)
    if largest:
        share = _share([(c.delivered.whole_pictures, c.delivered.pictures) for c in largest])
        say_of("below 130 m all pictures of 140 x 80 px are received", share, agrees=share == 1.0)
    if smaller:
        share = _share([(c.delivered.second_lost, c.delivered.pictures) for c in smaller])
        only_these = not any(c.delivered.second_lost for c in largest)
        say_of("the second packet is missing of some smaller pictures, only", share, agrees=only_these and share > 0)
    if far:
        share = 1 - _share([(c.delivered.whole_packets, c.delivered.packets) for c in far])
        say_of("beyond 130 m most packets are lost", share, agrees=share > 0.5)
    return found


def _share(counts: Sequence[tuple[int, int]]) -> float:
    return sum(part for part, _ in counts) / sum(whole for _, whole in counts)


def _row(cell: Cell) -> dict[str, int | float]:
    place = {"rate": cell.rate, "width_px": cell.width_px, "height_px": cell.height_px, "range_m": cell.range_m}
    return place | asdict(cell.delivered)


def table(cells: Sequence[Cell]) -> str:
    """Return a table of each rate, and the paper's words beside what was measured, as Markdown."""
    lines = []
    sizes = list(dict.fromkeys((cell.width_px, cell.height_px) for cell in cells))
    for rate in dict.fromkeys(cell.rate for cell in cells):
        mine = [cell for cell in cells if cell.rate == rate]
        lines += [
            f"Rate {rate}: packets that came whole / pictures that came whole, in percent",
            "",
            "| range m | " + " | ".join(f"{width} x {height} px" for width, height in sizes) + " | the paper |",
            "|" + "---|" * (len(sizes) + 2),
        ]
        for range_m in dict.fromkeys(cell.range_m for cell in mine):
            row = [f"{100 * c.packets:.0f} / {100 * c.pictures:.0f}" for c in mine if c.range_m == range_m]
            lines.append(f"| {range_m} | " + " | ".join(row) + f" | {_words(rate, range_m)} |")
        lines.append("")
    lines += ["| the paper, at rate 1 | measured | |", "|---|---|---|"]
    for claim in claims(cells):
        agrees = "as in the paper" if claim["agrees"] else "not as in the paper"
        lines.append(f"| {claim['paper']} | {100 * float(claim['measured']):.1f} % | {agrees} |")
    return "\n".join(lines)


def _words(rate: int, range_m: int) -> str:
    if rate != RATES_USED[0]:
        return "not tried at sea"
    if range_m == BOUNDARY_M:
        return "turns here"
    return "most received" if range_m < BOUNDARY_M else "most lost"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
