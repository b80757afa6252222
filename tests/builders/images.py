"""Images for the tests of several codecs."""

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image as Pillow


def snippet(height_px: int, width_px: int) -> np.ndarray:
    """Return texture with a highlight and its shadow, by integer arithmetic."""
    rows, columns = np.mgrid[:height_px, :width_px]
    noise = ((rows * 7919 + columns * 104_729) * 2_654_435_761 >> 13) % 64
    image = 50 + noise + (rows + columns) % 40
    image[height_px // 3 : height_px // 2, width_px // 4 : width_px // 2] = 240
    image[height_px // 3 : height_px // 2, width_px // 2 : width_px * 3 // 4] = 3
    return image.astype(np.uint8)


def contact(height_px: int = 80, width_px: int = 80, seed: int = 0) -> np.ndarray:
    """Return a speckled slope with a highlight and a shadow."""
    rng = np.random.default_rng(seed)
    image = (50 + 30 * np.linspace(0, 1, width_px)) * rng.gamma(6, 1 / 6, (height_px, width_px))
    image[height_px // 3 : height_px // 2, width_px // 4 : width_px // 2] *= 3
    image[height_px // 3 : height_px // 2, width_px // 2 : width_px * 3 // 4] *= 0.1
    return np.clip(image, 0, 255).astype(np.uint8)


def speckle_line(pings: int = 300, samples: int = 260) -> np.ndarray:
    """Return a side-scan line of speckle."""
    values = 50 * np.random.default_rng(0).rayleigh(1.0, (pings, samples))
    return np.clip(values, 1, 255).astype(np.uint8).astype(np.float32)


def ssim_windows(first: np.ndarray, second: np.ndarray) -> Iterator[tuple[float, float]]:
    """Compute luminance and contrast-structure of each window of 11 x 11 px, as Wang et al. 2004 define them."""
    line = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = np.outer(line, line) / line.sum() ** 2
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    for row in range(first.shape[0] - 10):
        for column in range(first.shape[1] - 10):
            x, y = (a[row : row + 11, column : column + 11].astype(float) for a in (first, second))
            mx, my = (window * x).sum(), (window * y).sum()
            vx, vy = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum()
            covariance = (window * (x - mx) * (y - my)).sum()
            yield (2 * mx * my + c1) / (mx**2 + my**2 + c1), (2 * covariance + c2) / (vx + vy + c2)


def sdvd_crops(data_dir: Path) -> list[np.ndarray]:
    """Return 120 x 120 px of every test image (its centre or its target), reduced to 80 x 80 px."""
    folder = data_dir / "snippets" / "sdvd"
    crops = []
    with (folder / "index.csv").open() as index:
        for row in csv.DictReader(index):
            if row["split"] == "test":
                box = {key: int(row[key] or 128) for key in ("x0", "x1", "y0", "y1")}
                left, top = (min(max((box[f"{axis}0"] + box[f"{axis}1"]) // 2 - 60, 0), 136) for axis in "xy")
                with Pillow.open(folder / "test" / "images" / row["image"]) as opened:
                    crop = opened.convert("L").crop((left, top, left + 120, top + 120))
                crops.append(np.array(crop.resize((80, 80), Pillow.Resampling.LANCZOS)))
    return crops
