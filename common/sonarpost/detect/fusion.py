"""From three independent scores to one confidence, and from many candidates to one a place.

Each filter's score s, whose operating point is t, becomes a share p = s / (s + t): 0 without evidence, one half at the
operating point, towards 1 with more. The fused confidence is

    confidence = 2 * p_matched ** 0.45 * p_cfar ** 0.20 * p_shadow ** 0.35

in [0, 2), rising with every score, 1.0 when every filter is at its operating point, and 0 when any of them sees
nothing: an object must be bright, cast a shadow, and look like both together. The paper's confidence has the same
range (0.0 to 2.0, a fusion of several filters); its mapping is not published, so this one is ours.
"""

from __future__ import annotations

from collections.abc import Sequence

from sonarpost.detect.measure import Measured
from sonarpost.detect.preprocess import LevelGrid
from sonarpost.detect.settings import DetectorSettings

# The shadow counts more than the highlight's brightness: rock and debris glint too, but shadows are hard to fake.
_WEIGHTS = (0.45, 0.2, 0.35)


def fused_confidence(matched: float, cfar: float, shadow: float, settings: DetectorSettings) -> float:
    """Return the fused confidence in [0, 2) of the three scores, each 0 or more (see the module's formula)."""
    points = (settings.matched_at_threshold, settings.cfar_at_threshold, settings.shadow_at_threshold)
    confidence = 2.0
    for score, point, weight in zip((matched, cfar, shadow), points, _WEIGHTS, strict=True):
        confidence *= (score / (score + point)) ** weight if score > 0 else 0.0
    return confidence


def suppress(
    candidates: Sequence[tuple[float, Measured]], grid: LevelGrid, settings: DetectorSettings
) -> list[tuple[float, Measured]]:
    """Keep the most confident candidate of every place, most confident first.

    Two candidates are one place when their highlights lie within `separation_along_m` and `separation_across_m` of
    each other, or when one's highlight lies in the other's shadow.
    """
    kept: list[tuple[float, Measured]] = []
    for confidence, one in sorted(candidates, key=lambda c: (-c[0], c[1].row, c[1].cell)):
        if not any(_same_place(one, other, grid, settings) for _, other in kept):
            kept.append((confidence, one))
    return kept


def _same_place(one: Measured, other: Measured, grid: LevelGrid, settings: DetectorSettings) -> bool:
    along_m = max(one.rows[0] - other.rows[1], other.rows[0] - one.rows[1], 0) * grid.row_along_m
    far_one, far_other = one.cells[1] + one.shadow_cells, other.cells[1] + other.shadow_cells
    if along_m == 0 and one.cells[0] < far_other and other.cells[0] < far_one:
        return True
    centre_along_m = abs(one.row - other.row) * grid.row_along_m
    centre_across_m = abs(one.cell - other.cell) * grid.cell_across_m
    return centre_along_m < settings.separation_along_m and centre_across_m < settings.separation_across_m
