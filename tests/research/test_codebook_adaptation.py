"""Adaptation of a codebook to a seabed: replaced tiles, new tiles, and the gain."""

import numpy as np
import pytest

from research.codebook.adaptation import adapt
from research.codebook.basis import database_of
from research.codebook.builder import TrainingImage
from sonarpost.codec.vq.tiles import TileDatabase, cut_tiles


def training(*images: np.ndarray) -> list[TrainingImage]:
    return [TrainingImage(f"image {i}", lambda p=p: p) for i, p in enumerate(images)]


def flat(*levels: int, tile_px: int = 8) -> np.ndarray:
    return np.concatenate([np.full((tile_px, tile_px), level, np.uint8) for level in levels], axis=1)


def ripples(seed: int, side_px: int = 64) -> np.ndarray:
    """Return ripples of 6 px with a random phase, and speckle."""
    rng = np.random.default_rng(seed)
    along = np.arange(side_px) * 2 * np.pi / 6 + rng.uniform(0, 2 * np.pi)
    level = 90 + 60 * np.sin(along)[:, None] + 10 * rng.standard_normal((side_px, side_px))
    return np.clip(level, 0, 255).astype(np.uint8)


def speckle(seed: int, count: int = 120) -> TileDatabase:
    rng = np.random.default_rng(seed)
    return database_of(8, np.clip(50 * rng.rayleigh(1.0, (count, 64)), 0, 255).astype(np.uint8))


def test_least_used_tiles_are_replaced_and_others_keep_their_numbers() -> None:
    # Levels 10 and 200 are near those of the images; 100 and 240 are not used.
    base = database_of(8, cut_tiles(flat(240, 10, 100, 200), 8))
    images = training(np.full((24, 24), 12, np.uint8), np.full((24, 24), 180, np.uint8))
    adapted = adapt(base, images, max_tiles=4, keep=2, passes=0)
    assert adapted.used == 2
    assert adapted.tiles.tiles[1].tolist() == [10] * 64
    assert adapted.tiles.tiles[3].tolist() == [200] * 64
    stored = {tile.tobytes() for tile in adapted.tiles.tiles}
    assert bytes([180] * 64) in stored
    assert (adapted.replaced, adapted.new) == (2, 2)


def test_free_places_are_filled_first() -> None:
    base = database_of(8, cut_tiles(flat(240, 10, 100, 200), 8))
    image = np.tile(flat(12, 60, 150), (2, 1))
    adapted = adapt(base, training(image), max_tiles=500, passes=0)
    assert np.array_equal(adapted.tiles.tiles[:4], base.tiles)
    assert adapted.replaced == 0
    assert adapted.new == len(adapted.tiles) - 4
    stored = {tile.tobytes() for tile in adapted.tiles.tiles}
    assert all(bytes([level] * 64) in stored for level in (12, 60, 150))


@pytest.mark.parametrize("keep", [0, 30, 59, 60])
def test_requested_number_of_tiles_stays(keep: int) -> None:
    base = speckle(0, 60)
    adapted = adapt(base, training(*[ripples(seed, 32) for seed in range(4)]), max_tiles=60, keep=keep, passes=1)
    same = int((adapted.tiles.tiles == base.tiles).all(axis=1).sum())
    assert same >= keep
    assert len(adapted.tiles) == 60
    assert adapted.replaced == 60 - same
    assert len({tile.tobytes() for tile in adapted.tiles.tiles}) == 60
