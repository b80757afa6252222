"""`python -m research.recognition`: how well a classifier trained on originals recognises targets after coding."""

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from research.codecs.report import aligned
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
from research.common.images import SampleImage, sdvd_crops, simulated_images
from research.common.measurement import CodecUnderTest, code_image
from research.common.statistics import Interval, Values, auc, bootstrap_weights, interval
from research.recognition.classifier import DEFAULT_GRAIN_STRENGTH, TargetClassifier, codec_with_grain, with_grain
from sonarpost.codec.interface import Image

MIN_AUC: Final = 0.93
"""Minimum AUC of the classifier on originals for a valid result."""
EXIT_POOR_CLASSIFIER: Final = 1
_SIMULATED: Final = 240
_SIMULATED_SEED: Final = 1  # not that of `research.codecs`


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser(
        "recognition",
        description="Train a classifier on original images (SDVD's train split and simulated ones) and measure how "
        "well it separates targets from clutter in decoded images of the test split. No survey line is classified "
        "with a model trained on it; intervals are over survey lines. For emb, streams with a description of the "
        "texture, within the same budget, are also measured, with synthetic texture added. Differences below about "
        ".03 are not significant.",
    )
    parser.add_argument("--sdvd", type=Path, required=True, metavar="DIR", help="folder of the SDVD data set")
    add_codec_arguments(parser)
    add_strength_argument(parser)
    parser.add_argument(
        "--simulated", type=int, default=_SIMULATED, metavar="N", help="simulated training images (%(default)s)"
    )
    return parser


@dataclass(frozen=True)
class RecognitionResult:
    """Result of one codec at one budget.

    Attributes:
        label: Codec and variant; "original" for the originals.
        budget_bytes: Maximum bytes of a stream; None for a natural size and for the originals.
        grain: Share of the synthetic texture added; None without description of the texture.
        mean_bytes: Mean length of a stream; NaN for the originals.
        images: Number of classified images.
        misses: Number of images missed by the codec.
        area: Area under the ROC curve; None without both targets and non-targets.
        ci: Its 95 % bootstrap interval over survey lines.
        share: Ratio of the area to that of the originals of the same images.
        share_ci: Its 95 % interval over the same samples of survey lines.
    """

    label: str
    budget_bytes: int | None
    grain: float | None
    mean_bytes: float
    images: int
    misses: int
    area: float | None
    ci: Interval | None
    share: float | None
    share_ci: Interval | None


def measure(args: argparse.Namespace) -> list[RecognitionResult]:
    """Train and classify; return the result of the originals, then those of each codec and budget.

    Raises:
        SonarpostError: Invalid options, data set or codecs.
    """
    budgets = parse_budgets(args.budgets)
    tested = selected_codecs(args, all_packings=False)
    training, test = (sdvd_crops(args.sdvd, split).images for split in ("train", "test"))
    simulated = simulated_images(args.simulated, _SIMULATED_SEED).images if args.simulated else ()
    report_progress(f"training on {len(training)} real and {len(simulated)} simulated images")
    groups = [image.group for image in test]
    evaluation = _Evaluation(TargetClassifier(training, simulated, groups), test, bootstrap_weights(groups))
    results = [evaluation.result([image.pixels for image in test], _Coding("original", None, None))]
    for codec in tested:
        results += _codec_results(evaluation, codec, budgets)
        report_progress(f"{codec.label}: classified")
    return results


def run(args: argparse.Namespace) -> int:
    """Measure and report; return 0, or 1 if the classifier is too poor on the originals."""
    results = measure(args)
    print(_table(results))
    if results[0].area is None or results[0].area < MIN_AUC:
        warn(
            f"AUC of the classifier on originals: got {results[0].area}, expected at least {MIN_AUC}; "
            "the results are not valid"
        )
        return EXIT_POOR_CLASSIFIER
    return 0


@dataclass(frozen=True)
class _Coding:
    label: str
    budget_bytes: int | None
    grain: float | None


class _Evaluation:
    """The classifier, the test images, and the bootstrap samples common to all results.

    Args:
        classifier: The trained classifier.
        test: Original images.
        weights: Bootstrap weights, shape (R, images).
    """

    def __init__(self, classifier: TargetClassifier, test: Sequence[SampleImage], weights: Values) -> None:
        self.test = test
        self._classifier = classifier
        self._weights = weights
        self._is_target = np.array([bool(image.is_target) for image in test])
        self._original_scores = classifier.scores([image.pixels for image in test], [image.group for image in test])

    def result(
        self, images: Sequence[Image | None], coding: _Coding, lengths: Values | None = None
    ) -> RecognitionResult:
        """Classify decoded images, one for each test image; None for a miss."""
        coded = np.array([image is not None for image in images])
        is_target = self._is_target[coded]
        area, ci, share, share_ci = None, None, None, None
        if is_target.any() and not is_target.all():
            groups = [original.group for original, image in zip(self.test, images, strict=True) if image is not None]
            scores = self._classifier.scores([image for image in images if image is not None], groups)
            weights = self._weights[:, coded]
            area, draws = float(auc(scores, is_target)[0]), auc(scores, is_target, weights)
            original = self._original_scores[coded]
            original_area, original_draws = float(auc(original, is_target)[0]), auc(original, is_target, weights)
            ci = interval(draws)
            if original_area > 0.0:
                share = area / original_area
                ratios = np.full(draws.shape, np.nan)
                share_ci = interval(np.divide(draws, original_draws, out=ratios, where=original_draws > 0))
        count = int(np.count_nonzero(coded))
        return RecognitionResult(
            coding.label,
            coding.budget_bytes,
            coding.grain,
            math.nan if lengths is None or not count else float(lengths[coded].mean()),
            count,
            len(self.test) - count,
            area,
            ci,
            share,
            share_ci,
        )


def _codec_results(evaluation: _Evaluation, tested: CodecUnderTest, budgets: Sequence[int]) -> list[RecognitionResult]:
    """Return the results at every budget, then those of streams with a description of the texture.

    The description is part of the same budget, so it reduces the bytes of the image.
    """
    results = []
    for coding, images, _, lengths in _coded(evaluation.test, tested, budgets):
        results.append(evaluation.result(images, coding, lengths))
    grain_codec = codec_with_grain(tested.codec)
    if grain_codec is None:
        return results
    for coding, images, streams, lengths in _coded(evaluation.test, replace(tested, codec=grain_codec), budgets):
        textured = [
            None if image is None or stream is None else with_grain(grain_codec, stream, image)
            for image, stream in zip(images, streams, strict=True)
        ]
        results.append(evaluation.result(textured, replace(coding, grain=DEFAULT_GRAIN_STRENGTH), lengths))
    return results


def _coded(
    test: Sequence[SampleImage], tested: CodecUnderTest, budgets: Sequence[int]
) -> Iterator[tuple[_Coding, list[Image | None], list[bytes | None], Values]]:
    """Yield for each budget: the coding, decoded images, streams and their lengths (None, None, NaN for a miss)."""
    coded = [code_image(tested, image.pixels, budgets) for image in test]
    for column in range(len(coded[0])):
        results = [each[column] for each in coded]
        budget = None if tested.is_natural else budgets[column]
        yield (
            _Coding(tested.label, budget, None),
            [None if isinstance(r, str) else r.decoded for r in results],
            [None if isinstance(r, str) else r.stream for r in results],
            np.array([math.nan if isinstance(r, str) else float(len(r.stream)) for r in results]),
        )


def _table(results: Sequence[RecognitionResult]) -> str:
    head = ("codec", "budget", "grain", "n", "miss", "bytes", "AUC", "95 %", "of original", "95 %")
    return aligned([head, *(_table_row(result) for result in results)])


def _table_row(r: RecognitionResult) -> tuple[str, ...]:
    return (
        r.label,
        "own" if r.budget_bytes is None else str(r.budget_bytes),
        "no" if r.grain is None else f"{r.grain:g}",
        str(r.images),
        str(r.misses),
        "-" if math.isnan(r.mean_bytes) else f"{r.mean_bytes:.1f}",
        "-" if r.area is None else f"{r.area:.3f}",
        "-" if r.ci is None else f"{r.ci[0]:.3f}..{r.ci[1]:.3f}",
        "-" if r.share is None else f"{r.share:.3f}",
        "-" if r.share_ci is None else f"{r.share_ci[0]:.3f}..{r.share_ci[1]:.3f}",
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
