"""`python -m research.despeckling`: the network of emb against classical filters, alone and as the input of emb."""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from research.codecs.report import aligned
from research.common.command import command_parser, parse_budgets, report_progress, run_command
from research.common.images import sdvd_crops
from research.common.plots import SheetCell, write_sheet
from research.common.scene_measures import clipped_psnr_db
from research.common.speckle import SpecklePair, speckle_pairs
from research.despeckling.filters import FILTERS
from research.despeckling.measurement import (
    FilterResult,
    FilterUnderTest,
    RecordingRow,
    coded_images,
    create_filters,
    measure_pairs,
    measure_recordings,
)
from sonarpost.cli.shared import in_new_folder
from sonarpost.errors import ConfigError

DEFAULT_BUDGETS: Final = "22,64,128,256"
_PAIRS: Final = 60
_SHEET_PAIRS: Final = 6


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser(
        "despeckling",
        description="Despeckle simulated snippets with the network of emb and with classical filters, code them with "
        "emb, and compare the results with the same scenes without speckle.",
    )
    parser.add_argument("--count", type=int, default=_PAIRS, metavar="N", help="simulated pairs (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the pairs (default: 0)")
    parser.add_argument(
        "--budgets", default=DEFAULT_BUDGETS, metavar="B,B,…", help="maximum bytes of a stream (default: %(default)s)"
    )
    parser.add_argument(
        "--filters", metavar="NAME,…", help=f"classical filters, or none (default: {','.join(FILTERS)})"
    )
    parser.add_argument("--sdvd", type=Path, metavar="DIR", help="also measure crops of the SDVD data set's test split")
    parser.add_argument("--sheet", type=Path, metavar="FILE.png", help="draw simulated snippets as decoded")
    return parser


def run(args: argparse.Namespace) -> int:
    """Measure and report; return 0.

    Raises:
        SonarpostError: Invalid options or data set.
        OSError: A file cannot be written.
    """
    budgets = parse_budgets(args.budgets)
    filters = create_filters(filter_names(args.filters))
    if args.sheet is not None:
        in_new_folder(args.sheet)
    crops = () if args.sdvd is None else sdvd_crops(args.sdvd).images
    pairs = speckle_pairs(args.count, args.seed)
    if args.sheet is not None:
        title = f"Simulated snippets, {', '.join(str(budget) for budget in budgets)} B"
        write_sheet(args.sheet, title, sheet_rows(filters, pairs, budgets), is_grey=True)
    results = []
    for each in filters:
        results.append(measure_pairs(each, pairs, budgets))
        report_progress(f"{each.name}: {len(pairs)} pairs")
    recordings = []
    for each in filters if crops else ():
        if each.function is not None:
            recordings.append(measure_recordings(each, crops, budgets))
            report_progress(f"{each.name}: {len(crops)} crops")
    print(text(results, recordings, budgets, len(pairs)))
    return 0


def filter_names(names: str | None) -> tuple[str, ...]:
    """Return the names of classical filters, separated by commas; all for None, none for `none`.

    Raises:
        ConfigError: A name is unknown.
    """
    if names is None:
        return tuple(FILTERS)
    if names == "none":
        return ()
    found = tuple(dict.fromkeys(name.strip() for name in names.split(",")))
    for name in found:
        if name not in FILTERS:
            raise ConfigError("research", "--filters", name, f"none, or some of {', '.join(FILTERS)}")
    return found


def text(
    results: Sequence[FilterResult],
    recordings: Sequence[Sequence[RecordingRow]],
    budgets: Sequence[int],
    pairs: int,
) -> str:
    """Return the report as text."""
    parts = [
        f"{pairs} simulated pairs",
        "PSNR in dB against the scene without speckle, of the filtered image and of the image that emb decodes\n"
        + _table(results, budgets, "clean_psnr", 2),
        "Isolated dots in an image\n" + _table(results, budgets, "dots", 1),
        "Objects against the scene without speckle: " + _OBJECTS + _object_table(results, budgets, ""),
        "Objects against the image with speckle: " + _OBJECTS + _object_table(results, budgets, "_original"),
    ]
    if recordings:
        parts.append(
            "Isolated dots in a crop of recordings, with / without a target\n" + _recording_table(recordings, budgets)
        )
    return "\n\n".join(parts)


_OBJECTS = "median relative error of the highlight / error of the shadow in px / relative error of the height\n"


def _table(results: Sequence[FilterResult], budgets: Sequence[int], name: str, digits: int) -> str:
    head = ("filter", "ms", "filtered", *(f"{budget} B" for budget in budgets))
    body = [
        (result.name, _fixed(result.filter_ms, 1), *(_fixed(row.figures[name], digits) for row in result.rows))
        for result in results
    ]
    return aligned([head, *body])


def _object_table(results: Sequence[FilterResult], budgets: Sequence[int], suffix: str) -> str:
    def cell(figures: dict[str, float]) -> str:
        values = (
            _fixed(figures[f"highlight_error{suffix}"], 3),
            _fixed(figures[f"shadow_error{suffix}_px"], 1),
            _fixed(figures[f"height_error{suffix}"], 3),
        )
        return " / ".join(values)

    head = ("filter", "filtered", *(f"{budget} B" for budget in budgets))
    return aligned([head, *((result.name, *(cell(row.figures) for row in result.rows)) for result in results)])


def _recording_table(recordings: Sequence[Sequence[RecordingRow]], budgets: Sequence[int]) -> str:
    def cell(row: RecordingRow) -> str:
        return f"{_fixed(row.dots_with_target, 1)} / {_fixed(row.dots_without_target, 1)}"

    head = ("filter", "filtered", *(f"{budget} B" for budget in budgets))
    return aligned([head, *((rows[0].name, *(cell(row) for row in rows)) for rows in recordings)])


def _fixed(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def sheet_rows(
    filters: Sequence[FilterUnderTest], pairs: Sequence[SpecklePair], budgets: Sequence[int]
) -> list[list[SheetCell]]:
    """Return the cells of a sheet, one column a snippet.

    Rows: the scene without speckle, the original, then for each budget emb without and with despeckling.
    """
    chosen = sheet_pairs(pairs)
    rows = [
        [SheetCell(pair.clean, "without speckle", str(pair.seabed)) for pair in chosen],
        [SheetCell(pair.noisy, "original", f"{clipped_psnr_db(pair.clean, pair.noisy):.2f} dB") for pair in chosen],
    ]
    by_name = {each.name: each for each in filters}
    for budget in budgets:
        for name in ("none", "network 1"):
            row = []
            for pair in chosen:
                (coded,) = coded_images(by_name[name], pair.noisy, [budget])
                caption = f"{budget} B, {'despeckled' if name != 'none' else 'strength 0'}"
                detail = "" if coded is None else f"{clipped_psnr_db(pair.clean, coded):.2f} dB"
                row.append(SheetCell(coded, caption, detail))
            rows.append(row)
    return rows


def sheet_pairs(pairs: Sequence[SpecklePair]) -> list[SpecklePair]:
    """Return up to six pairs: the first one of each kind of seabed, with an object if there is one."""
    found: dict[str, SpecklePair] = {}
    for pair in (*(p for p in pairs if p.place is not None), *pairs):
        found.setdefault(pair.seabed, pair)
    return [found[kind] for kind in sorted(found)][:_SHEET_PAIRS]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
