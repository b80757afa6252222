"""The embedded wavelet codec. `codec.EmbCodec` is imported on use, since it brings a compiler with it."""

from typing import Final

CODEC_ID: Final = 0x20
NAME: Final = "emb"
STRUCTURE_ID: Final = 0x21
STRUCTURE_NAME: Final = "emb-structure"
"""Of models with an aim; see `aim`."""
