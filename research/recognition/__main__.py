"""`python -m research.recognition`: what a judge trained on originals still recognises in decoded pictures."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from research.codecs.__main__ import add_codec_arguments, chosen_subjects, parse_budgets, say
from research.codecs.report import aligned
from research.common.command import command_parser, run_command
from research.common.images import BenchPicture, simulated_pictures
from research.common.measurement import Subject, code
from research.common.sdvd import sdvd_crops
from research.common.statistics import Interval, Values, auc, bootstrap_weights, interval
from research.recognition.classifier import Judge
from research.recognition.speckle import DEFAULT_STRENGTH, grainy_twin, with_grain
from sonarpost.codec.interface import Image
from sonarpost.errors import ConfigError

LEAST_AUC: Final = 0.93
"""A judge that tells originals apart worse than this is none."""
EXIT_POOR_JUDGE: Final = 1
MAX_STRENGTH: Final = 2.0
_SIMULATED: Final = 240
_SIMULATED_SEED: Final = 1  # not that of `research.codecs`


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser(
        "recognition",
        description="Train a judge on original pictures (SDVD's train split and simulated ones) and let it tell "
        "targets from clutter in decoded pictures of the test split. No survey line is judged by a judge that was "
        "trained on it; intervals are of samples of survey lines. Of emb, streams that describe the bottom's grain, "
        "within the same budget, are judged too, with the grain shown. Differences below about .03 are chance.",
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
    parser.add_argument(
        "--grain-strength",
        default=str(DEFAULT_STRENGTH),
        metavar="S,S,…",
        help="shares of the synthetic grain to be shown, 0..2 (default: %(default)s)",
    )
    return parser


@dataclass(frozen=True)
class Verdict:
    """The judge's success on one codec at one budget.

    Attributes:
        label: Codec and variant; "original" for the originals.
        codec: Name in the registry; empty for the originals.
        budget_bytes: Most bytes of a stream; None for a natural size and for the originals.
        grain: Share of the synthetic grain that was shown; None for the measured picture of a stream without.
        mean_bytes: Mean real length of a stream; NaN for the originals.
        pictures: How many pictures were judged.
        misses: How many the codec missed.
        area: Area under the ROC curve; None without both targets and others.
        ci: Its 95 % bootstrap interval over survey lines.
        share: Of the area that the same pictures' originals have.
        share_ci: Its 95 % interval over the same samples of survey lines.
    """

    label: str
    codec: str
    budget_bytes: int | None
    grain: float | None
    mean_bytes: float
    pictures: int
    misses: int
    area: float | None
    ci: Interval | None
    share: float | None
    share_ci: Interval | None


def run(args: argparse.Namespace) -> int:
    """Train, judge and report; return 0, or 1 if the judge is too poor to judge codecs.

    Raises:
        SonarpostError: Wrong options, data set or codecs.
    """
    budgets = parse_budgets(args.budgets)
    if not 0.0 <= args.least_auc <= 1.0:
        raise ConfigError("research", "--least-auc", args.least_auc, "0..1")
    strengths = _parse_strengths(args.grain_strength)
    tested = chosen_subjects(args, all_packings=False)
    training = sdvd_crops(args.sdvd, "train", args.crop).pictures
    test = sdvd_crops(args.sdvd, "test", args.crop).pictures
    simulated = simulated_pictures(args.simulated, _SIMULATED_SEED, args.crop).pictures if args.simulated else ()
    say(f"training on {len(training)} real and {len(simulated)} simulated pictures")
    judge = Judge(training, simulated, [picture.group for picture in test])
    court = _Court(judge, test, bootstrap_weights([picture.group for picture in test]))
    first = court.verdict([picture.pixels for picture in test], _Coding("original", "", None, None))
    verdicts = [first]
    for subject in tested:
        verdicts += _verdicts_of(court, subject, budgets, strengths)
        say(f"{subject.label}: judged")
    print(_json_line(verdicts, len(test)) if args.json else _table(verdicts))
    if first.area is None or first.area < args.least_auc:
        say(f"the judge's AUC on originals is {first.area}, below {args.least_auc}: it says nothing about codecs")
        return EXIT_POOR_JUDGE
    return 0


def _parse_strengths(written: str) -> tuple[float, ...]:
    """Read `0.5,1`; return the strengths in rising order, none twice."""
    found = set()
    for part in written.split(","):
        try:
            strength = float(part)
        except ValueError:
            strength = math.nan
        if not 0.0 <= strength <= MAX_STRENGTH:
            raise ConfigError("research", "--grain-strength", part, f"numbers 0..{MAX_STRENGTH}, separated by commas")
        found.add(strength)
    return tuple(sorted(found))


@dataclass(frozen=True)
class _Coding:
    label: str
    codec: str
    budget_bytes: int | None
    grain: float | None


class _Court:
    """The judge, the pictures of the test split, and the samples of survey lines that all verdicts share.

    Args:
        judge: Trained.
        test: Original pictures.
        weights: Bootstrap weights, shape (R, pictures).
    """

    def __init__(self, judge: Judge, test: Sequence[BenchPicture], weights: Values) -> None:
        self.test = test
        self._judge = judge
        self._weights = weights
        self._is_target = np.array([bool(picture.is_target) for picture in test])
        self._of_originals = judge.scores([picture.pixels for picture in test], [picture.group for picture in test])

    def verdict(self, pictures: Sequence[Image | None], coding: _Coding, lengths: Values | None = None) -> Verdict:
        """Judge decoded pictures, one for each of the test split; None where there is none."""
        shown = np.array([picture is not None for picture in pictures])
        is_target = self._is_target[shown]
        area, ci, share, share_ci = None, None, None, None
        if is_target.any() and not is_target.all():
            groups = [picture.group for picture, there in zip(self.test, shown, strict=True) if there]
            scores = self._judge.scores([picture for picture in pictures if picture is not None], groups)
            weights = self._weights[:, shown]
            area, draws = float(auc(scores, is_target)[0]), auc(scores, is_target, weights)
            best = self._of_originals[shown]
            best_area, best_draws = float(auc(best, is_target)[0]), auc(best, is_target, weights)
            ci = interval(draws)
            if best_area > 0.0:
                share = area / best_area
                share_ci = interval(
                    np.divide(draws, best_draws, out=np.full(draws.shape, np.nan), where=best_draws > 0)
                )
        count = int(np.count_nonzero(shown))
        mean_bytes = math.nan if lengths is None or not count else float(lengths[shown].mean())
        missed = len(self.test) - count
        return Verdict(
            coding.label,
            coding.codec,
            coding.budget_bytes,
            coding.grain,
            mean_bytes,
            count,
            missed,
            area,
            ci,
            share,
            share_ci,
        )


def _verdicts_of(court: _Court, subject: Subject, budgets: Sequence[int], strengths: Sequence[float]) -> list[Verdict]:
    """Judge a codec's pictures at every budget; then those of streams that say how strong the grain is.

    Such a stream is within the same budget: the grain's description is paid for by the picture.
    """
    verdicts = []
    for coding, plain, _, lengths in _coded(court.test, subject, budgets):
        verdicts.append(court.verdict(plain, coding, lengths))
    twin = grainy_twin(subject.codec)
    if twin is None:
        return verdicts
    grainy = replace(subject, codec=twin)
    for coding, plain, streams, lengths in _coded(court.test, grainy, budgets):
        for strength in strengths:
            views = [
                None if picture is None or stream is None else with_grain(twin, stream, picture, strength)
                for picture, stream in zip(plain, streams, strict=True)
            ]
            verdicts.append(court.verdict(views, replace(coding, grain=strength), lengths))
    return verdicts


def _coded(
    test: Sequence[BenchPicture], subject: Subject, budgets: Sequence[int]
) -> Iterator[tuple[_Coding, list[Image | None], list[bytes | None], Values]]:
    """Yield for each budget: what it is, the decoded pictures, their streams and lengths (None, None, NaN: missed)."""
    coded = [code(subject, picture.pixels, budgets) for picture in test]
    for place in range(len(coded[0])):
        results = [each[place] for each in coded]
        budget = None if subject.is_natural else budgets[place]
        yield (
            _Coding(subject.label, subject.codec.name, budget, None),
            [None if isinstance(r, str) else r.rebuilt for r in results],
            [None if isinstance(r, str) else r.stream for r in results],
            np.array([math.nan if isinstance(r, str) else float(len(r.stream)) for r in results]),
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
            "ci": _rounded(v.ci),
            "of_original": None if v.share is None else round(v.share, 4),
            "of_original_ci": _rounded(v.share_ci),
        }
        for v in others
    ]
    original = {"auc": judge.area, "ci": None if judge.ci is None else list(judge.ci)}
    return json.dumps({"images": images, "judge": original, "results": results}, allow_nan=False)


def _rounded(found: Interval | None) -> list[float] | None:
    return None if found is None else [round(found[0], 4), round(found[1], 4)]


def _table(verdicts: Sequence[Verdict]) -> str:
    head = ("codec", "budget", "grain", "n", "miss", "bytes", "AUC", "95 %", "of original", "95 %")
    return aligned([head, *(_table_row(verdict) for verdict in verdicts)])


def _table_row(v: Verdict) -> tuple[str, ...]:
    return (
        v.label,
        "own" if v.budget_bytes is None else str(v.budget_bytes),
        "no" if v.grain is None else f"{v.grain:g}",
        str(v.pictures),
        str(v.misses),
        "-" if math.isnan(v.mean_bytes) else f"{v.mean_bytes:.1f}",
        "-" if v.area is None else f"{v.area:.3f}",
        "-" if v.ci is None else f"{v.ci[0]:.3f}..{v.ci[1]:.3f}",
        "-" if v.share is None else f"{v.share:.3f}",
        "-" if v.share_ci is None else f"{v.share_ci[0]:.3f}..{v.share_ci[1]:.3f}",
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
