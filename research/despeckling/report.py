"""Report of `python -m research.despeckling`: tables as text, or one JSON object."""

import json
import math
from collections.abc import Sequence

from research.codecs.report import aligned
from research.despeckling.measurement import FilterResult, RecordingRow


def json_line(
    results: Sequence[FilterResult], recordings: Sequence[Sequence[RecordingRow]], pairs: int, seed: int
) -> str:
    """Return the JSON object: one row for each filter and budget; budget null for the filtered image itself."""
    rows = [
        {
            "filter": result.name,
            "budget": row.budget_bytes,
            "filter_ms": _rounded(result.filter_ms, 2),
            "misses": row.misses,
            **{name: _rounded(value, 4) for name, value in row.figures.items()},
        }
        for result in results
        for row in result.rows
    ]
    real = [
        {
            "filter": row.name,
            "budget": row.budget_bytes,
            "dots_with_target": _rounded(row.dots_with_target, 3),
            "dots_without_target": _rounded(row.dots_without_target, 3),
            "original_psnr": _rounded(row.original_psnr, 4),
        }
        for rows_of_filter in recordings
        for row in rows_of_filter
    ]
    return json.dumps({"pairs": pairs, "seed": seed, "results": rows, "sdvd": real}, allow_nan=False)


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


def _rounded(value: float, digits: int) -> float | None:
    return round(value, digits) if math.isfinite(value) else None


def _fixed(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"
