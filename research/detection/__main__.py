"""`python -m research.detection`: detection rate, false alarms, and the effect of each codec on the confidence."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from research.codecs.__main__ import add_codec_arguments, chosen_subjects, parse_budgets, say
from research.codecs.report import aligned
from research.common.command import command_parser, run_command
from research.detection.codec_effect import CodecEffect, effects, shots
from research.detection.plots import plot_all
from research.detection.simulated import (
    FIRST_SEED,
    MOST_FILES,
    JudgedFile,
    judged_file,
    operating,
    pd_at,
    reliability,
    roc,
)
from research.detection.tiles import TileScore, tile_auc, tile_scores
from sonarpost.errors import ConfigError
from sonarpost.simulation.seabed.targets import MINE_LIKE_KINDS
from sonarpost.simulation.seabed.terrain import SeabedKind

OPERATING_POINT: Final = 1.0
PLAIN: Final = (SeabedKind.SAND, SeabedKind.MUD, SeabedKind.GRAVEL)
"""The seabeds that the first two figures of the last line are about; the others are told beside them."""


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser(
        "detection",
        description="Detect in simulated files of every seabed that nothing was fitted to (1000 pings, four mine-like "
        "and six other objects each), score real tiles with and without a target, and with --codecs judge contacts' "
        "pictures again after each codec. pd and false_alarms_per_file are those at confidence 1.0 on sand, mud and "
        "gravel together; a contact of one of the other objects is no false alarm and is counted apart.",
    )
    parser.add_argument(
        "--files", type=int, default=3, metavar="N", help="simulated files of each seabed (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=FIRST_SEED, metavar="N", help="the first file's (%(default)s)")
    parser.add_argument("--sdvd", type=Path, metavar="DIR", help="the SDVD data set's folder")
    parser.add_argument(
        "--pictures", type=int, default=24, metavar="N", help="contacts to judge before and after codecs (%(default)s)"
    )
    parser.add_argument("--plot", type=Path, metavar="DIR", help="draw into this folder")
    add_codec_arguments(parser)
    return parser


def run(args: argparse.Namespace) -> int:
    """Measure and report.

    Raises:
        SonarpostError: Wrong options, data set or codecs.
        OSError: A plot cannot be written.
    """
    if not 1 <= args.files <= MOST_FILES:
        raise ConfigError("detect", "--files", args.files, f"1..{MOST_FILES}")
    if not 0 <= args.seed < 2**31:
        raise ConfigError("detect", "--seed", args.seed, "0..2147483647")
    if not 1 <= args.pictures <= 10_000:
        raise ConfigError("detect", "--pictures", args.pictures, "1..10000")
    budgets = parse_budgets(args.budgets)
    subjects = chosen_subjects(args, all_packings=False) if args.codecs is not None else []
    files: list[JudgedFile] = []
    for kind in SeabedKind:
        files += [judged_file(kind, args.seed + number) for number in range(args.files)]
        say(f"{kind}: detected")
    tiles = () if args.sdvd is None else tile_scores(args.sdvd)
    pictures = shots(files, args.pictures) if subjects else []
    after = [effect for subject in subjects for effect in effects(pictures, subject, budgets)]
    if args.plot is not None:
        plot_all(args.plot, files, tiles, after)
    result = _result(files, tiles, after)
    if not args.json:
        print(_text(files, tiles, after))
    print(json.dumps(result, allow_nan=False))
    return 0


def _result(
    files: Sequence[JudgedFile], tiles: tuple[TileScore, ...], after: Sequence[CodecEffect]
) -> dict[str, object]:
    plain = operating([f for f in files if f.seabed in PLAIN], OPERATING_POINT)
    splits = {s: tile_auc(tuple(t for t in tiles if t.split == s)) for s in sorted({t.split for t in tiles})}
    return {
        "pd": round(plain.pd, 4),
        "false_alarms_per_file": round(plain.false_alarms_per_file, 4),
        "auc_sdvd": round(tile_auc(tiles)[0], 4) if tiles else None,
        "seconds_per_file": round(float(np.median([f.seconds for f in files])), 3),
        "files": len(files),
        "auc_sdvd_splits": {s: {"auc": round(a, 4), "ci": ci} for s, (a, ci) in splits.items()},
        "seabeds": {kind.value: _seabed_json([f for f in files if f.seabed is kind]) for kind in SeabedKind},
        "shapes": {kind.value: _shape_pd(files, kind.value) for kind in MINE_LIKE_KINDS},
        "reliability": [
            {"contacts": b.contacts, "claimed": round(b.claimed, 3), "true": round(b.true_share, 3)}
            for b in reliability(files)
        ],
        "codecs": [
            {
                "label": e.label,
                "budget": e.budget_bytes,
                "n": e.pictures,
                "misses": e.misses,
                "before": _known(e.before),
                "after": _known(e.after),
                "kept": _known(e.kept),
            }
            for e in after
        ],
    }


def _seabed_json(files: Sequence[JudgedFile]) -> dict[str, float]:
    at = operating(files, OPERATING_POINT)
    return {
        "pd": round(at.pd, 4),
        "false_alarms_per_file": round(at.false_alarms_per_file, 4),
        "others_per_file": round(at.others_per_file, 4),
        "pd_at_one_false_alarm": round(pd_at(roc(files), 1.0), 4),
    }


def _shape_pd(files: Sequence[JudgedFile], kind: str) -> float:
    """Return the share of a shape's objects found at the operating point, on sand, mud and gravel."""
    plain = [f for f in files if f.seabed in PLAIN]
    there = sum(t.kind == kind for f in plain for t in f.truth)
    hits = sum(
        c.is_first and c.thing is not None and c.thing.kind == kind and c.confidence >= OPERATING_POINT
        for f in plain
        for c in f.contacts
    )
    return round(hits / there, 4) if there else 0.0


def _known(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 4)


def _text(files: Sequence[JudgedFile], tiles: tuple[TileScore, ...], after: Sequence[CodecEffect]) -> str:
    rows = [("seabed", "files", "Pd", "false alarms/file", "others/file", "Pd at 1 false alarm/file")]
    for kind in SeabedKind:
        of_kind = [f for f in files if f.seabed is kind]
        at = operating(of_kind, OPERATING_POINT)
        figures = (f"{at.pd:.3f}", f"{at.false_alarms_per_file:.2f}", f"{at.others_per_file:.2f}")
        rows.append((kind.value, str(len(of_kind)), *figures, f"{pd_at(roc(of_kind), 1.0):.3f}"))
    parts = [aligned(rows)]
    parts.append(
        aligned(
            [("contacts", "confidence / 2", "share of objects")]
            + [(str(b.contacts), f"{b.claimed:.2f}", f"{b.true_share:.2f}") for b in reliability(files)]
        )
    )
    for split in sorted({t.split for t in tiles}):
        area, ci = tile_auc(tuple(t for t in tiles if t.split == split))
        parts.append(f"SDVD {split}: AUC {area:.3f}" + ("" if ci is None else f" (95 %: {ci[0]:.3f}..{ci[1]:.3f})"))
    if after:
        table = [("codec", "budget", "n", "miss", "before", "after", "still 1.0")]
        table += [
            (
                e.label,
                "own" if e.budget_bytes is None else str(e.budget_bytes),
                str(e.pictures),
                str(e.misses),
                f"{e.before:.2f}",
                f"{e.after:.2f}",
                f"{e.kept:.2f}",
            )
            for e in after
        ]
        parts.append(aligned(table))
    return "\n\n".join(parts)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
