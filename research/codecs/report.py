"""What `python -m research.codecs` says: tables for people, one JSON object for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from research.codecs.rate_distortion import BD_RESAMPLES, LEAST_SHARE, RateDifference, curves, rate_difference
from research.common.images import PictureSet
from research.common.measurement import Point, best_that_fit
from research.common.statistics import Values, interval, mean_of_known, weighted_means

REFERENCE: Final = "emb"
"""The codec the others are compared with in the JSON object."""
_METRICS: Final = ("psnr", "ssim", "msssim")
_Json = dict[str, object]


def at_budgets(points: Sequence[Point], budgets: Sequence[int]) -> list[Point]:
    """Return one point for each codec and budget: for vq, whose sizes are its own, the best variant that fits."""
    found: list[Point] = []
    for curve in curves(points).values():
        natural = [point for point in curve if point.subject.is_natural]
        found += best_that_fit(natural, budgets) if natural else curve
    return found


def result_rows(points: Sequence[Point], budgets: Sequence[int]) -> list[_Json]:
    """Return the rows of the JSON object, one for each codec and budget.

    All figures of a row are null where fewer than `LEAST_SHARE` of the pictures fitted: a mean over the easy pictures
    is not comparable with one over all.
    """
    rows: list[_Json] = []
    for point in at_budgets(points, budgets):
        counts = point.hits.mean() >= LEAST_SHARE
        figures = _figures(point)
        shown = {name: value if counts else None for name, value in figures.items()}
        rows.append({"codec": point.subject.codec.name, "budget": point.shown_budget, **shown})
    return rows


def _figures(point: Point) -> dict[str, float | None]:
    return {
        "bytes": _rounded(mean_of_known(point.stream_bytes), 2),
        "psnr": _rounded(mean_of_known(point.psnr), 4),
        "ssim": _rounded(mean_of_known(point.ssim), 5),
        "msssim": _rounded(mean_of_known(point.msssim), 5),
        "encode_ms": _rounded(_median(point.encode_ms), 3),
        "decode_ms": _rounded(_median(point.decode_ms), 3),
    }


def detail_rows(points: Sequence[Point], weights: Values) -> list[_Json]:
    """Return one JSON object a point: means over the pictures that were coded, their number, the misses, intervals.

    A figure of a point that missed every picture is null. `emb_gain` is the mean difference of emb over this codec in
    each metric, at the same budget on the pictures both coded, with its interval.
    """
    reference = {p.budget_bytes: p for p in points if p.subject.codec.name == REFERENCE}
    return [_row(point, reference.get(point.budget_bytes), weights) for point in points]


def _row(point: Point, reference: Point | None, weights: Values) -> _Json:
    row: _Json = {
        "codec": point.subject.codec.name,
        "budget": point.shown_budget,
        **_figures(point),
        "n": int(point.hits.sum()),
        "misses": point.misses,
        "ci": {name: _ci(_metric(point, name), weights) for name in _METRICS},
    }
    if point.subject.variant:
        row["variant"] = point.subject.variant
    if point.reasons:
        row["miss_reasons"] = dict(point.reasons.most_common(3))
    if reference is not None and reference is not point:
        row["emb_gain"] = {name: _gain(_metric(reference, name) - _metric(point, name), weights) for name in _METRICS}
    return row


def _gain(difference: Values, weights: Values) -> _Json:
    return {"mean": _rounded(mean_of_known(difference), 5), "ci": _ci(difference, weights)}


def rate_differences(points: Sequence[Point], weights: Values) -> dict[str, dict[str, RateDifference]]:
    """Compare every codec with every other; intervals for the reference codec only (they take their time)."""
    by_codec = curves(points)
    return {
        name: {
            other: rate_difference(curve, other_curve, weights if name == REFERENCE else None)
            for other, other_curve in by_codec.items()
            if other != name
        }
        for name, curve in by_codec.items()
    }


def json_line(rows: list[_Json], pictures: int, differences: dict[str, dict[str, RateDifference]]) -> str:
    """Return the JSON object: number of pictures, rows, and the reference codec's rate differences in percent."""
    compared: dict[str, dict[str, float | None]] = {}
    if REFERENCE in differences:
        found = differences[REFERENCE]
        compared[REFERENCE] = {other: _rounded(difference.percent, 2) for other, difference in found.items()}
    return json.dumps({"images": pictures, "results": rows, "bd_rate": compared}, allow_nan=False)


def details(
    points: Sequence[Point],
    budgets: Sequence[int],
    measured: PictureSet,
    weights: Values,
    differences: dict[str, dict[str, RateDifference]],
) -> str:
    """Return everything measured as a JSON object, for a file."""
    natural = [point for point in points if point.subject.is_natural]
    found = {
        "pictures": len(measured.pictures),
        "origin": measured.origin,
        "refused": list(measured.refused),
        "results": detail_rows(at_budgets(points, budgets), weights),
        "natural_sizes": detail_rows(natural, weights),
        "bd_rate": {
            name: {
                other: {"percent": d.percent, "ci": d.ci, "overlap_db": d.overlap, "pictures": d.pictures}
                for other, d in compared.items()
            }
            for name, compared in differences.items()
        },
    }
    return json.dumps(found, allow_nan=False, indent=1) + "\n"


def text(
    points: Sequence[Point],
    measured: PictureSet,
    weights: Values,
    differences: dict[str, dict[str, RateDifference]],
) -> str:
    """Return the whole report as text."""
    rows = detail_rows(points, weights)
    parts = [
        f"{len(measured.pictures)} pictures of {measured.origin}, {len(measured.refused)} refused",
        _quality_table(points, rows),
        _miss_table(points),
        _difference_table(differences),
    ]
    return "\n\n".join(part for part in parts if part)


def _quality_table(points: Sequence[Point], rows: Sequence[_Json]) -> str:
    head = ("codec", "budget", "n", "miss", "bytes", "PSNR dB", "95 %", "SSIM", "MS-SSIM", "enc ms", "dec ms")
    body = []
    for point, row in zip(points, rows, strict=True):
        ci = row["ci"]
        assert isinstance(ci, dict)
        body.append(
            (
                point.subject.label,
                str(row["budget"]) if point.budget_bytes is not None else "own",
                str(row["n"]),
                str(row["misses"]),
                _shown(row["bytes"], 1),
                _shown(row["psnr"], 2),
                "-" if ci["psnr"] is None else f"{ci['psnr'][0]:.2f}..{ci['psnr'][1]:.2f}",
                _shown(row["ssim"], 3),
                _shown(row["msssim"], 3),
                _shown(row["encode_ms"], 1),
                _shown(row["decode_ms"], 1),
            )
        )
    note = "Means over the n pictures that fitted; bytes are whole streams; ms are medians."
    return aligned([head, *body]) + "\n" + note


def miss_lines(points: Sequence[Point]) -> list[str]:
    """Return one line for each point that missed pictures: how many, and the most frequent reason."""
    return [
        f"{point.subject.label} at {point.shown_budget} B: {count} x {reason}"
        for point in points
        for reason, count in point.reasons.most_common(1)
    ]


def _miss_table(points: Sequence[Point]) -> str:
    lines = [f"  {line}" for line in miss_lines(points)]
    return "\n".join(["Misses (most frequent reason):", *lines]) if lines else ""


def _difference_table(differences: dict[str, dict[str, RateDifference]]) -> str:
    if len(differences) < 2:
        return ""
    names = list(differences)
    head = ("BD-rate %", *(f"vs {name}" for name in names))
    body = [(name, *(_cell(differences[name].get(other)) for other in names)) for name in names]
    lines = [aligned([head, *body])]
    for other, found in differences.get(REFERENCE, {}).items():
        if found.percent is None or found.overlap is None:
            lines.append(f"  {REFERENCE} vs {other}: no common PSNR range, or fewer than two budgets that count")
            continue
        ci = "" if found.ci is None else f", 95 % {found.ci[0]:.1f}..{found.ci[1]:.1f}"
        lines.append(
            f"  {REFERENCE} vs {other}: {found.percent:.1f} %{ci} "
            f"({found.overlap[0]:.2f}..{found.overlap[1]:.2f} dB, {found.pictures} pictures)"
        )
    lines.append(
        f"Rate at equal PSNR, row against column, negative is less; budgets kept for {LEAST_SHARE:.0%} of the pictures "
        f"count; intervals from {BD_RESAMPLES} resamples."
    )
    return "\n".join(lines)


def _cell(found: RateDifference | None) -> str:
    if found is None:
        return ""
    return "-" if found.percent is None else f"{found.percent:.1f}"


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Return rows as text with aligned columns, the first to the left, the others to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )


def _metric(point: Point, name: str) -> Values:
    return {"psnr": point.psnr, "ssim": point.ssim, "msssim": point.msssim}[name]


def _ci(values: Values, weights: Values) -> list[float] | None:
    found = interval(weighted_means(values, weights))
    return None if found is None else [round(found[0], 5), round(found[1], 5)]


def _median(values: Values) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else math.nan


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, digits)


def _shown(value: object, digits: int) -> str:
    return f"{value:.{digits}f}" if isinstance(value, float) else "-"
