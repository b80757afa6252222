"""Grey levels of images, and their encoding as PNG."""

from __future__ import annotations

import io

import numpy as np
import numpy.typing as npt
from PIL import Image

Grey = npt.NDArray[np.uint8]
GreyImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


def eight_bits(pixels: GreyImage) -> Grey:
    """Return the most significant 8 bits of each pixel, same shape."""
    return pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)  # type: ignore[return-value]


def encode_png(pixels: npt.NDArray[np.uint8]) -> bytes:
    """Encode an image of shape (height_px, width_px) or (height_px, width_px, 3) as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", compress_level=4)
    return buffer.getvalue()
