"""Every place the matched filter points to, with what each filter says of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from sonarpost.detection.highlight_shadow import matched_response, peaks
from sonarpost.detection.measure import Measured, measure
from sonarpost.detection.preprocess import LevelGrid
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.texture import TextureMap

_MOST_PER_KILOPING: Final = 250


@dataclass(frozen=True, slots=True)
class FilterScores:
    """What each filter says of a place; 0 or more, and more is more like an object on the bottom.

    Attributes:
        matched: Highlight-and-shadow matched filter, in deviations of the noise around.
        cfar: Highlight over the ring of seabed around it, in the ring's deviations.
        shadow: Depth of the shadow below that ring, in the same, times the part of it that is dark.
        texture: Distance of the texture, where highlight and shadow meet, from that of the seabed around
            (`sonarpost.detection.texture`).
        geometry: 0 to 1, how well highlight and shadow have the proportions of a compact object, see `geometry_score`.
    """

    matched: float
    cfar: float
    shadow: float
    texture: float
    geometry: float


@dataclass(frozen=True, slots=True)
class Candidate:
    """A place and its scores."""

    measured: Measured
    scores: FilterScores


def candidates(grid: LevelGrid, settings: DetectorSettings) -> list[Candidate]:
    """Return the places on one side that the matched filter points to, strongest first.

    Args:
        grid: One side of a survey, or a piece of a picture.
        settings: How to look.
    """
    most = math.ceil(_MOST_PER_KILOPING * max(1.0, len(grid.level) / 1000))
    found = peaks(matched_response(grid, settings), grid, settings, settings.least_matched)[:most]
    measured = [m for m in (measure(grid, peak, settings) for peak in found) if m is not None]
    texture = TextureMap(grid)
    return [
        Candidate(
            one,
            FilterScores(
                matched=one.matched,
                cfar=one.cfar,
                shadow=one.shadow,
                texture=texture.anomaly(one.row, one.cells[1]),
                geometry=geometry_score(one, grid, settings),
            ),
        )
        for one in measured
    ]


def geometry_score(one: Measured, grid: LevelGrid, settings: DetectorSettings) -> float:
    """Return how well highlight and shadow have the proportions that a compact object's have, 0 to 1.

    The score is exp(-d), d the sum of how far, in natural logarithms, each of these lies beyond what is granted: the
    highlight's longer side beyond the greatest mine's length; its longer over its shorter side beyond 4; the shadow's
    extent along-track beyond twice the highlight's (or a metre) or below half of it; a missing shadow counts 1.
    """
    length_m = (one.rows[1] - one.rows[0]) * grid.row_along_m
    width_m = (one.cells[1] - one.cells[0]) * grid.cell_across_m
    longer, shorter = max(length_m, width_m), max(min(length_m, width_m), 1e-3)
    beyond = max(0.0, math.log(longer / settings.mine_length_m[1])) + max(0.0, math.log(longer / shorter / 4.0))
    if one.shadow_rows == 0:
        return math.exp(-beyond - 1.0)
    shadow_along_m = one.shadow_rows * grid.row_along_m
    beyond += max(0.0, math.log(shadow_along_m / max(2.0 * length_m, 1.0)))
    beyond += max(0.0, math.log(0.5 * length_m / shadow_along_m))
    return math.exp(-beyond)
