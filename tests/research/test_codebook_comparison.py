"""How two codebooks differ."""

import numpy as np
import pytest
from scipy.linalg import subspace_angles

from research.codebook.basis import database_of
from research.codebook.comparison import compare, principal_angles_deg
from sonarpost.codec.vq.tiles import TileDatabase
from sonarpost.errors import CodebookError


def database(seed: int, count: int = 60, tile_px: int = 8) -> TileDatabase:
    rng = np.random.default_rng(seed)
    return database_of(tile_px, rng.integers(0, 256, (count, tile_px**2), dtype=np.uint8), 20)


def test_codebook_equals_itself_and_other_tile_sizes_are_rejected() -> None:
    one = database(0)
    difference = compare(one, one)
    assert difference.same_identity
    assert difference.same_numbers == difference.common == 60
    assert difference.first.only_here == difference.second.only_here == 0
    assert difference.first.rms_max == 0.0
    assert difference.angle_max_deg == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(CodebookError, match="tile_px"):
        compare(one, database(0, tile_px=9))


def test_tiles_of_one_codebook_only_are_counted_and_measured() -> None:
    one = database(0)
    other_tiles = one.tiles.copy()
    other_tiles[7] = np.where(other_tiles[7] < 128, other_tiles[7] + 5, other_tiles[7] - 5)  # 5 grey levels away
    other = database_of(8, np.concatenate((other_tiles[::-1], other_tiles[:3])), 20)
    difference = compare(one, other)
    assert not difference.same_identity
    assert difference.common == 59
    assert (difference.first.only_here, difference.second.only_here) == (1, 1)
    assert (difference.first.tiles, difference.second.tiles) == (60, 60)  # the second has three of them twice
    assert difference.first.rms_max == pytest.approx(5.0)
    assert difference.second.rms_max == pytest.approx(5.0)
    assert difference.first.rms_median == 0.0
    assert difference.same_numbers == 0


def test_variance_fraction_of_a_basis() -> None:
    rng = np.random.default_rng(3)
    grey = rng.integers(20, 236, (50, 1)).astype(np.uint8)
    one = database_of(8, np.repeat(grey, 64, axis=1), 5)  # flat tiles: one dimension
    step = np.repeat(np.array([1, -1]), 32) * rng.integers(-90, 90, (50, 1)) + 128
    other = database_of(8, step.astype(np.uint8), 5)  # two opposite halves with the same mean
    difference = compare(one, other)
    assert difference.first.variance_own == pytest.approx(1.0, abs=1e-4)
    assert difference.first.variance_other == pytest.approx(0.0, abs=1e-4)
    assert difference.second.variance_other == pytest.approx(0.0, abs=1e-4)
    assert difference.angle_max_deg == pytest.approx(90.0, abs=0.1)


def test_principal_angles_are_those_of_scipy() -> None:
    rng = np.random.default_rng(5)
    for rows, other_rows in ((3, 3), (2, 5), (6, 4)):
        first = rng.integers(-3000, 3000, (rows, 16)).astype(np.int16)
        second = rng.integers(-3000, 3000, (other_rows, 16)).astype(np.int16)
        second[0] = first[0]
        expected = np.degrees(subspace_angles(first.T.astype(float), second.T.astype(float)))
        expected[-1] = 0.0  # the common row; SciPy returns up to 2e-6
        assert principal_angles_deg(first, second) == pytest.approx(expected, abs=1e-6)
