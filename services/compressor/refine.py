"""Streams that can go on: what is handed over of them, and how they become longer."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sonarpost.codec.interface import Codec, ExtensibleCodec
from sonarpost.link.frames.v1.payload_objects import MAX_STREAM_BYTES

EncodedPicture = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


def encode(codec: Codec, picture: EncodedPicture, budget_bytes: int, refine_bytes: int) -> bytes:
    """Return the stream to keep of a picture; `handed` is what others get of it.

    Args:
        codec: Encodes.
        picture: The picture.
        budget_bytes: Length of the stream as it is handed over, 0 for the codec's natural one.
        refine_bytes: Up to where it goes on, if the codec can.

    Raises:
        StreamError: As the codec's `encode`.
    """
    if not isinstance(codec, ExtensibleCodec):
        return codec.encode(picture, budget_bytes or None)
    stream = codec.encode(picture, budget_bytes + 1 if budget_bytes else None)
    if refine_bytes > len(stream):
        stream = codec.extend(stream, picture, refine_bytes + 1)
    return stream


def handed(codec: Codec, stream: bytes) -> bytes:
    """Return what is handed over of a kept stream: all but a last byte that a longer one may write differently.

    So every longer stream begins with what receivers have of it.
    """
    return stream[:-1] if isinstance(codec, ExtensibleCodec) else stream


def refined(codec: Codec, stream: bytes, picture: EncodedPicture) -> bytes:
    """Return a stream of up to twice the length that goes on where a kept one ends, or the same where there is none."""
    wanted = min(2 * len(stream), MAX_STREAM_BYTES + 1)
    if isinstance(codec, ExtensibleCodec):
        return codec.extend(stream, picture, wanted)
    longer = codec.encode(picture, min(wanted, MAX_STREAM_BYTES))
    return longer if len(longer) > len(stream) and longer.startswith(stream) else stream
