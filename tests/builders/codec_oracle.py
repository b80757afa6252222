"""What decoding may do with any bytes: refuse them with a StreamError, or give a picture that owns up to its gaps.

Used by the coverage-guided fuzzer (`run_atheris.py`) and by the bounded tests of the default suite.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from builders.common import GOLDEN_FOLDER
from sonarpost.codec.interface import COMMON_SIDES_PX, Codec, Mask, StreamHeader, model_tag
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import load
from sonarpost.errors import StreamError

GOLDEN = GOLDEN_FOLDER
GOOD_HEADER, GAP = 1, 2
"""Flags of an input's first byte: a good header is put before the body; a stretch of the body did not arrive."""
PREFIX_BYTES = 6
"""Flags, codec, row and column of the size, start and length of the gap; then the stream, or the body alone."""


@cache
def resources() -> CodecResources:
    """Return the golden codebook, small enough to be quick."""
    return CodecResources(load(GOLDEN / "vq" / "small.tiles").tiles)


@cache
def codec_for(codec_id: int) -> Codec:
    """Return the codec of an id, made once: making it is not what is tested."""
    return default_registry().spec_for_id(codec_id).create(replace(resources(), codec_id=codec_id))


def codec_ids(names: Sequence[str] | None = None) -> tuple[int, ...]:
    """Return the ids of these codecs, or of all that are installed."""
    registry = default_registry()
    return tuple(number for name in names or registry.names() for number in registry.spec(name).codec_ids)


def good_header(codec_id: int, height_px: int, width_px: int) -> StreamHeader:
    """Return a header that the codec of this id takes for one of its own."""
    return StreamHeader(codec_id, model_tag(codec_id, codec_for(codec_id).model_hash), height_px, width_px)


def stream_of(data: bytes, ids: Sequence[int]) -> tuple[bytes, Mask | None]:
    """Read a fuzzer's input: a stream, and which body bytes arrived (None: all).

    Args:
        data: See `PREFIX_BYTES`; a shorter one is read as if zeros followed.
        ids: Ids that a good header may have.
    """
    flags, codec, row, column, first, count = data[:PREFIX_BYTES].ljust(PREFIX_BYTES, b"\0")
    stream = data[PREFIX_BYTES:]
    if flags & GOOD_HEADER:
        height_px, width_px = (COMMON_SIDES_PX[side % len(COMMON_SIDES_PX)] for side in (row, column))
        stream = good_header(ids[codec % len(ids)], height_px, width_px).pack() + stream
    if not flags & GAP:
        return stream, None
    try:
        received = np.ones(len(stream) - StreamHeader.unpack(stream).size, dtype=np.bool_)
    except StreamError:
        return stream, None
    received[first : first + count] = False
    return stream, received


def check(stream: bytes, received: Mask | None, ids: Sequence[int]) -> str:
    """Decode; return "refused", "concealed" or "whole".

    Raises:
        AssertionError: What was decoded is not a picture of the header's size, or shows what it says is missing.
        Exception: Anything but a StreamError that decoding raised.
    """
    try:
        header = StreamHeader.unpack(stream)
        if header.codec_id not in ids:
            return "refused"
        decoded = codec_for(header.codec_id).decode(stream, received)
    except StreamError:
        return "refused"
    shape = (header.height_px, header.width_px)
    assert decoded.image.shape == decoded.missing.shape == shape, (decoded.image.shape, shape)
    assert decoded.image.dtype == np.uint8
    assert decoded.missing.dtype == np.bool_
    assert not decoded.image[decoded.missing].any()
    return "concealed" if decoded.missing.any() else "whole"
