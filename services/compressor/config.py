"""Configuration of the compressor: the `[compressor]` table."""

from typing import Annotated

from pydantic import Field

from sonarpost.codec.vq.codec import IndexPacking
from sonarpost.config import ServiceConfig


class CompressorConfig(ServiceConfig):
    """Codec, stream lengths and cache.

    Attributes:
        codec: Name in the codec registry.
        model: Model of the emb codec: standard (least squared error) or structure (structural similarity).
        codebook: Tile codebook: nominal-10, nominal-20 or a file. The vessel needs the same one.
        packing: Index format of the vq codec: 14bit, 2byte, 3byte, ascii5.
        budget_bytes: Maximum length of a stream, header included; 0 for the codec's natural length.
        refine_bytes: Length up to which streams continue beyond the budget, for refine commands, with an extensible
            codec. The v1 link sends `stream_bytes` of [uuv_modem] without a command. Not for the paper's link, which
            sends complete streams.
        cache_images: Maximum number of images in the cache that answers commands.
        cache_s: Maximum age of an image in the cache.
    """

    codec: str = "emb"
    model: str = "standard"
    codebook: str = "nominal-10"
    packing: IndexPacking = IndexPacking.BITS14
    budget_bytes: Annotated[int, Field(ge=0, le=65542)] = 0
    refine_bytes: Annotated[int, Field(ge=0, le=65535)] = 0
    cache_images: Annotated[int, Field(ge=0, le=10000)] = 200
    cache_s: Annotated[float, Field(gt=0, le=2592000)] = 86400.0
