"""The embedded wavelet codec. Its module `codec` loads numba, so import it only when an image is coded."""

from typing import Final

NAME: Final = "emb"
DEFAULT_MODEL: Final = "standard"
DEFAULT_STRENGTH: Final = 1.0
"""Strength of despeckling, 0 to 1, unless an option sets it."""
MODEL_FILES: Final = {"standard": "emb-2.model", "structure": "emb-structure.model"}
"""Model file by model name."""
CODEC_IDS: Final = {"standard": 0x20, "structure": 0x21}
"""Codec id in the stream header, by model name."""
DESPECKLED_CODEC_IDS: Final = {"standard": 0x22, "structure": 0x23}
"""The same for despeckled images. The side information of these streams has the strength."""
