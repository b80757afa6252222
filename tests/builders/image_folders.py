"""Folders of images as people have them."""

from pathlib import Path

import numpy as np
from PIL import Image

from sonarpost.sonar.image_files import write_png, write_tiff


def snippet(seed: int, height_px: int = 60, width_px: int = 45) -> np.ndarray:
    """Return speckle with a highlight and a shadow."""
    image = 50 * np.random.default_rng(seed).rayleigh(1.0, (height_px, width_px))
    image[20:40, 10:20] *= 4
    image[20:40, 20:40] *= 0.1
    return np.clip(image, 0, 255).astype(np.uint8)


def three_images(images: Path) -> Path:
    """Make a folder of a TIFF, a PNG and a TIFF of 16 bits, with a note; return it."""
    images.mkdir()
    write_tiff(images / "a.tiff", snippet(0))
    write_png(images / "b.png", snippet(1, 37, 81))
    write_tiff(images / "c.tif", snippet(2).astype(np.uint16) * 257)
    (images / "notes.md").write_text("not an image")
    return images


def own_images(images: Path) -> Path:
    """Make a folder of a large JPEG of a phone, a colour PNG, a small TIFF, a side-car and a note; return it."""
    images.mkdir()
    large = Image.fromarray(np.kron(snippet(3, 20, 120), np.ones((8, 8), np.uint8))).convert("RGB")
    exif = Image.Exif()
    exif[0x0112] = 6
    large.save(images / "phone.jpg", exif=exif)
    Image.fromarray(np.dstack([snippet(4), snippet(5), snippet(6)])).save(images / "colour.png")
    write_tiff(images / "small.tiff", snippet(7, 12, 20))
    (images / "phone.txt").write_text("lat_deg: 56.45\nlon_deg: -5.6\n")
    (images / "heron.heic").write_text("not an image")
    return images
