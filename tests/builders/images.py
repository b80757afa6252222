"""Images for the tests of several codecs."""

from __future__ import annotations

import csv
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


def sdvd_crops(data_dir: Path) -> list[np.ndarray]:
    """Return 120 x 120 px of every test image (its centre or its target), reduced to 80 x 80 px."""
    folder = data_dir / "snippets" / "sdvd"
    crops = []
    with (folder / "index.csv").open() as index:
        for row in csv.DictReader(index):
            if row["split"] == "test":
                centre = (
                    [128, 128]
                    if not row["x0"]
                    else [(int(row[f"{axis}0"]) + int(row[f"{axis}1"])) // 2 for axis in "xy"]
                )
                left, top = (min(max(value - 60, 0), 136) for value in centre)
                with Pillow.open(folder / "test" / "images" / row["image"]) as opened:
                    crop = opened.convert("L").crop((left, top, left + 120, top + 120))
                crops.append(np.array(crop.resize((80, 80), Pillow.Resampling.LANCZOS)))
    return crops
