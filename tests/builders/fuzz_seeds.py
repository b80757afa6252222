"""Seeds for the fuzzer: all golden streams, and new streams of each codec in several sizes."""

import json

import numpy as np

from builders.codec_oracle import GAP, GOLDEN, PREFIX_BYTES, VALID_HEADER, codec_for
from sonarpost.codec.interface import COMMON_SIDES_PX, StreamHeader
from sonarpost.errors import StreamError

_SIZES = ((16, 16), (32, 48), (80, 80), (17, 33))
_BUDGETS = (40, 400)


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
                stream = _encoded(codec, _snippet(*size), budget)
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


def _snippet(height_px, width_px):
    image = 60 * np.random.default_rng(0).rayleigh(1.0, (height_px, width_px))
    image[height_px // 3 : height_px // 2, width_px // 4 : width_px // 2] *= 3
    image[height_px // 3 : height_px // 2, width_px // 2 : width_px * 3 // 4] *= 0.1
    return np.clip(image, 0, 255).astype(np.uint8)
