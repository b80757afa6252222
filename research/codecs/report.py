"""Report of `python -m research.codecs`: tables as text, one JSON object, and rate differences between the codecs."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from research.common.images import ImageSet
from research.common.measurement import SCENE_MEASURES, BudgetResult, best_within_budgets
from research.common.statistics import (
    Interval,
    Values,
    bd_rate_percent,
    finite_mean,
    interval,
    overlap_db,
    weighted_means,
)

REFERENCE: Final = "emb"
"""The codec with which the others are compared in the JSON object."""
MIN_SHARE: Final = 0.9
"""A budget counts if the codec coded at least this share of the images within it."""
BD_RESAMPLES: Final = 200
_METRICS: Final = ("psnr", "ssim", "msssim")
_Json = dict[str, object]
Curve = Sequence[BudgetResult]


def curves(results: Sequence[BudgetResult]) -> dict[str, list[BudgetResult]]:
    """Group results by codec name in order of first appearance; the variants of a codec form one curve."""
    found: dict[str, list[BudgetResult]] = {}
    for result in results:
        found.setdefault(result.tested.name, []).append(result)
    return found


def at_budgets(results: Sequence[BudgetResult], budgets: Sequence[int]) -> list[BudgetResult]:
    """Return one result for each codec and budget; for natural sizes (vq) the best variant that fits."""
    found: list[BudgetResult] = []
    for curve in curves(results).values():
        natural = [result for result in curve if result.tested.is_natural]
        found += best_within_budgets(natural, budgets) if natural else curve
    return found


def result_rows(results: Sequence[BudgetResult], budgets: Sequence[int]) -> list[_Json]:
    """Return the rows of the JSON object, one for each codec and budget.

    All figures of a row are null if fewer than `MIN_SHARE` of the images fitted: a mean over the easy images is not
    comparable with one over all.
    """
    rows: list[_Json] = []
    for result in at_budgets(results, budgets):
        counts = result.hits.mean() >= MIN_SHARE
        figures = {name: value if counts else None for name, value in _figures(result).items()}
        rows.append({"codec": result.tested.name, "budget": result.effective_budget, **figures})
    return rows


def _figures(result: BudgetResult) -> dict[str, float | None]:
    return {
        "bytes": _rounded(finite_mean(result.stream_bytes), 2),
        "psnr": _rounded(finite_mean(result.psnr), 4),
        "ssim": _rounded(finite_mean(result.ssim), 5),
        "msssim": _rounded(finite_mean(result.msssim), 5),
        "encode_ms": _rounded(_finite_median(result.encode_ms), 3),
        "decode_ms": _rounded(_finite_median(result.decode_ms), 3),
        **{name: _scene_figure(result, name) for name in SCENE_MEASURES},
    }


def _scene_figure(result: BudgetResult, name: str) -> float | None:
    """Return the mean of PSNR or dots, or the median of errors; None if it does not apply or was not measured."""
    values = result.scene.get(name)
    if values is None:
        return None
    return _rounded(_finite_median(values) if "error" in name else finite_mean(values), 4)


def detail_rows(results: Sequence[BudgetResult], weights: Values) -> list[_Json]:
    """Return one JSON object a result: means over the coded images, their number, misses, intervals.

    A figure is null if every image was missed. `emb_gain` is the mean difference of emb over this codec in each
    metric, at the same budget on the images that both coded, with its interval.
    """
    reference = {r.budget_bytes: r for r in results if r.tested.name == REFERENCE}
    return [_detail_row(result, reference.get(result.budget_bytes), weights) for result in results]


def _detail_row(result: BudgetResult, reference: BudgetResult | None, weights: Values) -> _Json:
    row: _Json = {
        "codec": result.tested.name,
        "budget": result.effective_budget,
        **_figures(result),
        "n": int(result.hits.sum()),
        "misses": result.misses,
        "ci": {name: _ci(getattr(result, name), weights) for name in _METRICS},
    }
    if result.tested.variant:
        row["variant"] = result.tested.variant
    if result.reasons:
        row["miss_reasons"] = dict(result.reasons.most_common(3))
    if reference is not None and reference is not result:
        differences = {name: getattr(reference, name) - getattr(result, name) for name in _METRICS}
        row["emb_gain"] = {
            name: {"mean": _rounded(finite_mean(values), 5), "ci": _ci(values, weights)}
            for name, values in differences.items()
        }
    return row


@dataclass(frozen=True)
class RateDifference:
    """Difference in rate of two codecs at equal PSNR.

    Attributes:
        percent: Bjøntegaard difference, negative if the first needs less; None if they are not comparable.
        ci: 95 % bootstrap interval; None if too few samples were comparable.
        overlap: PSNR range of the comparison, dB.
        images: Number of images of both curves.
    """

    percent: float | None
    ci: Interval | None
    overlap: Interval | None
    images: int


def rate_differences(results: Sequence[BudgetResult], weights: Values) -> dict[str, dict[str, RateDifference]]:
    """Compare every codec with every other; intervals for the reference codec only, as they take time."""
    by_codec = curves(results)
    return {
        name: {
            other: rate_difference(curve, other_curve, weights if name == REFERENCE else None)
            for other, other_curve in by_codec.items()
            if other != name
        }
        for name, curve in by_codec.items()
    }


def rate_difference(first: Curve, second: Curve, weights: Values | None = None) -> RateDifference:
    """Compare two codecs by the Bjøntegaard rate difference (see `bd_rate_percent`).

    Curves consist of mean bytes and mean PSNR over the same images: those that both codecs coded at every budget that
    counts (`MIN_SHARE`). Means over different images would favour a codec that misses the difficult ones.

    Args:
        first: Results of one codec.
        second: Results of the other.
        weights: Bootstrap weights, shape (R, images), for the interval; None for no interval.
    """
    one, other = _counting(first), _counting(second)
    if len(one) < 2 or len(other) < 2:
        return RateDifference(None, None, None, 0)
    common = np.logical_and.reduce([result.hits for result in (*one, *other)])
    images = int(np.count_nonzero(common))
    if images == 0:
        return RateDifference(None, None, None, 0)
    equal = np.full((1, common.size), 1.0)
    (rates, quality), (other_rates, other_quality) = _means(one, common, equal), _means(other, common, equal)
    percent = bd_rate_percent(rates[0], quality[0], other_rates[0], other_quality[0])
    if percent is None:
        return RateDifference(None, None, None, images)
    shared = overlap_db(quality[0], other_quality[0])
    return RateDifference(percent, _difference_interval(one, other, common, weights), shared, images)


def _counting(curve: Curve) -> list[BudgetResult]:
    return [result for result in curve if result.hits.mean() >= MIN_SHARE]


def _means(results: Curve, common: npt.NDArray[np.bool_], weights: Values) -> tuple[Values, Values]:
    """Return mean bytes and mean PSNR in each bootstrap sample, both of shape (R, results)."""
    chosen = weights[:, common]
    total = chosen.sum(axis=1, keepdims=True)
    rates = np.stack([result.stream_bytes[common] for result in results], axis=1)
    quality = np.stack([result.psnr[common] for result in results], axis=1)
    return chosen @ rates / total, chosen @ quality / total


def _difference_interval(
    one: Curve, other: Curve, common: npt.NDArray[np.bool_], weights: Values | None
) -> Interval | None:
    if weights is None:
        return None
    samples = weights[:BD_RESAMPLES]
    samples = samples[samples[:, common].sum(axis=1) > 0]
    (rates, quality), (other_rates, other_quality) = _means(one, common, samples), _means(other, common, samples)
    draws = [bd_rate_percent(rates[i], quality[i], other_rates[i], other_quality[i]) for i in range(samples.shape[0])]
    return interval(np.array([np.nan if draw is None else draw for draw in draws]))


def json_line(rows: list[_Json], images: int, differences: dict[str, dict[str, RateDifference]]) -> str:
    """Return the JSON object: number of images, rows, and rate differences of the reference codec in percent."""
    compared: dict[str, dict[str, float | None]] = {}
    if REFERENCE in differences:
        found = differences[REFERENCE]
        compared[REFERENCE] = {other: _rounded(difference.percent, 2) for other, difference in found.items()}
    return json.dumps({"images": images, "results": rows, "bd_rate": compared}, allow_nan=False)


def details(
    results: Sequence[BudgetResult],
    budgets: Sequence[int],
    measured: ImageSet,
    weights: Values,
    differences: dict[str, dict[str, RateDifference]],
) -> str:
    """Return all figures as a JSON object, for a file."""
    natural = [result for result in results if result.tested.is_natural]
    found = {
        "images": len(measured.images),
        "origin": measured.origin,
        "refused": list(measured.rejected),
        "results": detail_rows(at_budgets(results, budgets), weights),
        "natural_sizes": detail_rows(natural, weights),
        "bd_rate": {
            name: {
                other: {"percent": d.percent, "ci": d.ci, "overlap_db": d.overlap, "images": d.images}
                for other, d in compared.items()
            }
            for name, compared in differences.items()
        },
    }
    return json.dumps(found, allow_nan=False, indent=1) + "\n"


def text(
    results: Sequence[BudgetResult],
    measured: ImageSet,
    weights: Values,
    differences: dict[str, dict[str, RateDifference]],
) -> str:
    """Return the report as text."""
    rows = detail_rows(results, weights)
    parts = [
        f"{len(measured.images)} images of {measured.origin}, {len(measured.rejected)} rejected",
        _quality_table(results, rows),
        _miss_table(results),
        _difference_table(differences),
    ]
    return "\n\n".join(part for part in parts if part)


def _quality_table(results: Sequence[BudgetResult], rows: Sequence[_Json]) -> str:
    head = ("codec", "budget", "n", "miss", "bytes", "PSNR dB", "95 %", "SSIM", "MS-SSIM", "enc ms", "dec ms")
    body = []
    for result, row in zip(results, rows, strict=True):
        ci = row["ci"]
        assert isinstance(ci, dict)
        body.append(
            (
                result.tested.label,
                str(row["budget"]) if result.budget_bytes is not None else "own",
                str(row["n"]),
                str(row["misses"]),
                _fixed(row["bytes"], 1),
                _fixed(row["psnr"], 2),
                "-" if ci["psnr"] is None else f"{ci['psnr'][0]:.2f}..{ci['psnr'][1]:.2f}",
                _fixed(row["ssim"], 3),
                _fixed(row["msssim"], 3),
                _fixed(row["encode_ms"], 1),
                _fixed(row["decode_ms"], 1),
            )
        )
    note = "Means over the n images that fitted; bytes include the header; times are medians."
    return aligned([head, *body]) + "\n" + note


def miss_lines(results: Sequence[BudgetResult]) -> list[str]:
    """Return one line for each result with misses: their number and the most frequent reason."""
    return [
        f"{result.tested.label} at {result.effective_budget} B: {count} x {reason}"
        for result in results
        for reason, count in result.reasons.most_common(1)
    ]


def _miss_table(results: Sequence[BudgetResult]) -> str:
    lines = [f"  {line}" for line in miss_lines(results)]
    return "\n".join(["Misses (most frequent reason):", *lines]) if lines else ""


def _difference_table(differences: dict[str, dict[str, RateDifference]]) -> str:
    if len(differences) < 2:
        return ""
    names = list(differences)
    head = ("BD-rate %", *(f"vs {name}" for name in names))
    body = [(name, *(_percent(differences[name].get(other)) for other in names)) for name in names]
    lines = [aligned([head, *body])]
    for other, found in differences.get(REFERENCE, {}).items():
        if found.percent is None or found.overlap is None:
            lines.append(f"  {REFERENCE} vs {other}: no common PSNR range, or fewer than two budgets that count")
            continue
        ci = "" if found.ci is None else f", 95 % {found.ci[0]:.1f}..{found.ci[1]:.1f}"
        lines.append(
            f"  {REFERENCE} vs {other}: {found.percent:.1f} %{ci} "
            f"({found.overlap[0]:.2f}..{found.overlap[1]:.2f} dB, {found.images} images)"
        )
    lines.append(
        f"Rate at equal PSNR, row against column, negative is less. Only budgets within which {MIN_SHARE:.0%} of the "
        f"images were coded count; intervals from {BD_RESAMPLES} resamples."
    )
    return "\n".join(lines)


def _percent(found: RateDifference | None) -> str:
    if found is None:
        return ""
    return "-" if found.percent is None else f"{found.percent:.1f}"


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Return rows as text with aligned columns: the first left-aligned, the others right-aligned."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )


def _ci(values: Values, weights: Values) -> list[float] | None:
    found = interval(weighted_means(values, weights))
    return None if found is None else [round(found[0], 5), round(found[1], 5)]


def _finite_median(values: Values) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else math.nan


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, digits)


def _fixed(value: object, digits: int) -> str:
    return f"{value:.{digits}f}" if isinstance(value, float) else "-"
