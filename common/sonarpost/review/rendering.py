"""Rendering of images for display: layers, colour maps."""

from __future__ import annotations

import io
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy.ndimage import median_filter

Grey = npt.NDArray[np.uint8]
Pixels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class Layer:
    """A form in which an image is displayed.

    Attributes:
        name: Name in URLs.
        measurable: Whether lengths may be measured on it.
        synthesised: Whether its pixels differ from the received ones.
        reason: Why it is not measurable.
    """

    name: str
    measurable: bool
    synthesised: bool
    reason: str


LAYERS: Final = (
    Layer("raw", measurable=True, synthesised=False, reason=""),
    Layer(
        "enhanced",
        measurable=False,
        synthesised=True,
        reason="speckle is smoothed and contrast is stretched; edges are displaced",
    ),
)

# RGB values at grey levels 0, 64, 128, 192 and 255; linear in between.
_ANCHORS: Final = MappingProxyType(
    {
        "inverse": ((255, 255, 255), (191, 191, 191), (127, 127, 127), (63, 63, 63), (0, 0, 0)),
        "copper": ((0, 0, 0), (79, 50, 32), (159, 100, 64), (239, 150, 95), (255, 220, 180)),
        "amber": ((0, 0, 0), (80, 40, 0), (170, 95, 0), (250, 165, 25), (255, 240, 190)),
        "bone": ((0, 0, 0), (56, 56, 78), (112, 124, 140), (170, 198, 198), (255, 255, 255)),
    }
)
MAPS: Final = ("grey", *_ANCHORS)


def eight_bits(pixels: Pixels) -> Grey:
    """Return the most significant 8 bits of each pixel, same shape."""
    return pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)  # type: ignore[return-value]


def enhance(image: Grey, missing: npt.NDArray[np.bool_]) -> Grey:
    """Smooth speckle, and stretch the contrast between the 1st and 99th percentile.

    Args:
        image: Shape (height_px, width_px).
        missing: Same shape; pixels that stay black and are excluded from the percentiles.
    """
    if missing.all():
        return image.copy()
    smooth = median_filter(image, size=3, mode="nearest").astype(np.float64)
    low, high = np.percentile(smooth[~missing], (1, 99))
    stretched = (smooth - low) / max(high - low, 1.0) * 255.0
    stretched[missing] = 0
    result: Grey = stretched.clip(0, 255).round().astype(np.uint8)
    return result


def render(
    image: Grey, colour_map: str = "grey", low_percent: float = 0.0, high_percent: float = 100.0, gamma: float = 1.0
) -> npt.NDArray[np.uint8]:
    """Apply gain and colour map.

    Args:
        image: Shape (height_px, width_px).
        colour_map: One of `MAPS`.
        low_percent: Black point in percent of full scale.
        high_percent: White point in percent of full scale; above `low_percent`.
        gamma: Exponent; values below 1 brighten.

    Returns:
        Shape (height_px, width_px) for `grey`, else (height_px, width_px, 3).
    """
    levels = np.linspace(0.0, 100.0, 256)
    curve = ((levels - low_percent) / (high_percent - low_percent)).clip(0, 1) ** gamma
    table = (255 * curve).round().astype(np.uint8)
    grey = table[image]
    if colour_map == "grey":
        return grey
    anchors = np.array(_ANCHORS[colour_map], np.float64)
    at = np.array([0, 64, 128, 192, 255])
    colours = np.stack([np.interp(np.arange(256), at, anchors[:, channel]) for channel in range(3)], axis=1)
    coloured: npt.NDArray[np.uint8] = colours.round().astype(np.uint8)[grey]
    return coloured


def encode_png(pixels: npt.NDArray[np.uint8]) -> bytes:
    """Encode an image of shape (height_px, width_px) or (height_px, width_px, 3) as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", compress_level=4)
    return buffer.getvalue()
