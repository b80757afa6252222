"""Smallest detail of decoded images, from the received bytes, and what codecs invent.

`python -m research.sharpness --images 24` prints the table. It is measured with the codec emb and default despeckling
on simulated contacts of 80 x 80 px.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from sonarpost.codec import emb
from sonarpost.messages import ReconstructedImage

FULL_WIDTH: Final = 2.0 * math.sqrt(2.0 * math.log(2.0))
"""Full width of a Gaussian at half of its maximum, in standard deviations."""

CODEBOOK_CODECS: Final = frozenset({"vq"})
"""Codecs that replace parts of an image by entries of a codebook."""

_EMB_TABLE: Final = (
    (0.00250, 7.8),
    (0.00375, 5.1),
    (0.00750, 3.9),
    (0.01125, 3.6),
    (0.01500, 3.1),
    (0.02250, 2.8),
    (0.03000, 2.6),
    (0.05000, 2.4),
    (0.10000, 2.4),
    (0.20000, 2.4),
)
"""(bytes a pixel, smallest detail in pixels)."""
_LEAST_DETAIL_PX: Final = 1.0
_TILE_LIMIT: Final = 0.015
_OTHER_CODECS: Final = 0.35
"""Bytes of emb with the PSNR of one byte of the weakest of the other codecs (docs/research/codecs.md)."""


def detail_px(codec: str, bytes_received: int, pixels: int) -> float | None:
    """Return the smallest detail of a decoded image in pixels; None for a codec without a measurement.

    It is the full width at half maximum of the blur, and the last value of the table where more bytes arrived.

    Args:
        codec: Name of the codec, as in a record.
        bytes_received: Bytes of the stream from which the image is decoded.
        pixels: Number of pixels of the image.
    """
    if codec != emb.NAME or bytes_received <= 0 or pixels <= 0:
        return None
    return _emb_detail_px(bytes_received / pixels)


def _emb_detail_px(density: float) -> float:
    """Return the smallest detail for a number of bytes a pixel."""
    densities, widths = zip(*_EMB_TABLE, strict=True)
    return max(_LEAST_DETAIL_PX, float(np.interp(math.log(density), np.log(densities), widths)))


def blur_px(codec: str, bytes_received: int, pixels: int) -> float:
    """Return the full width at half maximum of a codec's blur in pixels, for the correction of lengths.

    A codebook displaces edges and does not widen them: 0. Another codec has the blur of `emb` with 35 % of its bytes.

    Args:
        codec: Name of the codec, as in a record.
        bytes_received: Bytes of the stream from which the image is decoded.
        pixels: Number of pixels of the image.
    """
    if codec in CODEBOOK_CODECS:
        return 0.0
    share = 1.0 if codec == emb.NAME else _OTHER_CODECS
    return _emb_detail_px(share * max(1, bytes_received) / max(1, pixels))


def codebook_edge_px(total_bytes: int, pixels: int) -> int:
    """Return how far an edge can be displaced in an image of codebook entries, in pixels: the side of a tile.

    The codebooks have tiles of 10 px (0.0175 bytes a pixel and more) and of 20 px (0.0125 bytes a pixel and less).

    Args:
        total_bytes: Length of the stream.
        pixels: Number of pixels of the image.
    """
    return 10 if total_bytes / max(1, pixels) > _TILE_LIMIT else 20


def pixel_m(image: ReconstructedImage) -> float | None:
    """Return the longer side of a pixel of an image in metres; None if unknown."""
    contact = image.contact
    if contact is None or contact.pixel_along_m is None or contact.pixel_across_m is None:
        return None
    return max(contact.pixel_along_m, contact.pixel_across_m)


def sharp_to_m(image: ReconstructedImage) -> float | None:
    """Return the smallest detail of an image in metres, along the axis with the larger pixels; None if unknown."""
    width_px = detail_px(image.codec, image.bytes_received, image.pixels.height_px * image.pixels.width_px)
    size_m = pixel_m(image)
    return None if width_px is None or size_m is None else width_px * size_m
