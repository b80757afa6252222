"""PSNR, SSIM and the figure of merit."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sonarpost.codec.quality import psnr_db, ssim
from sonarpost.codec.vq.builder import figure_of_merit
from sonarpost.errors import StreamError


def noise(height_px: int, width_px: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height_px, width_px), dtype=np.uint8)


def ssim_by_definition(a: np.ndarray, b: np.ndarray) -> float:
    """Return the SSIM of Wang et al. 2004, computed window by window."""
    axis = np.arange(-5, 6)
    line = np.exp(-(axis**2) / (2 * 1.5**2))
    window = np.outer(line, line) / line.sum() ** 2
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    values = []
    for row in range(a.shape[0] - 10):
        for column in range(a.shape[1] - 10):
            x = a[row : row + 11, column : column + 11].astype(float)
            y = b[row : row + 11, column : column + 11].astype(float)
            mx, my = (window * x).sum(), (window * y).sum()
            vx, vy = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum()
            cov = (window * (x - mx) * (y - my)).sum()
            values.append((2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2)))
    return float(np.mean(values))


def test_psnr_of_known_errors() -> None:
    image = np.full((20, 20), 100, np.uint8)
    assert psnr_db(image, image) == math.inf
    assert psnr_db(image, image + 1) == pytest.approx(10 * math.log10(255**2))
    assert psnr_db(np.zeros_like(image), np.full_like(image, 255)) == 0.0


def test_ssim_matches_its_definition() -> None:
    a = noise(23, 19)
    b = np.clip(a.astype(int) + noise(23, 19, 1) // 4 - 32, 0, 255).astype(np.uint8)
    assert ssim(a, b) == pytest.approx(ssim_by_definition(a, b), abs=1e-9)
    assert 0.5 < ssim(a, b) < 1
    assert figure_of_merit(a, b) == 100 * ssim(a, b)


def test_ssim_of_equal_inverted_and_unrelated_images() -> None:
    a = noise(40, 40)
    assert ssim(a, a) == pytest.approx(1.0)
    assert ssim(a, 255 - a) < -0.8
    assert abs(ssim(a, noise(40, 40, 2))) < 0.1


def test_ssim_of_images_narrower_than_the_window() -> None:
    a = noise(6, 30)
    assert ssim(a, a) == pytest.approx(1.0)
    assert ssim(a, noise(6, 30, 1)) < 0.5


@pytest.mark.parametrize("measure", [psnr_db, ssim, figure_of_merit])
@pytest.mark.parametrize(
    ("a", "b", "field"),
    [
        (noise(16, 16), noise(16, 17), "decoded.shape"),
        (noise(16, 16)[:0], noise(16, 16)[:0], "original.shape"),
        (noise(16, 16)[0], noise(16, 16)[0], "original.shape"),
        (noise(16, 16), noise(16, 16).astype(float), "decoded.dtype"),
        (noise(16, 16).astype(np.uint16), noise(16, 16), "original.dtype"),
    ],
)
def test_images_that_cannot_be_compared_are_rejected(measure, a, b, field: str) -> None:
    with pytest.raises(StreamError) as caught:
        measure(a, b)
    assert caught.value.field == field
