"""Simulated pairs, measures against the scene, and classical filters."""

import numpy as np
import pytest

from research.common import images as image_sets
from research.common import speckle
from research.common.images import simulated_images
from research.common.nonlocal_means import reference_filtered
from research.common.quality import psnr_db
from research.common.scene_measures import ObjectPlace, count_dots, measure_object
from research.common.speckle import SpecklePair, speckle_pairs
from research.despeckling.filters import FILTERS
from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind

PLACE = ObjectPlace(row=40, column=30, half_rows=5, half_columns=6, sample_m=0.03, first_slant_m=10.0, altitude_m=5.0)


@pytest.fixture(scope="module")
def pairs() -> list[SpecklePair]:
    return speckle_pairs(6, seed=3, pings=180)


def scene(peak: int = 250, shadow_end: int = 70) -> np.ndarray:
    """Return seabed of 80 grey levels with a highlight in columns 26 to 29 and a shadow behind it."""
    image = np.full((80, 140), 80, np.uint8)
    image[35:46, 26:30] = peak
    image[35:46, 30:shadow_end] = 4
    return image


def with_speckle(image: np.ndarray, seed: int = 0) -> np.ndarray:
    power = np.random.default_rng(seed).gamma(2.0, 0.5, image.shape)
    return np.clip(np.rint(image * np.sqrt(power)), 0, 255).astype(np.uint8)


def test_pairs_differ_by_the_speckle_only(pairs: list[SpecklePair]) -> None:
    assert {pair.seabed for pair in pairs} == set(SeabedKind)
    for pair in pairs:
        assert pair.noisy.shape == pair.clean.shape == (speckle.HEIGHT_PX, speckle.WIDTH_PX)
        assert pair.noisy.dtype == pair.clean.dtype == np.uint8
        assert psnr_db(pair.clean, pair.noisy) < 30
        # The same scene: block means, which have little speckle, are proportional.
        clean, noisy = (one.reshape(8, 10, 14, 10).mean(axis=(1, 3)).ravel() for one in (pair.clean, pair.noisy))
        if clean.std() > 5:
            assert np.corrcoef(clean, noisy)[0, 1] > 0.9
        if pair.place is not None:
            assert 0 <= pair.place.row < speckle.HEIGHT_PX
            assert 0 <= pair.place.column < speckle.WIDTH_PX


def test_pairs_are_reproducible_and_their_number_and_seed_limited(pairs: list[SpecklePair]) -> None:
    again = speckle_pairs(1, seed=3, pings=180)
    assert again[0].source == pairs[0].source == f"simulated-{SeabedKind.SAND}-{speckle.FIRST_SEED + 3000}"
    assert np.array_equal(again[0].noisy, pairs[0].noisy)
    assert np.array_equal(again[0].clean, pairs[0].clean)
    assert speckle.FIRST_SEED > 100_260
    for count, seed, option in ((0, 0, "count"), (10_001, 0, "count"), (1, -1, "seed"), (1, 1_000_001, "seed")):
        with pytest.raises(ConfigError, match=f"--{option}"):
            speckle_pairs(count, seed)


def test_dots_are_small_groups_that_differ_from_their_surroundings() -> None:
    image = np.full((40, 40), 100, np.uint8)
    assert count_dots(image) == 0
    image[5, 5] = 119  # a dot of one pixel
    image[10:12, 10:13] = 60  # a dot of six pixels
    image[20, 20] = image[21, 21] = 130  # one dot, connected by a corner
    image[30, 30] = 118  # 18 grey levels are not more than 18
    assert count_dots(image) == 3
    image[5, 20:27] = 150  # a line of seven pixels is no dot
    assert count_dots(image) == 3


def test_highlight_shadow_and_height_of_an_object() -> None:
    found = measure_object(scene(), PLACE)
    assert found.peak == 250
    assert 36 <= found.peak_row <= 44
    assert 27 <= found.peak_column <= 28
    assert found.seabed == 80
    assert found.shadow_px == pytest.approx(40, abs=1)
    assert not found.shadow_is_cut
    shadow_m, end_m = found.shadow_px * 0.03, 10.0 + 70 * 0.03
    assert found.height_m == pytest.approx(shadow_m * 5.0 / end_m, rel=0.02)


@pytest.mark.parametrize("name", FILTERS)
def test_filter_reduces_speckle_and_preserves_the_scene(name: str) -> None:
    clean = scene()[:60, :90]
    noisy = with_speckle(clean)
    filtered = FILTERS[name](noisy)
    assert filtered.shape == noisy.shape
    assert filtered.dtype == np.uint8
    assert psnr_db(clean, filtered) > psnr_db(clean, noisy) + 3
    assert filtered[5:30, 50:80].std() < 0.6 * noisy[5:30, 50:80].std()
    assert filtered[5:30, 50:80].mean() == pytest.approx(80, rel=0.1)
    assert np.array_equal(filtered, FILTERS[name](noisy))


def test_reference_filter_does_not_change() -> None:
    filtered = reference_filtered(with_speckle(scene()))
    assert psnr_db(scene(), filtered) > psnr_db(scene(), with_speckle(scene())) + 4
    assert filtered.sum(dtype=np.int64) == 794_360


def test_simulated_images_are_reproducible_and_have_scenes_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(image_sets, "_PINGS", 260)
    plain = simulated_images(4, seed=5, side_px=64).images
    found = simulated_images(4, seed=5, side_px=64, with_scenes=True).images
    other = simulated_images(4, seed=6, side_px=64).images
    assert [image.is_target for image in plain] == [True, False] * 2
    assert not np.array_equal(plain[0].pixels, other[0].pixels)
    assert all(image.clean is None and image.place is None for image in plain)
    for image, before in zip(found, plain, strict=True):
        assert np.array_equal(image.pixels, before.pixels)  # reproducible
        assert image.pixels.shape == (64, 64)
        assert image.clean is not None
        assert image.clean.shape == (64, 64)
        assert image.clean.std() > 0
        assert not np.array_equal(image.clean, image.pixels)
    assert sum(image.place is not None for image in found) >= 3
