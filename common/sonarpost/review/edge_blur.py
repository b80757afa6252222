"""Standard deviation of an edge in a decoded image, which the codec blurs, by bytes a pixel.

`python -m research.edge_blur --objects 300` prints the table. It is measured with the codec emb and default despeckling
on simulated objects of known length (80 x 140 px, 24 to 629 bytes).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

EMB_TABLE: Final = (
    (0.00214, 1.99),
    (0.00429, 0.89),
    (0.00571, 0.78),
    (0.00857, 0.68),
    (0.01143, 0.62),
    (0.01714, 0.58),
    (0.02804, 0.58),
    (0.05616, 0.58),
)
"""(bytes a pixel, standard deviation of an edge in pixels)."""

_VQ_TILE_LIMIT: Final = 0.015
"""Bytes a pixel that separate codebooks of 10 px (0.0175 to 0.05) and 20 px (0.0044 to 0.0125) a tile."""

_OTHER_CODECS: Final = 0.35
"""Bytes of emb with the PSNR of one byte of the weakest of the other codecs (docs/research/codecs.md)."""


def edge_sigma_px(codec: str, bytes_received: int, pixels: int) -> float:
    """Return the standard deviation of an edge in pixels, along each axis; more bytes never increase it.

    Codec `vq` replaces each tile by one of a codebook: an edge may be anywhere within a tile on either side (uniform
    distribution).

    Args:
        codec: Name of the codec.
        bytes_received: Bytes of the stream from which the image is decoded.
        pixels: Number of pixels of the image.
    """
    density = bytes_received / max(1, pixels)
    if codec == "vq":
        tile_px = 10.0 if density > _VQ_TILE_LIMIT else 20.0
        return tile_px / math.sqrt(3.0)
    if codec != "emb":
        density *= _OTHER_CODECS
    densities, sigmas = zip(*EMB_TABLE, strict=True)
    lowest = densities[0]
    if density < lowest:
        # Below the table, resolution falls with the square root of the bytes.
        return float(sigmas[0] * math.sqrt(lowest / max(density, 1e-6)))
    return float(np.interp(math.log(density), np.log(densities), sigmas))
