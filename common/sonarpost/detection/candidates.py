"""Candidates: peaks of the matched filter, classified by the network; the accepted ones are measured.

The matched filter selects places with a highlight and a shadow behind it, far more than there are objects. The
classifier gives each place the probabilities of a mine-like object, another object and seabed. The confidence is twice
the probability of a mine-like object.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sonarpost.detection.chips import ChipCutter
from sonarpost.detection.classifier import MINE_LIKE_OBJECT, OTHER_OBJECT, Classifier
from sonarpost.detection.matched_filter import MatchedResponse, Peak, peaks
from sonarpost.detection.normalisation import LevelGrid
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import FloatImage

Flags = npt.NDArray[np.bool_]

_MAX_PER_1000_PINGS: Final = 400
_MIN_RING_CELLS: Final = 30
_SHADOW_GAP_M: Final = 0.25
"""A gap of this length, caused by speckle, does not end a shadow."""
_SHADOW_START_M: Final = 0.5
"""A shadow begins within this distance of the outer edge of the highlight: the object rests on the seabed."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """Highlight and shadow of a contact in grid cells, with their scores.

    Attributes:
        row: Centre row of the highlight.
        cell: Centre cell of the highlight.
        rows: First and one-past-last row of the highlight.
        cells: First and one-past-last cell of the highlight.
        shadow_cells: Length of the shadow behind the outer edge of the highlight in cells; 0 without shadow.
        shadow_is_cut: True if the shadow extends to the end of the recording.
        scores: Scores of the filters.
    """

    row: int
    cell: int
    rows: tuple[int, int]
    cells: tuple[int, int]
    shadow_cells: int
    shadow_is_cut: bool
    scores: FilterScores


@dataclass(frozen=True, slots=True)
class FilterScores:
    """The score of each filter at a place: 0 or more, greater for an object on the bottom.

    Attributes:
        matched: Highlight-and-shadow matched filter, in local noise units; 0 for a large structure.
        cfar: Highlight above the median of a guarded ring of seabed, in robust deviations of the ring.
        shadow: Depth of the shadow below that median, in the same unit, times its dark fraction.
    """

    matched: float
    cfar: float
    shadow: float


@dataclass(frozen=True, slots=True)
class Candidate:
    """A peak of the matched filter with its class probabilities.

    Attributes:
        peak: The peak.
        p_mine_like: Probability of a mine-like object, 0 to 1.
        p_other_object: Probability of another object on the bottom, 0 to 1.
    """

    peak: Peak
    p_mine_like: float
    p_other_object: float

    @property
    def confidence(self) -> float:
        """Twice the probability of a mine-like object: 0 to 2."""
        return 2.0 * self.p_mine_like


def classified_candidates(
    response: MatchedResponse, grid: LevelGrid, settings: DetectorSettings, classifier: Classifier
) -> list[Candidate]:
    """Return the candidates of one side of a survey, or of an image, strongest matched-filter response first.

    At most 400 for each 1000 pings.
    """
    found = candidate_peaks(response, grid, settings)
    if not found:
        return []
    probabilities = classifier.probabilities(ChipCutter(grid).chips(found)).tolist()
    return [Candidate(k, p[MINE_LIKE_OBJECT], p[OTHER_OBJECT]) for k, p in zip(found, probabilities, strict=True)]


def candidate_peaks(response: MatchedResponse, grid: LevelGrid, settings: DetectorSettings) -> tuple[Peak, ...]:
    """Return the peaks that are classified, strongest first."""
    limit = math.ceil(_MAX_PER_1000_PINGS * max(1.0, len(grid.level) / 1000))
    return peaks(response, grid, settings, settings.min_matched_response)[:limit]


@dataclass(frozen=True, slots=True)
class PlacedCandidate:
    """The most confident candidate of an object, measured."""

    candidate: Candidate
    measurement: Measurement


def distinct_candidates(
    candidates: Sequence[Candidate], grid: LevelGrid, settings: DetectorSettings, lowest: float
) -> list[PlacedCandidate]:
    """Keep the most confident candidate of every object, most confident first (non-maximum suppression).

    Its highlight and shadow are measured at the candidate around it with the greatest product of probability and
    matched-filter response: the network recognises an object also from a place beside it.

    Two candidates are one object if their highlights lie within `separation_along_m` and `separation_across_m` of
    each other, or if the highlight of one lies in the shadow of the other.

    Args:
        candidates: All candidates of one side.
        grid: That side.
        settings: Separation of objects.
        lowest: Minimum confidence.
    """
    along_m = np.array([c.peak.row for c in candidates]) * grid.row_along_m
    across_m = np.array([c.peak.cell for c in candidates]) * grid.cell_across_m
    strength = np.array([c.p_mine_like * c.peak.score for c in candidates])
    kept: list[PlacedCandidate] = []
    order = sorted(range(len(candidates)), key=lambda i: (-candidates[i].p_mine_like, i))
    for index in order:
        one = candidates[index]
        if one.confidence < lowest:
            break
        if any(_is_near(one.peak.row, one.peak.cell, other.measurement, grid, settings) for other in kept):
            continue
        near = np.abs(along_m - along_m[index]) < settings.separation_along_m
        near &= np.abs(across_m - across_m[index]) < settings.separation_across_m
        strongest = candidates[int(np.argmax(np.where(near, strength, -1.0)))]
        measurement = measure(grid, strongest.peak, settings)
        if measurement is None:
            continue
        if not any(_is_same_object(measurement, other.measurement, grid, settings) for other in kept):
            kept.append(PlacedCandidate(one, measurement))
    return kept


def _is_near(row: int, cell: int, other: Measurement, grid: LevelGrid, settings: DetectorSettings) -> bool:
    along_m = abs(row - other.row) * grid.row_along_m
    across_m = abs(cell - other.cell) * grid.cell_across_m
    return along_m < settings.separation_along_m and across_m < settings.separation_across_m


def _is_same_object(one: Measurement, other: Measurement, grid: LevelGrid, settings: DetectorSettings) -> bool:
    end_of_one, end_of_other = one.cells[1] + one.shadow_cells, other.cells[1] + other.shadow_cells
    has_common_row = one.rows[0] <= other.rows[1] and other.rows[0] <= one.rows[1]
    if has_common_row and one.cells[0] < end_of_other and other.cells[0] < end_of_one:
        return True
    return _is_near(one.row, one.cell, other, grid, settings)


def measure(grid: LevelGrid, peak: Peak, settings: DetectorSettings) -> Measurement | None:
    """Measure highlight and shadow at a peak of the matched filter; None if too little seabed surrounds it."""
    ring = _ring_levels(grid, peak, settings)
    if ring.size < _MIN_RING_CELLS:
        return None
    seabed = float(np.median(ring))
    deviation = max(1.4826 * float(np.median(np.abs(ring - seabed))), 0.1)
    rows, cells = _highlight_extent(grid, peak, seabed, deviation)
    length, is_cut, depth, dark_fraction = _shadow(grid, rows, cells, seabed, deviation)
    return Measurement(
        row=(rows[0] + rows[1] - 1) // 2,
        cell=(cells[0] + cells[1] - 1) // 2,
        rows=rows,
        cells=cells,
        shadow_cells=length,
        shadow_is_cut=is_cut,
        scores=FilterScores(
            matched=peak.score,
            cfar=max(0.0, (_highlight_mean(grid.level, peak) - seabed) / deviation),
            shadow=max(0.0, depth) * dark_fraction,
        ),
    )


def _highlight_mean(level: FloatImage, peak: Peak) -> float:
    top = max(0, peak.row - peak.highlight_rows // 2)
    left = max(0, peak.cell - peak.highlight_cells // 2)
    return float(np.nanmean(level[top : top + peak.highlight_rows, left : left + peak.highlight_cells]))


def _ring_levels(grid: LevelGrid, peak: Peak, settings: DetectorSettings) -> FloatImage:
    """Return the levels of the seabed around the highlight, without a guard band and the strip of its shadow."""
    guard_rows = max(1, round(settings.guard_m / grid.row_along_m)) + peak.highlight_rows // 2
    guard_cells = max(1, round(settings.guard_m / grid.cell_across_m)) + peak.highlight_cells // 2
    far_rows = guard_rows + max(2, round(settings.ring_m / grid.row_along_m))
    far_cells = guard_cells + max(4, round(settings.ring_m / grid.cell_across_m))
    top, left = max(0, peak.row - far_rows), max(0, peak.cell - far_cells)
    patch = grid.level[top : peak.row + far_rows + 1, left : peak.cell + far_cells + 1]
    row = np.arange(top, top + patch.shape[0])[:, None] - peak.row
    cell = np.arange(left, left + patch.shape[1])[None, :] - peak.cell
    excluded = (np.abs(row) <= guard_rows) & (cell >= -guard_cells)  # guard band and everything behind it
    values: FloatImage = patch[~excluded & np.isfinite(patch)]
    return values


def _highlight_extent(
    grid: LevelGrid, peak: Peak, seabed: float, deviation: float
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the bounds of the connected cells around the peak that exceed half of its height above the seabed."""
    reach_rows = max(3, round(6.0 / grid.row_along_m))
    reach_cells = max(6, round(4.0 / grid.cell_across_m))
    top, left = max(0, peak.row - reach_rows), max(0, peak.cell - reach_cells)
    patch = grid.level[top : peak.row + reach_rows + 1, left : peak.cell + reach_cells + 1]
    # Smoothing over half the highlight size of the filter: speckle must not split a large highlight.
    size = (max(1, peak.highlight_rows // 2), max(3, peak.highlight_cells // 2))
    smooth = ndimage.uniform_filter(np.nan_to_num(patch, nan=seabed), size=size, mode="nearest")
    row, cell = peak.row - top, peak.cell - left
    near = (slice(max(0, row - 1), row + 2), slice(max(0, cell - 2), cell + 3))
    start = np.unravel_index(int(np.argmax(smooth[near])), smooth[near].shape)
    row, cell = near[0].start + int(start[0]), near[1].start + int(start[1])
    threshold = seabed + max(0.5 * (float(smooth[row, cell]) - seabed), deviation)
    labels, _ = ndimage.label(smooth >= threshold)
    if labels[row, cell] == 0:
        return (peak.row, peak.row + 1), (peak.cell, peak.cell + 1)
    region = labels == labels[row, cell]
    rows, cells = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    return (top + int(rows[0]), top + int(rows[-1]) + 1), (left + int(cells[0]), left + int(cells[-1]) + 1)


def _shadow(
    grid: LevelGrid, rows: tuple[int, int], cells: tuple[int, int], seabed: float, deviation: float
) -> tuple[int, bool, float, float]:
    """Return length in cells, whether it is cut, depth in deviations and dark fraction of the shadow."""
    middle = (rows[0] + rows[1]) // 2
    half = max(0, (rows[1] - rows[0]) // 4)  # the middle half: a shadow narrows at its ends
    behind = grid.level[max(0, middle - half) : middle + half + 1, cells[1] :]
    valid = np.isfinite(behind).all(axis=0)
    end = int(np.argmin(valid)) if not valid.all() else valid.size
    if end < 2:
        return 0, False, 0.0, 0.0
    behind = behind[:, :end]
    profile = ndimage.uniform_filter1d(behind.mean(axis=0), size=3, mode="nearest")
    dark = profile < seabed - deviation
    max_gap = max(1, round(_SHADOW_GAP_M / grid.cell_across_m))
    first, last = _dark_run(dark, round(_SHADOW_START_M / grid.cell_across_m), max_gap)
    if last <= first:
        return 0, False, 0.0, 0.0
    depth = (seabed - float(behind[:, first:last].mean())) / deviation
    dark_fraction = float((behind[:, first:last] < seabed - 0.5 * deviation).mean())
    return last, last == end, depth, dark_fraction


def _dark_run(dark: Flags, start_within: int, max_gap: int) -> tuple[int, int]:
    """Return the first dark cell up to `start_within`, and one past the last before a gap above `max_gap`."""
    begin = np.flatnonzero(dark[: start_within + 1])
    if begin.size == 0:
        return 0, 0
    first = int(begin[0])
    places = np.flatnonzero(dark[first:]) + first
    breaks = np.flatnonzero(np.diff(places) > max_gap + 1)
    last = int(places[breaks[0]] if breaks.size else places[-1]) + 1
    return first, last
