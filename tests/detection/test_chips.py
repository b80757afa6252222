"""Chips: projection to the seabed, windows, coarse plane, geometry values."""

from dataclasses import replace

import numpy as np
import pytest

from sonarpost.detection.chips import (
    COARSE_CENTRE,
    COARSE_STEP,
    FINE_CENTRE,
    PIXEL_M,
    ChipCutter,
    coarse_planes,
    ground_plane,
)
from sonarpost.detection.matched_filter import Peak
from sonarpost.detection.normalisation import LevelGrid
from sonarpost.errors import SurveyFileError
from sonarpost.sonar.survey import Side


def grid_of(level, *, altitude_cells=0, cell_m=0.06, row_m=0.1):
    """Return a grid of these levels; cells before the altitude are water."""
    level = np.array(level, dtype=np.float32)
    level[:, :altitude_cells] = np.nan
    first = np.full(len(level), altitude_cells, dtype=np.int64)
    return LevelGrid(Side.PORT, level, first, 2, cell_m, row_m, row_is_measured=True)


def square_on_the_seabed(altitude_m, cell_m, row_m, ground_m=12.0, along_m=10.0, side_m=1.0):
    """Return a grid with level 2 on a square of the seabed, 0 elsewhere."""
    rows, cells = round(20 / row_m), round(30 / cell_m)
    slant_m = (np.arange(cells) + 0.5) * cell_m
    ground = np.sqrt(np.maximum(slant_m**2 - altitude_m**2, 0))
    along = (np.arange(rows) + 0.5) * row_m
    inside = (abs(along - along_m)[:, None] < side_m / 2) & (abs(ground - ground_m)[None, :] < side_m / 2)
    return grid_of(np.where(inside, 2.0, 0.0), altitude_cells=round(altitude_m / cell_m), cell_m=cell_m, row_m=row_m)


@pytest.mark.parametrize(
    ("altitude_m", "row_m", "cell_m"), [(2.0, 0.05, 0.12), (2.0, 0.3, 0.03), (9.0, 0.1, 0.06), (9.0, 0.3, 0.12)]
)
def test_square_has_its_size_at_any_altitude_and_resolution(altitude_m, row_m, cell_m):
    plane = ground_plane(square_on_the_seabed(altitude_m, cell_m, row_m))
    area_m2 = plane.level.sum() / 2.0 * PIXEL_M**2
    assert area_m2 == pytest.approx(1.0, abs=0.2 + 2 * row_m)
    rows, columns = np.nonzero(plane.level > 1.0)
    assert rows.mean() * PIXEL_M == pytest.approx(10.0, abs=0.3)
    assert columns.mean() * PIXEL_M == pytest.approx(12.0, abs=0.3)
    slant_cell = int(np.hypot(12.0, altitude_m) / cell_m)
    row, column = plane.pixel_of(int(10.0 / row_m), slant_cell)
    assert (row, column) == (pytest.approx(80, abs=2), pytest.approx(96, abs=2))


@pytest.mark.parametrize(("row_m", "cell_m"), [(855.0, 0.1), (0.1, 200.0)])
def test_pings_that_claim_more_seabed_than_they_have_samples_for_are_refused(row_m, cell_m):
    with pytest.raises(SurveyFileError, match="seabed of a strip: pixels"):
        ground_plane(grid_of(np.zeros((1000, 500)), row_m=row_m, cell_m=cell_m))


def test_unknown_cells_count_as_unknown_and_do_not_change_the_mean():
    grid = square_on_the_seabed(4.0, 0.06, 0.1)
    level = grid.level.copy()
    level[90:94] = np.nan
    plane = ground_plane(replace(grid, level=level))
    whole = ground_plane(grid)
    assert plane.known[73:74, 40:200].max() < 0.1
    assert plane.known[100, 60:200].min() > 0.99
    np.testing.assert_allclose(plane.level[100], whole.level[100], atol=1e-6)
    assert np.isfinite(plane.level).all()
    # An image is resampled without projection.
    level = np.zeros((100, 200), np.float32)
    level[40:60, 100:120] = 1.0
    plane = ground_plane(grid_of(level, cell_m=0.05, row_m=0.05))
    assert plane.level.shape == (40, 80)
    assert plane.level[20, 44] == pytest.approx(1.0)
    assert plane.pixel_of(50, 110) == (20, 44)


def test_chip_is_centred_and_unknown_beyond_the_survey():
    grid = square_on_the_seabed(4.0, 0.06, 0.1)
    row, cell = 100, int(np.hypot(12.0, 4.0) / 0.06)
    chips = ChipCutter(grid).chips([Peak(row, cell, 3.0, 4, 6), Peak(0, grid.level.shape[1] - 1, 3.0, 4, 6)])
    assert len(chips) == 2
    fine, coarse = chips.fine[0], chips.coarse[0]
    assert fine[FINE_CENTRE][0] == pytest.approx(1.0)
    assert fine[:, 40:, 0].max() == pytest.approx(0.0)
    assert fine[..., 1].min() > 0.99
    assert coarse[COARSE_CENTRE][0] == pytest.approx(1.0)
    assert (chips.fine[1][: FINE_CENTRE[0], :, 1] == 0).all(), "before the first ping"
    assert (chips.fine[1][:, FINE_CENTRE[1] + 3 :, 1] == 0).all(), "beyond the range"
    np.testing.assert_array_equal(chips.mirrored().fine[0], fine[::-1])
    assert len(ChipCutter(grid).chips([])) == 0


def test_coarse_pixel_is_mean_and_deviation_of_its_fine_pixels():
    rng = np.random.default_rng(0)
    level = rng.standard_normal((12, 16)).astype(np.float32)
    known = (rng.random((12, 16)) < 0.8).astype(np.float32)
    planes = coarse_planes(level, known)
    block = np.s_[4:8, 8:12]
    values = level[block][known[block] > 0]
    at = planes[4 + COARSE_STEP // 2, 8 + COARSE_STEP // 2]
    assert at == pytest.approx([values.mean() / 2, values.std() / 2, known[block].mean()], abs=1e-5)


def test_geometry_is_zero_without_altitude():
    with_altitude = ChipCutter(square_on_the_seabed(4.0, 0.06, 0.1)).chips([Peak(100, 210, 3.0, 4, 6)]).geometry[0]
    slant_m = 210.5 * 0.06
    altitude_m = round(4.0 / 0.06) * 0.06
    expected = [1.0, altitude_m / slant_m, (slant_m**2 - altitude_m**2) ** 0.5 / 50, altitude_m / 10, 0.4]
    assert with_altitude == pytest.approx(expected, abs=1e-5)
    image = ChipCutter(grid_of(np.zeros((100, 200)), cell_m=0.05, row_m=0.05)).chips([Peak(50, 100, 3.0, 4, 6)])
    assert image.geometry[0] == pytest.approx([0, 0, 0, 0, 0.2])
