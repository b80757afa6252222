"""From raw samples to a level picture in which the seabed is flat: despeckled, range-normalised, water masked.

A side-scan waterfall cannot be thresholded as it is: the echo falls with range and grazing angle, speckle is
multiplicative, and the water column is black. Here each side becomes a grid of *levels*: the base-2 logarithm of the
echo over the median echo at the same range in the surrounding pings. A level of 0 is ordinary seabed, +1 twice its
echo, -1 half of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.bottom_track import altitudes_m
from sonarpost.sonar.geometry import ping_spacing_m
from sonarpost.sonar.survey import FloatImage, Side, Survey

IntVector = npt.NDArray[np.int64]
FloatVector = npt.NDArray[np.float64]
FloatTable = npt.NDArray[np.float64]

# Gain, in octaves, of a path through a place where the bottom cannot be.
_NEVER = -4.0


@dataclass(frozen=True, slots=True)
class LevelGrid:
    """One side of a survey, ready for the filters.

    Attributes:
        side: Port or starboard.
        level: Shape (pings, cells), float32, base-2 logarithm of echo over local median; NaN in the water column,
            beyond the end of a ping, and where a ping has no such channel. Column 0 is nearest the vehicle.
        ratio: Same shape, the same before the logarithm (1.0 is ordinary seabed); NaN at the same cells.
        bottom_cell: Shape (pings,), the first cell that is seabed (equal to the number of cells if none is).
        first_return_cell: Shape (pings,), the cell of the first bottom return, where the slant range is the altitude.
        samples_per_cell: How many of the file's samples make one cell.
        cell_across_m: Slant range covered by one cell, in metres.
        row_along_m: Travel between two pings, in metres.
        row_is_measured: False when the file gives no speed or track and `row_along_m` is the assumed one.
    """

    side: Side
    level: FloatImage
    ratio: FloatImage
    bottom_cell: IntVector
    first_return_cell: IntVector
    samples_per_cell: int
    cell_across_m: float
    row_along_m: float
    row_is_measured: bool


def preprocess(
    survey: Survey, side: Side, settings: DetectorSettings, altitude_m: FloatVector | None = None
) -> LevelGrid | None:
    """Return one side of a survey as a level grid, or None when the survey has no usable samples on that side.

    A side is unusable when it has no channel, nothing but zeros, or fewer samples than one filter needs.

    Args:
        survey: The recording.
        side: Port or starboard.
        settings: How to look.
        altitude_m: Height over the bottom of every ping, shape (pings,), float64, NaN where not known; from
            `sonarpost.sonar.bottom_track.altitudes_m` when None.
    """
    spacing_m = _sample_spacing_m(survey, side)
    if spacing_m is None:
        return None
    per_cell = max(1, round(settings.cell_across_m / spacing_m))
    amplitude = _cells(_despeckled(survey.waterfall(side)), per_cell)
    if amplitude.shape[1] < 16 or not np.isfinite(amplitude).any():
        return None
    measured_m = ping_spacing_m(survey)
    cell_m = spacing_m * per_cell
    if altitude_m is None:
        altitude_m = altitudes_m(survey)
    first_return = _first_return_cells(amplitude, altitude_m / cell_m, cell_m, settings)
    # A little farther: the first return's glare, and the two percent by which its slant range may be off.
    margin = max(1, round(settings.bottom_margin_m / cell_m))
    bottom = np.minimum((first_return * 1.02).astype(np.int64) + margin, amplitude.shape[1])
    amplitude[np.arange(amplitude.shape[1])[None, :] < bottom[:, None]] = np.nan
    ratio = _over_range_median(amplitude, settings.median_window_pings)
    if ratio is None:
        return None
    return LevelGrid(
        side=side,
        level=np.clip(np.log2(np.maximum(ratio, 2.0**-6)), -4.0, 4.0).astype(np.float32),
        ratio=ratio,
        bottom_cell=bottom,
        first_return_cell=first_return,
        samples_per_cell=per_cell,
        cell_across_m=cell_m,
        row_along_m=measured_m if measured_m is not None else settings.assumed_row_along_m,
        row_is_measured=measured_m is not None,
    )


def _sample_spacing_m(survey: Survey, side: Side) -> float | None:
    spacings = [c.sample_spacing_m for c in survey.channels(side) if c.samples.shape[0] > 0]
    usable = [s for s in spacings if np.isfinite(s) and s > 0]
    return float(np.median(usable)) if usable else None


def _despeckled(image: FloatImage) -> FloatImage:
    """Median of three samples across-track: single-sample spikes go, edges stay; NaN only where the sample is."""
    if image.shape[1] < 3:
        return image
    left, middle, right = image[:, :-2], image[:, 1:-1], image[:, 2:]
    out = image.copy()
    median = np.maximum(np.minimum(left, middle), np.minimum(np.maximum(left, middle), right))
    out[:, 1:-1] = np.where(np.isfinite(median), median, middle)
    return out


def _cells(image: FloatImage, per_cell: int) -> FloatImage:
    """Average `per_cell` neighbouring samples; a cell is NaN when any of its samples is."""
    width = image.shape[1] // per_cell
    cells: FloatImage = image[:, : width * per_cell].reshape(image.shape[0], width, per_cell).mean(axis=2)
    return cells


def _first_return_cells(
    amplitude: FloatImage, altitude_cells: FloatVector, cell_m: float, settings: DetectorSettings
) -> IntVector:
    """Return the cell of each ping's first bottom return on this side.

    It is the largest rise of level along range that is also continuous along-track (a path of greatest total rise,
    moving at most three cells a ping). Where an altitude is known the path is held to within 30 percent of it, because
    a transducer, a beam and an altimeter do not sit at the same place and a bottom slopes.
    """
    pings, cells = amplitude.shape
    rise = _rise(amplitude, max(3, round(settings.bottom_step_m / cell_m)))
    rise[:, : max(1, round(settings.blanking_m / cell_m))] = _NEVER
    known = np.flatnonzero(np.isfinite(altitude_cells) & (altitude_cells > 0))
    if known.size:
        expected = np.interp(np.arange(pings), known, altitude_cells[known])[:, None]
        columns = np.arange(cells)[None, :]
        rise[(columns < 0.7 * expected - 3) | (columns > 1.3 * expected + 3)] = _NEVER
    return _best_path(rise, step=3)


def _rise(amplitude: FloatImage, step: int) -> FloatImage:
    """Rise of the mean log level from the `step` cells before to the `step` cells from each cell on, in octaves."""
    level = np.log2(np.nan_to_num(amplitude, nan=0.0) + 1.0)
    sums = np.concatenate([np.zeros((level.shape[0], 1)), np.cumsum(level, axis=1, dtype=np.float64)], axis=1)
    cells = level.shape[1]
    at = np.arange(cells)
    before, after = np.maximum(at - step, 0), np.minimum(at + step, cells)
    ahead = (sums[:, after] - sums[:, at]) / np.maximum(after - at, 1)
    behind = (sums[:, at] - sums[:, before]) / np.maximum(at - before, 1)
    rise: FloatImage = (ahead - behind).astype(np.float32)
    return rise


def _best_path(gain: FloatImage, step: int) -> IntVector:
    """Return one column per row so that the summed gain is greatest and neighbours differ by at most `step`."""
    rows, cells = gain.shape
    total = gain[0].astype(np.float64)
    came_from = np.zeros((rows, cells), dtype=np.int64)
    columns = np.arange(cells)
    for row in range(1, rows):
        padded = np.pad(total, step, constant_values=-np.inf)
        choice = np.argmax(np.lib.stride_tricks.sliding_window_view(padded, 2 * step + 1), axis=1)
        came_from[row] = columns + choice - step
        total = total[came_from[row]] + gain[row]
    path = np.empty(rows, dtype=np.int64)
    path[-1] = int(np.argmax(total))
    for row in range(rows - 1, 0, -1):
        path[row - 1] = came_from[row, path[row]]
    return path


def _over_range_median(amplitude: FloatImage, window_pings: int) -> FloatImage | None:
    """Divide by the median echo at the same range over a sliding window of pings; None when every echo is zero.

    The median is taken every half window and interpolated between. A range bin that a window never saw as seabed
    takes the nearest window's value, or the nearest range's.
    """
    pings, cells = amplitude.shape
    half = max(1, window_pings // 2)
    centres = np.unique(np.append(np.arange(0, pings, half), pings - 1))
    table = np.stack([_column_medians(amplitude[max(0, c - half) : c + half + 1]) for c in centres])
    positive = table[np.isfinite(table) & (table > 0)]
    if positive.size == 0:
        return None
    table = _filled(table, float(np.median(positive)))
    table = _smoothed_across(table, 5)
    floor = 0.01 * float(np.median(positive))
    where = np.searchsorted(centres, np.arange(pings), side="right") - 1
    upper = np.minimum(where + 1, len(centres) - 1)
    gap = np.maximum(centres[upper] - centres[where], 1)
    weight = ((np.arange(pings) - centres[where]) / gap)[:, None]
    reference = table[where] * (1 - weight) + table[upper] * weight
    ratio: FloatImage = (amplitude / np.maximum(reference, floor)).astype(np.float32)
    assert ratio.shape == (pings, cells)
    return ratio


def _column_medians(block: FloatImage) -> FloatTable:
    """Median of the finite values of each column; NaN for a column with fewer than a quarter of them."""
    ordered = np.sort(block, axis=0)  # NaN sorts last
    count = np.isfinite(block).sum(axis=0)
    middle: FloatTable = ordered[np.maximum(count - 1, 0) // 2, np.arange(block.shape[1])].astype(np.float64)
    middle[count < max(1, block.shape[0] // 4)] = np.nan
    return middle


def _filled(table: FloatTable, fallback: float) -> FloatTable:
    """Fill NaN along the windows first, then along range, then with `fallback`."""
    out = table.copy()
    for axis_view in (out.T, out):
        for line in axis_view:
            good = np.isfinite(line)
            if good.any() and not good.all():
                line[~good] = np.interp(np.flatnonzero(~good), np.flatnonzero(good), line[good])
    out[~np.isfinite(out)] = fallback
    return out


def _smoothed_across(table: FloatTable, width: int) -> FloatTable:
    padded = np.pad(table, ((0, 0), (width // 2, width // 2)), mode="edge")
    smooth: FloatTable = np.lib.stride_tricks.sliding_window_view(padded, width, axis=1).mean(axis=2)
    return smooth
