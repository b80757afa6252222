"""Image codecs for sonar snippets.

>>> import sonarpost.codec as c
>>> stream = c.encode(image, budget=64)
>>> decoded = c.decode(stream)

Importing this package loads neither numba nor scipy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from sonarpost.codec.interface import Codec, DecodedImage, StreamHeader

if TYPE_CHECKING:
    from sonarpost.codec.api import codec_names, decode, decode_image, encode, get_codec
else:

    def __getattr__(name: str) -> object:
        """Import the functions of `api` on first use."""
        if name in __all__:
            return getattr(importlib.import_module("sonarpost.codec.api"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "Codec",
    "DecodedImage",
    "StreamHeader",
    "codec_names",
    "decode",
    "decode_image",
    "encode",
    "get_codec",
]
