"""Configuration of the compressor: the `[compressor]` table."""

from typing import Annotated

from pydantic import Field
from typing_extensions import override

from sonarpost.codec import emb
from sonarpost.codec.registry import default_registry
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.codec.vq.codec import IndexPacking
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.errors import ConfigError


class CompressorConfig(ServiceConfig):
    """Codec, stream lengths and cache.

    Attributes:
        codec: Name in the codec registry.
        model: Model of the emb codec: standard (least squared error) or structure (structural similarity).
        despeckle_strength: Strength with which the emb codec removes speckle before coding, 0 (none) to 1, in steps of
            1/16. The snippet stays unchanged in the cache; the command `original` requests it without despeckling.
        codebook: Tile codebook: nominal-10, nominal-20 or a file. The vessel needs the same one.
        packing: Index format of the vq codec: 14bit, 2byte, 3byte, ascii5.
        budget_bytes: Maximum length of a stream, header included; 0 for the codec's natural length.
        refine_bytes: Length up to which streams continue beyond the budget, for refine commands, with an extensible
            codec. The v1 link sends `stream_bytes` of [uuv_modem] without a command. Not for the paper's link, which
            sends complete streams.
        cache_images: Maximum number of images in the cache that answers commands.
    """

    codec: str = "emb"
    model: str = "standard"
    despeckle_strength: Annotated[float, Field(ge=0, le=1)] = emb.DEFAULT_STRENGTH
    codebook: str = "nominal-10"
    packing: IndexPacking = IndexPacking.BITS14
    budget_bytes: Annotated[int, Field(ge=0, le=65542)] = 0
    refine_bytes: Annotated[int, Field(ge=0, le=65535)] = 0
    cache_images: Annotated[int, Field(ge=0, le=10000)] = 200

    @override
    def check_with(self, platform: PlatformConfig) -> None:
        """Check that codec, model and codebook exist.

        Raises:
            ConfigError: Unknown codec or model.
            CodebookError: The codebook cannot be read.
        """
        default_registry().spec(self.codec)
        if self.codec == emb.NAME and self.model not in emb.MODEL_FILES:
            raise ConfigError("[compressor]", "model", self.model, " or ".join(emb.MODEL_FILES))
        open_codebook(self.codebook)
