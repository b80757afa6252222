"""Pictures with the synthetic grain that a codec may offer as a viewing mode beside the measured picture.

How much of the grain is shown is the viewer's choice, made at decoding: a stream only says how strong the bottom's
texture was.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from sonarpost.codec import emb
from sonarpost.codec.interface import Codec, Image
from sonarpost.errors import StreamError

DEFAULT_STRENGTH = 0.5
"""Of the strength that would restore the texture's power; what `decode_with_grain` of emb shows."""


@runtime_checkable
class GrainyCodec(Protocol):
    """A codec whose streams may carry a description of the bottom's grain."""

    def decode_grain(self, stream: bytes) -> npt.NDArray[np.int16]:
        """Return the texture that the decoded picture lacks, shape (height, width), int16, to be added.

        Raises:
            StreamError: The stream is not of this codec, or carries no grain.
        """


def with_grain(codec: Codec, stream: bytes, picture: Image, strength: float = DEFAULT_STRENGTH) -> Image | None:
    """Return a decoded picture with grain; None where the codec or the stream offers none.

    Args:
        codec: What decodes the stream.
        stream: Header and body.
        picture: What it decoded to, shape (height, width), uint8.
        strength: Share of the grain that is added, 0..2.
    """
    if not isinstance(codec, GrainyCodec):
        return None
    try:
        layer = codec.decode_grain(stream)
    except StreamError:
        return None
    added = np.floor(layer * strength).astype(np.int32)
    return np.asarray(np.clip(picture + added, 0, 255), dtype=np.uint8)


def grainy_twin(codec: Codec) -> Codec | None:
    """Return the codec that writes the grain's description into its streams, within the same budget; None if none."""
    if codec.name not in (emb.NAME, emb.STRUCTURE_NAME):
        return None
    from sonarpost.codec.emb.codec import EmbCodec  # noqa: PLC0415  it brings a compiler, which nobody else waits for

    return replace(codec, grain=True) if isinstance(codec, EmbCodec) else None
