"""`python -m research.detection`: detection rate, false alarms, and the effect of each codec on the confidence."""

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from research.codecs.report import aligned
from research.common.command import (
    add_codec_arguments,
    command_parser,
    parse_budgets,
    report_progress,
    run_command,
    selected_codecs,
)
from research.common.plots import new_figure, save_figure
from research.detection.codec_effect import CodecEffect, codec_effects, contact_snippets
from research.detection.simulated import (
    FIRST_SEED,
    MAX_FILES,
    EvaluatedFile,
    ReliabilityBin,
    evaluate_file,
    mine_like_share,
    operating_point,
    pd_at,
    reliability,
    reliability_bins,
    roc,
    share_interval,
)
from research.detection.tiles import TileScore, tile_auc, tile_scores
from sonarpost.detection.settings import DetectorSettings
from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.seabed.objects import MINE_LIKE_KINDS
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind

OPERATING_CONFIDENCE: Final = DetectorSettings().confidence_threshold
PLAIN: Final = (SeabedKind.SAND, SeabedKind.MUD, SeabedKind.GRAVEL)
"""Seabeds of the figures `pd` and `false_alarms_per_file`; the others are listed separately."""
_MAX_FALSE_ALARMS: Final = 6.0
_CONTACTS_PER_FILE: Final = (4, 6, 8, 12)
"""Numbers of contacts at which the share of mine-like objects is measured."""


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser(
        "detection",
        description="Detect in simulated files of every seabed that were not used for training (1000 pings, four "
        "mine-like and six other objects each), score real tiles with and without a target, and with --codecs detect "
        "again after each codec. pd and false_alarms_per_file are for the default threshold on sand, mud and gravel "
        "together; a contact on one of the other objects is not a false alarm and is counted separately.",
    )
    parser.add_argument(
        "--files", type=int, default=3, metavar="N", help="simulated files of each seabed (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=FIRST_SEED, metavar="N", help="first seed (%(default)s)")
    parser.add_argument("--sdvd", type=Path, metavar="DIR", help="folder of the SDVD data set")
    parser.add_argument(
        "--contacts", type=int, default=24, metavar="N", help="contacts to detect again after coding (%(default)s)"
    )
    parser.add_argument("--plot", type=Path, metavar="DIR", help="write plots into this folder")
    add_codec_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    return parser


def run(args: argparse.Namespace) -> int:
    """Measure and report; return 0.

    Raises:
        SonarpostError: Invalid options, data set or codecs.
        OSError: A plot cannot be written.
    """
    for option, value, low, high in (
        ("--files", args.files, 1, MAX_FILES),
        ("--seed", args.seed, 0, 2**31 - 1),
        ("--contacts", args.contacts, 1, 10_000),
    ):
        if not low <= value <= high:
            raise ConfigError("detection", option, value, f"{low}..{high}")
    budgets = parse_budgets(args.budgets)
    tested = selected_codecs(args, all_packings=False) if args.codecs is not None else []
    tiles = () if args.sdvd is None else tile_scores(args.sdvd)
    files: list[EvaluatedFile] = []
    for kind in SeabedKind:
        files += [evaluate_file(kind, args.seed + number) for number in range(args.files)]
        report_progress(f"{kind}: detected")
    snippets = contact_snippets(files, args.contacts) if tested else []
    effects = [effect for codec in tested for effect in codec_effects(snippets, codec, budgets)]
    if args.plot is not None:
        plot_all(args.plot, files, tiles, effects)
    result = _result(files, tiles, effects)
    if not args.json:
        print(_text(files, tiles, effects))
    print(json.dumps(result, allow_nan=False))
    return 0


def _result(
    files: Sequence[EvaluatedFile], tiles: tuple[TileScore, ...], effects: Sequence[CodecEffect]
) -> dict[str, object]:
    plain = operating_point([f for f in files if f.seabed in PLAIN], OPERATING_CONFIDENCE)
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
        "mine_like_share": {str(n): round(mine_like_share(files, n), 4) for n in _CONTACTS_PER_FILE},
        "reliability": [
            {"contacts": b.contacts, "claimed": round(b.claimed, 3), "true": round(b.true_share, 3)}
            for b in reliability(files)
        ],
        "reliability_sdvd_test": [
            {"tiles": b.contacts, "claimed": round(b.claimed, 3), "true": round(b.true_share, 3)}
            for b in _tile_reliability(tiles)
        ],
        "codecs": [
            {
                "label": e.label,
                "budget": e.budget_bytes,
                "n": e.coded,
                "misses": e.misses,
                "before": _rounded(e.before),
                "after": _rounded(e.after),
                "kept": _rounded(e.kept),
            }
            for e in effects
        ],
    }


def _seabed_json(files: Sequence[EvaluatedFile]) -> dict[str, object]:
    point, (pd, low, high) = operating_point(files, OPERATING_CONFIDENCE), _pd_at_one_false_alarm(files)
    return {
        "pd": round(point.pd, 4),
        "false_alarms_per_file": round(point.false_alarms_per_file, 4),
        "others_per_file": round(point.others_per_file, 4),
        "pd_at_one_false_alarm": round(pd, 4),
        "interval_95": [round(low, 4), round(high, 4)],
    }


def _pd_at_one_false_alarm(files: Sequence[EvaluatedFile]) -> tuple[float, float, float]:
    """Return the probability of detection at one false alarm a file with its 95 % interval."""
    objects = sum(t.is_mine_like for f in files for t in f.truth)
    pd = pd_at(roc(files), 1.0)
    return pd, *share_interval(pd * objects, objects)


def _shape_pd(files: Sequence[EvaluatedFile], kind: str) -> float:
    """Return the probability of detection of a shape at the operating confidence on sand, mud and gravel."""
    plain = [f for f in files if f.seabed in PLAIN]
    objects = sum(t.kind == kind for f in plain for t in f.truth)
    hits = sum(
        c.is_first and c.target is not None and c.target.kind == kind and c.confidence >= OPERATING_CONFIDENCE
        for f in plain
        for c in f.contacts
    )
    return round(hits / objects, 4) if objects else 0.0


def _rounded(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 4)


def _text(files: Sequence[EvaluatedFile], tiles: tuple[TileScore, ...], effects: Sequence[CodecEffect]) -> str:
    rows = [("seabed", "files", "Pd", "false alarms/file", "others/file", "Pd at 1 false alarm/file", "95 %")]
    for kind in SeabedKind:
        of_kind = [f for f in files if f.seabed is kind]
        point = operating_point(of_kind, OPERATING_CONFIDENCE)
        figures = (f"{point.pd:.3f}", f"{point.false_alarms_per_file:.2f}", f"{point.others_per_file:.2f}")
        pd, low, high = _pd_at_one_false_alarm(of_kind)
        rows.append((kind.value, str(len(of_kind)), *figures, f"{pd:.3f}", f"{low:.2f}..{high:.2f}"))
    parts = [aligned(rows)]
    parts.append(
        aligned(
            [("contacts", "confidence / 2", "share of mine-like objects")]
            + [(str(b.contacts), f"{b.claimed:.2f}", f"{b.true_share:.2f}") for b in reliability(files)]
        )
    )
    shares = ", ".join(f"{mine_like_share(files, n):.3f} of {n}" for n in _CONTACTS_PER_FILE)
    parts.append(f"share of mine-like objects among the most confident contacts a file: {shares}")
    for split in sorted({t.split for t in tiles}):
        area, ci = tile_auc(tuple(t for t in tiles if t.split == split))
        parts.append(f"SDVD {split}: AUC {area:.3f}" + ("" if ci is None else f" (95 %: {ci[0]:.3f}..{ci[1]:.3f})"))
    if effects:
        table = [("codec", "budget", "n", "miss", "before", "after", "still 1.0")]
        for e in effects:
            budget = "own" if e.budget_bytes is None else str(e.budget_bytes)
            figures = (f"{e.before:.2f}", f"{e.after:.2f}", f"{e.kept:.2f}")
            table.append((e.label, budget, str(e.coded), str(e.misses), *figures))
        parts.append(aligned(table))
    return "\n\n".join(parts)


def plot_all(
    folder: Path, files: Sequence[EvaluatedFile], tiles: Sequence[TileScore], effects: Sequence[CodecEffect]
) -> None:
    """Write roc.png and reliability.png, and tiles.png and codecs.png if there are data.

    Raises:
        ConfigError: matplotlib is not installed.
        OSError: A file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _plot_roc(folder / "roc.png", files)
    _plot_reliability(folder / "reliability.png", files, tiles)
    if tiles:
        _plot_tiles(folder / "tiles.png", tiles)
    if effects:
        _plot_codecs(folder / "codecs.png", effects)


def _plot_roc(path: Path, files: Sequence[EvaluatedFile]) -> None:
    """Draw probability of detection over false alarms a file, by seabed, and by shape on all seabeds."""
    figure = new_figure(10, 4.2)
    left, right = figure.subplots(1, 2)
    for kind in SeabedKind:
        left.step(*roc([f for f in files if f.seabed is kind]), where="post", label=kind.value)
    for shape in MINE_LIKE_KINDS:
        right.step(*roc(files, shape.value), where="post", label=shape.value.replace("_", " "))
    for axis, title in ((left, "by seabed"), (right, "by shape, all seabeds")):
        axis.set_xlim(0, _MAX_FALSE_ALARMS)
        axis.set_ylim(0, 1.02)
        axis.set_xlabel("false alarms a file of 1000 pings")
        axis.set_ylabel("probability of detection, mine-like objects")
        axis.set_title(title)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8, loc="lower right")
    save_figure(figure, path)


def _tile_reliability(tiles: Sequence[TileScore]) -> tuple[ReliabilityBin, ...]:
    """Return the reliability of the tiles that took no part in the training, in five bins."""
    return reliability_bins([(t.confidence / 2, t.is_target) for t in tiles if t.split == "test"], 5)


def _plot_reliability(path: Path, files: Sequence[EvaluatedFile], tiles: Sequence[TileScore]) -> None:
    """Draw the true share of mine-like objects over the claimed share."""
    figure = new_figure(5, 4.2)
    axis = figure.subplots()
    bins = reliability(files)
    axis.plot([0, 1], [0, 1], color="grey", linewidth=1)
    axis.plot([b.claimed for b in bins], [b.true_share for b in bins], "o-", label="contacts of simulated surveys")
    of_tiles = _tile_reliability(tiles)
    if of_tiles:
        axis.plot(
            [b.claimed for b in of_tiles], [b.true_share for b in of_tiles], "s--", label="SDVD tiles, test split"
        )
        axis.legend(loc="upper left", fontsize=8)
    for b in (*bins, *of_tiles):
        axis.annotate(
            str(b.contacts), (b.claimed, b.true_share), fontsize=8, xytext=(4, -10), textcoords="offset points"
        )
    axis.set_xlabel("confidence / 2")
    axis.set_ylabel("share of contacts that are mine-like objects")
    axis.grid(alpha=0.3)
    save_figure(figure, path)


def _plot_tiles(path: Path, tiles: Sequence[TileScore]) -> None:
    """Draw the ROC of tiles with a target against tiles without, for each split."""
    figure = new_figure(5, 4.2)
    axis = figure.subplots()
    for split in sorted({t.split for t in tiles}):
        of_split = tuple(t for t in tiles if t.split == split)
        area, _ = tile_auc(of_split)
        ordered = sorted(of_split, key=lambda t: -t.confidence)
        hits = np.cumsum([0, *(t.is_target for t in ordered)])
        alarms = np.cumsum([0, *(not t.is_target for t in ordered)])
        axis.plot(alarms / alarms[-1], hits / hits[-1], label=f"{split}: AUC {area:.2f}, {len(of_split)} tiles")
    axis.plot([0, 1], [0, 1], color="grey", linewidth=1)
    axis.set_xlabel("share of clutter tiles")
    axis.set_ylabel("share of target tiles")
    axis.grid(alpha=0.3)
    axis.legend(loc="lower right")
    save_figure(figure, path)


def _plot_codecs(path: Path, effects: Sequence[CodecEffect]) -> None:
    """Draw the mean confidence after each codec over the budget, with that of the originals."""
    figure = new_figure(6, 4.2)
    axis = figure.subplots()
    for label in dict.fromkeys(e.label for e in effects):
        line = [(e.budget_bytes, e.after) for e in effects if e.label == label and e.budget_bytes is not None]
        if line:
            axis.plot(*zip(*line, strict=True), "o-", label=label)
    axis.axhline(max(e.before for e in effects if e.coded), color="grey", linewidth=1, label="originals")
    axis.set_xscale("log", base=2)
    axis.set_xlabel("budget in bytes")
    axis.set_ylabel("mean confidence after decoding")
    axis.set_ylim(0, 2)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    save_figure(figure, path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
