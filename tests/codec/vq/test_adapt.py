"""Adapting a codebook to a seabed: which tiles go, which come, and what it is good for."""

from __future__ import annotations

import numpy as np
import pytest

from sonarpost.codec.vq.adaptation import EQUAL_PSNR_DB, adapt, measure, split
from sonarpost.codec.vq.tiles import TileDatabase, cut_tiles
from sonarpost.codec.vq.training_config import TrainingImage
from sonarpost.errors import ConfigError


def training(*pictures: np.ndarray) -> list[TrainingImage]:
    return [TrainingImage(f"picture {i}", lambda p=p: p) for i, p in enumerate(pictures)]


def flat(*levels: int, tile_px: int = 8) -> np.ndarray:
    return np.concatenate([np.full((tile_px, tile_px), level, np.uint8) for level in levels], axis=1)


def ripples(seed: int, side_px: int = 64) -> np.ndarray:
    """A bottom of waves 6 px long, of any phase, with speckle."""
    rng = np.random.default_rng(seed)
    along = np.arange(side_px) * 2 * np.pi / 6 + rng.uniform(0, 2 * np.pi)
    level = 90 + 60 * np.sin(along)[:, None] + 10 * rng.standard_normal((side_px, side_px))
    return np.clip(level, 0, 255).astype(np.uint8)


def speckle(seed: int, count: int = 120) -> TileDatabase:
    rng = np.random.default_rng(seed)
    return TileDatabase.from_tiles(8, np.clip(50 * rng.rayleigh(1.0, (count, 64)), 0, 255).astype(np.uint8))


def test_the_least_used_go_the_others_keep_their_numbers() -> None:
    # Levels 10 and 200 are like what the pictures show; 100 and 240 serve nothing.
    base = TileDatabase.from_tiles(8, cut_tiles(flat(240, 10, 100, 200), 8))
    pictures = training(np.full((24, 24), 12, np.uint8), np.full((24, 24), 180, np.uint8))
    adapted = adapt(base, pictures, max_tiles=4, keep=2, passes=0)
    assert adapted.used == 2
    assert adapted.tiles.tiles[1].tolist() == [10] * 64
    assert adapted.tiles.tiles[3].tolist() == [200] * 64
    held = {tile.tobytes() for tile in adapted.tiles.tiles}
    assert bytes([180] * 64) in held
    assert (adapted.replaced, adapted.new) == (2, 2)


def test_free_places_are_taken_before_any_tile_goes() -> None:
    base = TileDatabase.from_tiles(8, cut_tiles(flat(240, 10, 100, 200), 8))
    picture = np.tile(flat(12, 60, 150), (2, 1))
    adapted = adapt(base, training(picture), max_tiles=500, passes=0)
    assert np.array_equal(adapted.tiles.tiles[:4], base.tiles)
    assert adapted.replaced == 0
    assert adapted.new == len(adapted.tiles) - 4
    held = {tile.tobytes() for tile in adapted.tiles.tiles}
    assert all(bytes([level] * 64) in held for level in (12, 60, 150))


@pytest.mark.parametrize("keep", [0, 1, 60, 119, 120])
def test_as_many_stay_as_asked(keep: int) -> None:
    base = speckle(0)
    adapted = adapt(base, training(*[ripples(seed) for seed in range(4)]), max_tiles=120, keep=keep, passes=1)
    same = int((adapted.tiles.tiles == base.tiles).all(axis=1).sum())
    assert same >= keep
    assert len(adapted.tiles) == 120
    assert adapted.replaced == 120 - same
    assert len({tile.tobytes() for tile in adapted.tiles.tiles}) == 120


def test_it_serves_pictures_of_that_bottom_that_it_never_saw() -> None:
    base = speckle(1)
    learned, held_out = split(training(*[ripples(seed) for seed in range(12)]))
    adapted = adapt(base, learned, max_tiles=120).tiles
    before, after = measure(base, held_out), measure(adapted, held_out)
    assert len(before) == 3
    assert all(new.psnr_db > old.psnr_db + 3.0 for old, new in zip(before, after, strict=True))
    assert all(new.fom > old.fom + 20.0 for old, new in zip(before, after, strict=True))


def test_it_is_the_same_every_time_and_depends_on_the_images() -> None:
    base = speckle(2)
    pictures = training(*[ripples(seed) for seed in range(5)])
    assert adapt(base, pictures).tiles.identity == adapt(base, pictures).tiles.identity
    assert adapt(base, pictures).tiles.identity != adapt(base, pictures[1:]).tiles.identity


def test_pictures_that_the_base_rebuilds_exactly_change_nothing() -> None:
    base = TileDatabase.from_tiles(8, cut_tiles(flat(240, 10, 100, 200), 8))
    adapted = adapt(base, training(np.full((24, 24), 100, np.uint8)), keep=1, max_tiles=4)
    assert adapted.replaced == adapted.new == 0
    assert adapted.tiles.identity == base.identity
    assert measure(base, training(np.full((24, 24), 100, np.uint8)))[0].psnr_db == EQUAL_PSNR_DB


def test_the_last_quarter_is_held_out() -> None:
    images = training(*[ripples(seed, 16) for seed in range(9)])
    learned, held_out = split(images)
    assert [image.name for image in learned] == [f"picture {i}" for i in range(7)]
    assert [image.name for image in held_out] == ["picture 7", "picture 8"]
    assert [len(part) for part in split(images[:2])] == [1, 1]
    with pytest.raises(ConfigError, match="at least 2"):
        split(images[:1])


@pytest.mark.parametrize(
    ("field", "changes"),
    [("images", {"images": []}), ("max_tiles", {"max_tiles": 119}), ("keep", {"keep": -1}), ("keep", {"keep": 121})],
)
def test_numbers_out_of_range_are_refused(field: str, changes: dict[str, object]) -> None:
    arguments = {"images": training(ripples(0)), "max_tiles": 120} | changes
    with pytest.raises(ConfigError) as caught:
        adapt(speckle(3), **arguments)
    assert caught.value.field == field
