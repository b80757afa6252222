"""PSNR and SSIM."""

import math

import numpy as np
import pytest
from builders.images import ssim_windows

from research.common.quality import psnr_db, ssim
from sonarpost.errors import StreamError


def noise(height_px: int, width_px: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height_px, width_px), dtype=np.uint8)


def test_psnr_of_known_errors() -> None:
    image = np.full((20, 20), 100, np.uint8)
    assert psnr_db(image, image) == math.inf
    assert psnr_db(image, image + 1) == pytest.approx(10 * math.log10(255**2))
    assert psnr_db(np.zeros_like(image), np.full_like(image, 255)) == 0.0


def test_ssim_matches_its_definition() -> None:
    a = noise(23, 19)
    b = np.clip(a.astype(int) + noise(23, 19, 1) // 4 - 32, 0, 255).astype(np.uint8)
    assert ssim(a, b) == pytest.approx(
        np.mean([luminance * structure for luminance, structure in ssim_windows(a, b)]), abs=1e-9
    )
    assert 0.5 < ssim(a, b) < 1


def test_ssim_of_images_narrower_than_the_window() -> None:
    a = noise(6, 30)
    assert ssim(a, a) == pytest.approx(1.0)
    assert ssim(a, noise(6, 30, 1)) < 0.5


@pytest.mark.parametrize("measure", [psnr_db, ssim])
def test_images_that_cannot_be_compared_are_rejected(measure) -> None:
    image = noise(16, 16)
    for a, b, field in (
        (image, noise(16, 17), "decoded.shape"),
        (image[:0], image[:0], "original.shape"),
        (image[0], image[0], "original.shape"),
        (image, image.astype(float), "decoded.dtype"),
        (image.astype(np.uint16), image, "original.dtype"),
    ):
        with pytest.raises(StreamError) as caught:
            measure(a, b)
        assert caught.value.field == field
