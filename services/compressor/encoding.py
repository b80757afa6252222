"""Streams of different lengths of one image, and the expanded snippet of a contact."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec import emb
from sonarpost.codec.interface import Codec, ExtensibleCodec, StreamHeader
from sonarpost.codec.region import RegionBox
from sonarpost.link.frames.v1.payload_objects import MAX_STREAM_BYTES
from sonarpost.messages import Pixels, Snippet

GreyImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

EXPAND_FACTOR: Final = 2
"""Ratio of the pixel sizes of `Snippet.wide` and `Snippet.pixels`, along-track and across-track."""
_MAX_PIXEL_M: Final = 100.0


def encode(codec: Codec, image: GreyImage, budget_bytes: int, refine_bytes: int) -> bytes:
    """Return the complete stream of an image, which is cached; `transmit_part` of it is sent.

    Args:
        codec: The codec.
        image: The image.
        budget_bytes: Maximum length of the part that is sent, 0 for the codec's natural length.
        refine_bytes: Length up to which an extensible codec continues the stream.

    Raises:
        StreamError: As the codec's `encode`.
    """
    if not isinstance(codec, ExtensibleCodec):
        return codec.encode(image, budget_bytes or None)
    stream = codec.encode(image, budget_bytes + 1 if budget_bytes else None)
    if refine_bytes > len(stream):
        stream = codec.extend(stream, image, refine_bytes + 1)
    return stream


def transmit_part(codec: Codec, stream: bytes) -> bytes:
    """Return the part of a complete stream that is sent.

    The last byte of an extensible stream is left out, as a longer stream may have another one there. Each longer
    stream therefore begins with what receivers have.
    """
    return stream[:-1] if isinstance(codec, ExtensibleCodec) else stream


def refine(codec: Codec, stream: bytes, image: GreyImage) -> bytes:
    """Return a stream of up to twice the length that begins with `stream`, or `stream` itself if there is none."""
    length = min(2 * len(stream), MAX_STREAM_BYTES + 1)
    if isinstance(codec, ExtensibleCodec):
        return codec.extend(stream, image, length)
    longer = codec.encode(image, min(length, MAX_STREAM_BYTES))
    return longer if len(longer) > len(stream) and longer.startswith(stream) else stream


def is_despeckled(stream: bytes) -> bool:
    """Return whether a stream contains a despeckled image.

    Raises:
        StreamError: The header is invalid.
    """
    return StreamHeader.unpack(stream).codec_id in emb.DESPECKLED_CODEC_IDS.values()


def expand(snippet: Snippet) -> Snippet | None:
    """Return a snippet of the same contact with the expanded image, None if the snippet has no such image."""
    if snippet.wide is None:
        return None
    contact = snippet.contact
    sizes = {
        "pixel_along_m": _expanded_size(contact.pixel_along_m),
        "pixel_across_m": _expanded_size(contact.pixel_across_m),
    }
    return Snippet(contact=contact.model_copy(update=sizes), pixels=snippet.wide, source=snippet.source)


def cut_region(snippet: Snippet, box: RegionBox) -> Snippet:
    """Return a snippet of the same contact with a part of its image, in pixels of the same size."""
    pixels = snippet.pixels.to_array()
    top, left, bottom, right = box.pixels(*pixels.shape)
    return Snippet(
        contact=snippet.contact, pixels=Pixels.from_array(pixels[top:bottom, left:right]), source=snippet.source
    )


def _expanded_size(pixel_m: float | None) -> float | None:
    """Return the pixel size of the expanded image, None if unknown or above the range of the record."""
    if pixel_m is None or EXPAND_FACTOR * pixel_m > _MAX_PIXEL_M:
        return None
    return EXPAND_FACTOR * pixel_m
