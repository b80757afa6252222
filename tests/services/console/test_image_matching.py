"""Place of an image in an image of more seabed."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.signal import fftconvolve

from sonarpost.services.console.store.related_images import _convolve_valid, place_in_expanded


def seabed(seed=0):
    """Grey seabed of 160 x 280 px with structure of a few pixels."""
    field = gaussian_filter(np.random.default_rng(seed).normal(size=(160, 280)), 3)
    return (128 + 40 * field / field.std()).clip(0, 255).astype(np.uint8)


def reduced(image):
    rows, columns = image.shape
    return image.reshape(rows // 2, 2, columns // 2, 2).mean(axis=(1, 3)).astype(np.uint8)


@pytest.mark.parametrize("place", [(20, 35), (0, 0), (40, 70), (4, 58)])
def test_image_is_found_in_the_expanded_image(place):
    scene = seabed()
    row, column = 2 * place[0], 2 * place[1]
    image = scene[row : row + 80, column : column + 140]
    assert place_in_expanded(image, reduced(scene)) == place


def test_image_of_other_seabed_is_not_found():
    assert place_in_expanded(seabed(1)[:80, :140], reduced(seabed(2))) is None


@pytest.mark.parametrize("shape", [(1, 1), (400, 400)])
def test_images_that_do_not_fit_are_not_found(shape):
    assert place_in_expanded(np.zeros(shape, np.uint8), reduced(seabed())) is None


def test_image_without_contrast_is_not_found():
    assert place_in_expanded(np.full((80, 140), 7, np.uint8), reduced(seabed())) is None


@pytest.mark.parametrize(("scene", "kernel"), [((80, 140), (17, 33)), ((31, 31), (31, 31)), ((64, 50), (1, 7))])
def test_convolution_is_that_of_scipy_signal(scene, kernel):
    rng = np.random.default_rng(1)
    first, second = rng.normal(size=scene), rng.normal(size=kernel)
    np.testing.assert_allclose(_convolve_valid(first, second), fftconvolve(first, second, mode="valid"), atol=1e-12)
