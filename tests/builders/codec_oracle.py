"""Rules for decoding any bytes: a StreamError, or an image whose missing pixels are black.

Used by the coverage-guided fuzzer (`run_atheris.py`) and by the bounded tests of the default suite.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from builders.common import GOLDEN_FOLDER
from builders.images import contact
from sonarpost.codec.interface import COMMON_SIDES_PX, Codec, Mask, StreamHeader, model_tag
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import load
from sonarpost.errors import StreamError

GOLDEN = GOLDEN_FOLDER
VALID_HEADER, GAP = 1, 2
"""Flags in the first byte of an input: put a valid header before the body; mark a part of the body as missing."""
_SIZES = ((16, 16), (32, 48), (80, 80), (17, 33))
_BUDGETS = (40, 400)
PREFIX_BYTES = 6
"""Flags, codec, row and column of the size, start and length of the gap; then the stream or the body."""


@cache
def resources() -> CodecResources:
    """Return the golden codebook, which is small."""
    return CodecResources(load(GOLDEN / "vq" / "small.tiles").tiles)


@cache
def codec_for(codec_id: int) -> Codec:
    """Return the codec of a codec id, created once."""
    return default_registry().spec_for_id(codec_id).create(replace(resources(), codec_id=codec_id))


def codec_ids(names: Sequence[str] | None = None) -> tuple[int, ...]:
    """Return the codec ids of these codecs, or of all installed ones."""
    registry = default_registry()
    return tuple(number for name in names or registry.names() for number in registry.spec(name).codec_ids)


def valid_header(codec_id: int, height_px: int, width_px: int) -> StreamHeader:
    """Return a header that the codec of this id accepts."""
    return StreamHeader(codec_id, model_tag(codec_id, codec_for(codec_id).model_hash), height_px, width_px)


def stream_of(data: bytes, ids: Sequence[int]) -> tuple[bytes, Mask | None]:
    """Parse the input of a fuzzer: a stream, and the mask of the body bytes that arrived (None: all).

    Args:
        data: See `PREFIX_BYTES`; shorter data are padded with zeros.
        ids: Codec ids for the valid header.
    """
    flags, codec, row, column, first, count = data[:PREFIX_BYTES].ljust(PREFIX_BYTES, b"\0")
    stream = data[PREFIX_BYTES:]
    if flags & VALID_HEADER:
        height_px, width_px = (COMMON_SIDES_PX[side % len(COMMON_SIDES_PX)] for side in (row, column))
        stream = valid_header(ids[codec % len(ids)], height_px, width_px).pack() + stream
    if not flags & GAP:
        return stream, None
    try:
        received = np.ones(len(stream) - StreamHeader.unpack(stream).size, dtype=np.bool_)
    except StreamError:
        return stream, None
    received[first : first + count] = False
    return stream, received


def check(stream: bytes, received: Mask | None, ids: Sequence[int]) -> str:
    """Decode; return "rejected", "concealed" or "complete".

    Raises:
        AssertionError: The image does not have the header's size, or a missing pixel is not black.
        Exception: Decoding raised something other than a StreamError.
    """
    try:
        header = StreamHeader.unpack(stream)
        if header.codec_id not in ids:
            return "rejected"
        decoded = codec_for(header.codec_id).decode(stream, received)
    except StreamError:
        return "rejected"
    shape = (header.height_px, header.width_px)
    assert decoded.image.shape == decoded.missing.shape == shape, (decoded.image.shape, shape)
    assert decoded.image.dtype == np.uint8
    assert decoded.missing.dtype == np.bool_
    assert not decoded.image[decoded.missing].any()
    return "concealed" if decoded.missing.any() else "complete"


def golden_streams(ids):
    """Yield the golden streams of these codecs."""
    found = [bytes.fromhex(path.read_text()) for path in sorted(GOLDEN.glob("*/*.hex")) if "pixels" not in path.name]
    for path in sorted(GOLDEN.glob("emb/*.json")):
        found += [bytes.fromhex(case["stream"]) for case in json.loads(path.read_text()).values()]
    yield from (stream for stream in found if stream and stream[0] in ids)


def new_streams(ids):
    """Yield streams of speckle with a highlight and a shadow, for the budgets that the codec can meet."""
    for codec_id in ids:
        codec = codec_for(codec_id)
        for size in _SIZES:
            for budget in (*_BUDGETS, None):
                stream = _encoded(codec, contact(*size), budget)
                if stream is not None and len(stream) <= 4096:
                    yield stream


def as_input(stream, flags, ids):
    """Return the input that `codec_oracle.stream_of` parses to this stream, or to its body, depending on the flags."""
    header = StreamHeader.unpack(stream)
    if not flags & VALID_HEADER:
        return bytes([flags]) + bytes(PREFIX_BYTES - 3) + bytes([3, flags & GAP]) + stream
    sides = [
        COMMON_SIDES_PX.index(side) if side in COMMON_SIDES_PX else 0 for side in (header.height_px, header.width_px)
    ]
    return bytes([flags, ids.index(header.codec_id), *sides, 3, flags & GAP]) + stream[header.size :]


def _encoded(codec, image, budget):
    try:
        return codec.encode(image, budget)
    except StreamError:
        return None
