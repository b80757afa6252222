"""Pictures with the synthetic grain that a codec may offer as a viewing mode beside the measured picture."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from sonarpost.codec.interface import Codec, Image
from sonarpost.errors import StreamError


@runtime_checkable
class GrainyCodec(Protocol):
    """A codec whose streams may carry a description of the bottom's grain."""

    def decode_with_grain(self, stream: bytes) -> Image:
        """Return the picture with synthetic grain, shape (height, width), uint8.

        Raises:
            StreamError: The stream is not of this codec, or carries no grain.
        """


def with_grain(codec: Codec, stream: bytes) -> Image | None:
    """Return the decoded picture with grain; None where the codec or the stream offers none."""
    if not isinstance(codec, GrainyCodec):
        return None
    try:
        return codec.decode_with_grain(stream)
    except StreamError:
        return None
