"""Configuration of the compressor: the `[compressor]` table."""

from typing import Annotated

from pydantic import Field

from sonarpost.codec.vq.codec import IndexPacking
from sonarpost.config import ServiceConfig


class CompressorConfig(ServiceConfig):
    """Which codec, with which model.

    Attributes:
        codec: Name in the codec registry.
        codebook: Tile codebook: nominal-10, nominal-20 or a file. The receiving end needs the same one.
        packing: How the vq codec writes an index: 14bit, 2byte, 3byte, ascii5.
        budget_bytes: Upper bound of a stream, header included; 0 for the codec's natural size.
        refine_bytes: How far streams go on beyond the budget where the codec can go on, for the vessel to ask for; v1
            sends `stream_bytes` of [uuv_modem] unasked. Not for the paper's link, which sends all of a stream.
        cache_images: Most pictures kept to answer the vessel's commands from.
        cache_s: How long they are kept.
    """

    codec: str = "vq"
    codebook: str = "nominal-10"
    packing: IndexPacking = IndexPacking.BITS14
    budget_bytes: Annotated[int, Field(ge=0, le=65542)] = 0
    refine_bytes: Annotated[int, Field(ge=0, le=65535)] = 0
    cache_images: Annotated[int, Field(ge=0, le=10000)] = 200
    cache_s: Annotated[float, Field(gt=0, le=2592000)] = 86400.0
