"""`sonarpost bench recognition`: what a judge trained on originals still recognises in decoded pictures."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from sonarpost.cli.bench.codecs import add_codec_arguments, chosen_subjects, parse_budgets, say
from sonarpost.cli.bench.grain import with_grain
from sonarpost.cli.bench.judge import Judge
from sonarpost.cli.bench.measure import Subject, code
from sonarpost.cli.bench.pictures import BenchPicture, simulated_pictures
from sonarpost.cli.bench.report import aligned
from sonarpost.cli.bench.sdvd import sdvd_crops
from sonarpost.cli.bench.statistics import Interval, Values, auc, bootstrap_weights, interval
from sonarpost.codec.interface import Image
from sonarpost.errors import ConfigError

LEAST_AUC: Final = 0.93
"""A judge that tells originals apart worse than this is none."""
EXIT_POOR_JUDGE: Final = 1
_SIMULATED: Final = 240
_SIMULATED_SEED: Final = 1  # not that of `bench codecs`


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `recognition`."""
    parser = actions.add_parser(
        "recognition",
        help="targets against clutter, as a judge trained on originals sees decoded pictures",
        description="Train a judge on original pictures (SDVD's train split and simulated ones) and let it tell "
        "targets from clutter in decoded pictures of the test split. No survey line is judged by a judge that was "
        "trained on it. Differences below about .03 are chance.",
    )
    parser.add_argument("--sdvd", type=Path, required=True, metavar="DIR", help="the SDVD data set's folder")
    parser.add_argument("--crop", type=int, default=80, metavar="PX", help="side of the crops (default: 80)")
    add_codec_arguments(parser)
    parser.add_argument(
        "--simulated", type=int, default=_SIMULATED, metavar="N", help="simulated training pictures (%(default)s)"
    )
    parser.add_argument(
        "--least-auc", type=float, default=LEAST_AUC, metavar="AUC", help="refuse a judge below this (%(default)s)"
    )
    parser.set_defaults(run=run)


@dataclass(frozen=True)
class Verdict:
    """The judge's success on one codec at one budget.

    Attributes:
        label: Codec and variant; "original" for the originals.
        codec: Name in the registry; empty for the originals.
        budget_bytes: Most bytes of a stream; None for a natural size and for the originals.
        grain: Whether the codec's synthetic grain was on.
        mean_bytes: Mean real length of a stream; NaN for the originals.
        pictures: How many pictures were judged.
        misses: How many the codec missed.
        area: Area under the ROC curve; None without both targets and others.
        ci: Its 95 % bootstrap interval over source tiles.
    """

    label: str
    codec: str
    budget_bytes: int | None
    grain: bool
    mean_bytes: float
    pictures: int
    misses: int
    area: float | None
    ci: Interval | None


def run(args: argparse.Namespace) -> int:
    """Train, judge and report; return 0, or 1 if the judge is too poor to judge codecs.

    Raises:
        SonarpostError: Wrong options, data set or codecs.
    """
    budgets = parse_budgets(args.budgets)
    if not 0.0 <= args.least_auc <= 1.0:
        raise ConfigError("bench", "--least-auc", args.least_auc, "0..1")
    tested = chosen_subjects(args, all_packings=False)
    training = sdvd_crops(args.sdvd, "train", args.crop).pictures
    test = sdvd_crops(args.sdvd, "test", args.crop).pictures
    simulated = simulated_pictures(args.simulated, _SIMULATED_SEED, args.crop).pictures if args.simulated else ()
    say(f"training on {len(training)} real and {len(simulated)} simulated pictures")
    judge = Judge(training, simulated, [picture.group for picture in test])
    weights = bootstrap_weights([picture.source for picture in test])
    originals = [picture.pixels for picture in test]
    first = _verdict(judge, test, originals, weights, _Coding("original", "", None, grain=False))
    verdicts = [first]
    for subject in tested:
        verdicts += _verdicts_of(judge, subject, test, budgets, weights)
        say(f"{subject.label}: judged")
    print(_json_line(verdicts, len(test)) if args.json else _table(verdicts))
    if first.area is None or first.area < args.least_auc:
        say(f"the judge's AUC on originals is {first.area}, below {args.least_auc}: it says nothing about codecs")
        return EXIT_POOR_JUDGE
    return 0


@dataclass(frozen=True)
class _Coding:
    label: str
    codec: str
    budget_bytes: int | None
    grain: bool


def _verdicts_of(
    judge: Judge, subject: Subject, test: Sequence[BenchPicture], budgets: Sequence[int], weights: Values
) -> list[Verdict]:
    coded = [code(subject, picture.pixels, budgets) for picture in test]
    verdicts = []
    for place in range(len(coded[0])):
        results = [each[place] for each in coded]
        budget = None if subject.is_natural else budgets[place]
        plain: list[Image | None] = [None if isinstance(r, str) else r.rebuilt for r in results]
        lengths = np.array([math.nan if isinstance(r, str) else float(len(r.stream)) for r in results])
        coding = _Coding(subject.label, subject.codec.name, budget, grain=False)
        verdicts.append(_verdict(judge, test, plain, weights, coding, lengths))
        grainy = [None if isinstance(r, str) else with_grain(subject.codec, r.stream) for r in results]
        if any(picture is not None for picture in grainy):
            coding = _Coding(subject.label, subject.codec.name, budget, grain=True)
            verdicts.append(_verdict(judge, test, grainy, weights, coding, lengths))
    return verdicts


def _verdict(
    judge: Judge,
    test: Sequence[BenchPicture],
    pictures: Sequence[Image | None],
    weights: Values,
    coding: _Coding,
    lengths: Values | None = None,
) -> Verdict:
    shown = np.array([picture is not None for picture in pictures])
    is_target = np.array([bool(picture.is_target) for picture in test])[shown]
    area, ci = None, None
    if is_target.any() and not is_target.all():
        groups = [picture.group for picture, there in zip(test, shown, strict=True) if there]
        scores = judge.scores([picture for picture in pictures if picture is not None], groups)
        area = float(auc(scores, is_target)[0])
        ci = interval(auc(scores, is_target, weights[:, shown]))
    mean_bytes = math.nan if lengths is None or not shown.any() else float(lengths[shown].mean())
    count = int(np.count_nonzero(shown))
    return Verdict(
        coding.label,
        coding.codec,
        coding.budget_bytes,
        coding.grain,
        mean_bytes,
        count,
        len(test) - count,
        area,
        ci,
    )


def _json_line(verdicts: Sequence[Verdict], images: int) -> str:
    judge, *others = verdicts
    results = [
        {
            "codec": v.codec,
            "label": v.label,
            "budget": v.budget_bytes,
            "grain": v.grain,
            "bytes": None if math.isnan(v.mean_bytes) else round(v.mean_bytes, 2),
            "n": v.pictures,
            "misses": v.misses,
            "auc": None if v.area is None else round(v.area, 4),
            "ci": None if v.ci is None else [round(v.ci[0], 4), round(v.ci[1], 4)],
        }
        for v in others
    ]
    original = {"auc": judge.area, "ci": None if judge.ci is None else list(judge.ci)}
    return json.dumps({"images": images, "judge": original, "results": results}, allow_nan=False)


def _table(verdicts: Sequence[Verdict]) -> str:
    head = ("codec", "budget", "grain", "n", "miss", "bytes", "AUC", "95 %")
    return aligned([head, *(_table_row(verdict) for verdict in verdicts)])


def _table_row(v: Verdict) -> tuple[str, ...]:
    return (
        v.label,
        "own" if v.budget_bytes is None else str(v.budget_bytes),
        "yes" if v.grain else "no",
        str(v.pictures),
        str(v.misses),
        "-" if math.isnan(v.mean_bytes) else f"{v.mean_bytes:.1f}",
        "-" if v.area is None else f"{v.area:.3f}",
        "-" if v.ci is None else f"{v.ci[0]:.3f}..{v.ci[1]:.3f}",
    )
