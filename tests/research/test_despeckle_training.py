"""The examples that train the despeckling network."""

import numpy as np
import pytest

from research.training.despeckle import scenes
from research.training.despeckle.scenes import Examples, speckle


@pytest.fixture(scope="module")
def examples(tmp_path_factory: pytest.TempPathFactory) -> Examples:
    """Return examples of one simulated survey and one recording of independent pings."""
    path = tmp_path_factory.mktemp("scenes") / "scenes.npz"
    crops, floors = scenes.simulated_scenes(scenes.SEEDS[0])
    assert crops.shape[1:] == (scenes.HEIGHT_PX, scenes.WIDTH_PX)
    assert floors.shape == (len(crops), scenes.WIDTH_PX)
    rng = np.random.default_rng(1)
    sheet = (100 * np.sqrt(speckle((700, 500), rng, product=True))).astype(np.float32)
    assert abs(scenes.row_correlation(sheet)) < 0.15
    np.savez(path, scene=crops, floor=floors, sheet0=sheet)
    return Examples(path, seed=3)


def test_examples_are_grey_patches_with_a_cleaner_target(examples: Examples) -> None:
    weights = set()
    noisier = []
    for _ in range(60):
        noisy, clean, weight = examples.draw()
        assert noisy.shape == clean.shape == (scenes.PATCH_PX, scenes.PATCH_PX)
        assert noisy.dtype == clean.dtype == np.float32
        assert 0 <= min(noisy.min(), clean.min()) <= max(noisy.max(), clean.max()) <= 1
        weights.add(weight)
        if weight == 1:
            noisier.append(np.abs(np.diff(noisy)).mean() > np.abs(np.diff(clean)).mean())
    assert weights == {0.3, 1.0}
    assert np.mean(noisier) > 0.9


def test_speckle_has_mean_one_and_averaging_reduces_it() -> None:
    for product in (True, False):
        assert speckle((64, 64), np.random.default_rng(2), product=product).mean() == pytest.approx(1, abs=1e-3)
    sheet = np.sqrt(speckle((400, 400), np.random.default_rng(4), product=True))
    mean = scenes.averaged(sheet, 4)
    assert mean.shape == (100, 100)
    assert np.median(mean) == pytest.approx(1)
    assert mean.std() < 0.4 * (sheet**2).std()
