"""Normalisation of a survey: despeckling, water-column mask, division by the median echo at the same range.

The raw echo decreases with range and grazing angle, speckle is multiplicative, and the water column is black. Each
side therefore becomes a grid of *levels*: the base-2 logarithm of the echo over the median echo at the same range in
the surrounding pings. Level 0 is ordinary seabed, +1 twice its echo, -1 half of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.detection.settings import DetectorSettings
from sonarpost.limits import limit
from sonarpost.sonar.bottom_track import altitudes_m
from sonarpost.sonar.geometry import ping_spacing_m
from sonarpost.sonar.survey import FloatImage, Side, Survey

IntVector = npt.NDArray[np.int64]
FloatVector = npt.NDArray[np.float64]
FloatTable = npt.NDArray[np.float64]

MIN_ROW_M: Final = limit(
    0.001, "m", "claims", "recording", "recording", "mean distance between pings", "that of the settings is used"
)
_EXCLUDED_RISE = -4.0
"""Rise in octaves that excludes a cell from the bottom path."""
_NEAR_SEABED_M: Final = 5.0
_WATER_MARGIN_M: Final = 0.6
"""Distance before the first bottom return that does not count as water."""


@dataclass(frozen=True, slots=True)
class LevelGrid:
    """One side of a survey, normalised for the filters.

    Attributes:
        side: Port or starboard.
        level: Shape (pings, cells), float32, base-2 logarithm of echo over local median; NaN in the water column,
            beyond the end of a ping, and in a ping without this channel. Column 0 is nearest the vehicle.
        first_return_cell: Shape (pings,), the cell of the first bottom return, where slant range equals altitude.
        samples_per_cell: Number of file samples averaged into one cell.
        cell_across_m: Slant range of one cell.
        row_along_m: Distance between two pings.
        row_is_measured: False if the file has no speed or track and `row_along_m` is the assumed one.
        water_echo: Shape (pings, cells up to the greatest first return), float32: echo in the water above that of the
            usual ping at this range, over the median echo of the nearest 5 m of seabed; 0 outside the water. None for
            an image.
    """

    side: Side
    level: FloatImage
    first_return_cell: IntVector
    samples_per_cell: int
    cell_across_m: float
    row_along_m: float
    row_is_measured: bool
    water_echo: FloatImage | None = None


def levels_of_ratio(ratio: FloatImage) -> FloatImage:
    """Return the base-2 logarithm of an echo ratio, float32, limited to -4..4."""
    return np.clip(np.log2(np.maximum(ratio, 2.0**-6)), -4.0, 4.0).astype(np.float32)


def normalise_side(
    survey: Survey, side: Side, settings: DetectorSettings, altitude_m: FloatVector | None = None
) -> LevelGrid | None:
    """Return one side of a survey as a level grid.

    Args:
        survey: The recording.
        side: Port or starboard.
        settings: Cell size, windows and margins.
        altitude_m: Altitude of every ping, shape (pings,), float64, NaN if unknown; None: from
            `sonarpost.sonar.bottom_track.altitudes_m`.

    Returns:
        The grid; None if the side has no channel, only zeros, or fewer than 16 cells.
    """
    spacing_m = _sample_spacing_m(survey, side)
    if spacing_m is None:
        return None
    samples_per_cell = max(1, round(settings.cell_across_m / spacing_m))
    amplitude = _averaged_cells(_despeckled(survey.waterfall(side)), samples_per_cell)
    if amplitude.shape[1] < 16 or not np.isfinite(amplitude).any():
        return None
    measured_m = ping_spacing_m(survey)
    if measured_m is not None and measured_m < MIN_ROW_M:
        measured_m = None
    cell_m = spacing_m * samples_per_cell
    if altitude_m is None:
        altitude_m = altitudes_m(survey)
    first_return = _first_return_cells(amplitude, altitude_m / cell_m, cell_m, settings)
    # The margin covers the glare of the first return; its slant range may be two percent too short.
    margin = max(1, round(settings.bottom_margin_m / cell_m))
    bottom = np.minimum((first_return * 1.02).astype(np.int64) + margin, amplitude.shape[1])
    water = amplitude[:, : int(first_return.max()) + 1].copy()
    amplitude[np.arange(amplitude.shape[1])[None, :] < bottom[:, None]] = np.nan
    near = np.arange(amplitude.shape[1])[None, :] < (bottom + round(_NEAR_SEABED_M / cell_m))[:, None]
    near &= np.isfinite(amplitude)
    near_seabed = float(np.median(amplitude[near])) if near.any() else math.inf
    ratio = _ratio_to_range_median(amplitude, settings.median_window_pings)
    if ratio is None:
        return None
    return LevelGrid(
        side=side,
        level=levels_of_ratio(ratio),
        first_return_cell=first_return,
        samples_per_cell=samples_per_cell,
        cell_across_m=cell_m,
        row_along_m=measured_m if measured_m is not None else settings.assumed_row_along_m,
        row_is_measured=measured_m is not None,
        water_echo=_water_echo(water, first_return, near_seabed, cell_m, settings),
    )


def _water_echo(
    amplitude: FloatImage, first_return: IntVector, seabed: float, cell_m: float, settings: DetectorSettings
) -> FloatImage:
    """Return the echo in the water; see `LevelGrid.water_echo`.

    The median over all pings is subtracted: ringing of the transducer and the echo of the surface stay at one range.
    """
    cells = np.arange(amplitude.shape[1])[None, :]
    end = first_return * 0.97 - max(1, round(_WATER_MARGIN_M / cell_m))
    is_water = (cells < end[:, None]) & (cells >= round(settings.blanking_m / cell_m)) & np.isfinite(amplitude)
    usual = _filled(_column_medians(np.where(is_water, amplitude, np.nan))[None], 0.0)
    excess = (amplitude - usual) / max(seabed, 1e-6)
    return np.asarray(np.where(is_water, excess, 0.0), dtype=np.float32)


def _sample_spacing_m(survey: Survey, side: Side) -> float | None:
    spacings = [c.sample_spacing_m for c in survey.channels(side) if c.samples.shape[0] > 0]
    usable = [s for s in spacings if np.isfinite(s) and s > 0]
    return float(np.median(usable)) if usable else None


def _despeckled(image: FloatImage) -> FloatImage:
    """Return the across-track median of three samples; a sample next to NaN stays, a NaN sample stays NaN."""
    if image.shape[1] < 3:
        return image
    left, middle, right = image[:, :-2], image[:, 1:-1], image[:, 2:]
    out = image.copy()
    median = np.maximum(np.minimum(left, middle), np.minimum(np.maximum(left, middle), right))
    out[:, 1:-1] = np.where(np.isfinite(median), median, middle)
    return out


def _averaged_cells(image: FloatImage, samples_per_cell: int) -> FloatImage:
    """Average neighbouring samples; a cell is NaN if any of its samples is."""
    width = image.shape[1] // samples_per_cell
    cells = image[:, : width * samples_per_cell].reshape(image.shape[0], width, samples_per_cell)
    mean: FloatImage = cells.mean(axis=2)
    return mean


def _first_return_cells(
    amplitude: FloatImage, altitude_cells: FloatVector, cell_m: float, settings: DetectorSettings
) -> IntVector:
    """Return the cell of the first bottom return of each ping.

    It lies on the path of greatest total rise of the level that moves at most three cells a ping. A known altitude
    limits the path to within 30 percent, because transducer, beam and altimeter are at different places and the
    bottom slopes.
    """
    pings, cells = amplitude.shape
    rise = _level_rise(amplitude, max(3, round(settings.bottom_step_m / cell_m)))
    rise[:, : max(1, round(settings.blanking_m / cell_m))] = _EXCLUDED_RISE
    known = np.flatnonzero(np.isfinite(altitude_cells) & (altitude_cells > 0))
    if known.size:
        expected = np.interp(np.arange(pings), known, altitude_cells[known])[:, None]
        columns = np.arange(cells)[None, :]
        rise[(columns < 0.7 * expected - 3) | (columns > 1.3 * expected + 3)] = _EXCLUDED_RISE
    return _best_path(rise, max_step=3)


def _level_rise(amplitude: FloatImage, step: int) -> FloatImage:
    """Return the mean log level of the next `step` cells minus that of the previous `step` cells, in octaves."""
    level = np.log2(np.nan_to_num(amplitude, nan=0.0) + 1.0)
    sums = np.concatenate([np.zeros((level.shape[0], 1)), np.cumsum(level, axis=1, dtype=np.float64)], axis=1)
    cells = level.shape[1]
    at = np.arange(cells)
    before, after = np.maximum(at - step, 0), np.minimum(at + step, cells)
    ahead = (sums[:, after] - sums[:, at]) / np.maximum(after - at, 1)
    behind = (sums[:, at] - sums[:, before]) / np.maximum(at - before, 1)
    rise: FloatImage = (ahead - behind).astype(np.float32)
    return rise


def _best_path(gain: FloatImage, max_step: int) -> IntVector:
    """Return one column per row with the greatest total gain (dynamic programming).

    Columns of neighbouring rows differ by at most `max_step`.
    """
    rows, cells = gain.shape
    total = gain[0].astype(np.float64)
    predecessor = np.zeros((rows, cells), dtype=np.int64)
    columns = np.arange(cells)
    for row in range(1, rows):
        padded = np.pad(total, max_step, constant_values=-np.inf)
        choice = np.argmax(np.lib.stride_tricks.sliding_window_view(padded, 2 * max_step + 1), axis=1)
        predecessor[row] = columns + choice - max_step
        total = total[predecessor[row]] + gain[row]
    path = np.empty(rows, dtype=np.int64)
    path[-1] = int(np.argmax(total))
    for row in range(rows - 1, 0, -1):
        path[row - 1] = predecessor[row, path[row]]
    return path


def _ratio_to_range_median(amplitude: FloatImage, window_pings: int) -> FloatImage | None:
    """Divide by the median echo at the same range over a sliding window of pings; None if every echo is zero.

    The median is computed every half window and interpolated between. A range without seabed in a window uses the
    value of the nearest window, or of the nearest range.
    """
    pings = amplitude.shape[0]
    half = max(1, window_pings // 2)
    centres = np.unique(np.append(np.arange(0, pings, half), pings - 1))
    table = np.stack([_column_medians(amplitude[max(0, c - half) : c + half + 1]) for c in centres])
    positive = table[np.isfinite(table) & (table > 0)]
    if positive.size == 0:
        return None
    table = _smoothed_across(_filled(table, float(np.median(positive))), 5)
    floor = 0.01 * float(np.median(positive))
    lower = np.searchsorted(centres, np.arange(pings), side="right") - 1
    upper = np.minimum(lower + 1, len(centres) - 1)
    gap = np.maximum(centres[upper] - centres[lower], 1)
    weight = ((np.arange(pings) - centres[lower]) / gap)[:, None]
    reference = table[lower] * (1 - weight) + table[upper] * weight
    ratio: FloatImage = (amplitude / np.maximum(reference, floor)).astype(np.float32)
    return ratio


def _column_medians(block: FloatImage) -> FloatTable:
    """Return the median of the finite values of each column; NaN if fewer than a quarter are finite."""
    ordered = np.sort(block, axis=0)  # NaN sorts last
    count = np.isfinite(block).sum(axis=0)
    middle: FloatTable = ordered[np.maximum(count - 1, 0) // 2, np.arange(block.shape[1])].astype(np.float64)
    middle[count < max(1, block.shape[0] // 4)] = np.nan
    return middle


def _filled(table: FloatTable, fallback: float) -> FloatTable:
    """Interpolate over NaN along the windows first, then along range; `fallback` for what remains."""
    out = table.copy()
    for axis_view in (out.T, out):
        for line in axis_view:
            finite = np.isfinite(line)
            if finite.any() and not finite.all():
                line[~finite] = np.interp(np.flatnonzero(~finite), np.flatnonzero(finite), line[finite])
    out[~np.isfinite(out)] = fallback
    return out


def _smoothed_across(table: FloatTable, width: int) -> FloatTable:
    padded = np.pad(table, ((0, 0), (width // 2, width // 2)), mode="edge")
    smooth: FloatTable = np.lib.stride_tricks.sliding_window_view(padded, width, axis=1).mean(axis=2)
    return smooth
