"""JPEG 2000 (ISO/IEC 15444-1) through OpenJPEG, one of the four codecs that the paper compares.

Two codecs with the same coder: single tile, one layer, irreversible 9/7 transform, code-blocks of 64 x 64, progression
by resolution.

* `jpeg2000` sends the raw codestream with all markers: about 100 bytes before the first coded bit. Any JPEG 2000
  software reads it. Only OpenJPEG's comment segment is removed.
* `jpeg2000-packets` sends the packets only. The decoder rebuilds main header, tile header and end marker from the image
  size and the parameters above. One byte before the packets holds the number of decompositions and a brightness offset.
  OpenJPEG subtracts 128 from unsigned samples, so without the offset a dark image spends its first bits on its mean.

OpenJPEG's target rate does not go below 30 bytes of packets. The encoder therefore searches over the target quality,
for each number of decompositions, and sends the candidate nearest to the original.

A truncated codestream is rejected, unless OpenJPEG finds all packets complete.
"""

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from PIL import Image as Pillow

from sonarpost.codec.interface import Codec, DecodedImage, Image, Mask, SnippetPixels, decoder_input, encoder_input
from sonarpost.errors import ConfigError, StreamError

RAW_CODEC_ID = 0x02
PACKETS_CODEC_ID = 0x03
DEFAULT_QUALITY_DB = 22.0
MIN_DECOMPOSITIONS = 3
MAX_DECOMPOSITIONS = 6

_SHIFT_STEP = 4
_SEARCH_STEPS = 12
_SEARCH_DB = (1.0, 60.0)
_LARGE_IMAGE_PX = 200 * 200  # from this size, fewer than five decompositions never gain

# Quantiser steps of OpenJPEG for the irreversible transform: the lowest band for 3 to 6 decompositions, and (HL, LH,
# HH) of each decomposition, finest first.
_LOWEST_STEPS = {3: 0x6738, 4: 0x6F20, 5: 0x7720, 6: 0x7F20}
_DETAIL_STEPS = (
    (0x57D3, 0x57D3, 0x5762),
    (0x5005, 0x5005, 0x5047),
    (0x6750, 0x6750, 0x6768),
    (0x6F00, 0x6F00, 0x6EE0),
    (0x76F0, 0x76F0, 0x76C0),
    (0x7EE0, 0x7EE0, 0x7EA0),
)
_SOT, _SOD, _EOC = b"\xff\x90", b"\xff\x93", b"\xff\xd9"


def decode_whole_body(
    codec: Codec, stream: bytes, received: Mask | None, decode_body: Callable[[bytes, tuple[int, int]], Image]
) -> DecodedImage:
    """Decode a stream of a codec that needs its whole body.

    If the bytes before the first gap do not decode, all pixels are missing.

    Args:
        codec: The codec.
        stream: See `Codec.decode`.
        received: See `Codec.decode`.
        decode_body: Returns the image of a body and an image size, (height_px, width_px).

    Raises:
        StreamError: As `decoder_input` and, if all bytes arrived, as `decode_body`.
    """
    header, body, notes = decoder_input(codec, stream, received)
    try:
        return DecodedImage.without_gaps(decode_body(body, (header.height_px, header.width_px)), notes)
    except StreamError as error:
        if received is None or received.all():
            raise
        return DecodedImage.all_missing(header, [*notes, f"nothing can be decoded: {error}"])


def main_header(height_px: int, width_px: int, decompositions: int) -> bytes:
    """Return SOC, SIZ, COD and QCD of the codestreams of this module (ISO/IEC 15444-1, annex A)."""
    width, height = width_px.to_bytes(4, "big"), height_px.to_bytes(4, "big")
    origin = bytes(8)
    siz = b"\0\0" + width + height + origin + width + height + origin + b"\0\1" + b"\x07\1\1"  # one component, 8 bits
    cod = b"\0" + b"\0" + b"\0\1" + b"\0" + bytes([decompositions, 4, 4, 0, 0])  # LRCP, one layer, 64 x 64, 9/7
    steps = [_LOWEST_STEPS[decompositions]]
    for detail in reversed(_DETAIL_STEPS[:decompositions]):
        steps += detail
    qcd = b"\x42" + b"".join(step.to_bytes(2, "big") for step in steps)  # two guard bits, a step for each band
    return b"\xff\x4f" + _segment(0x51, siz) + _segment(0x52, cod) + _segment(0x5C, qcd)


def codestream(height_px: int, width_px: int, decompositions: int, packets: bytes) -> bytes:
    """Return the whole codestream around the packets of its one tile."""
    tile = _SOT + b"\0\x0a" + b"\0\0" + (len(packets) + 14).to_bytes(4, "big") + b"\0\1" + _SOD
    return main_header(height_px, width_px, decompositions) + tile + packets + _EOC


def packets_of(stream: bytes, height_px: int, width_px: int) -> tuple[int, bytes]:
    """Return the number of decompositions and the packets of a codestream. The inverse of `codestream`.

    Raises:
        StreamError: It is not a complete codestream with the parameters of this module.
    """
    for decompositions in range(MIN_DECOMPOSITIONS, MAX_DECOMPOSITIONS + 1):
        start = len(main_header(height_px, width_px, decompositions)) + 14
        packets = stream[start : -len(_EOC)]
        if stream == codestream(height_px, width_px, decompositions, packets):
            return decompositions, packets
    expected = f"a complete codestream of one tile, {width_px} × {height_px} px, 9/7, 64 × 64 blocks"
    raise StreamError("jpeg2000 body", "codestream", stream, expected)


@dataclass(frozen=True)
class _Candidate:
    """One way to encode the image, and its squared error."""

    decompositions: int
    shift: int
    packets: bytes
    error: int


@dataclass(frozen=True)
class Jpeg2000Codec:
    """JPEG 2000, with or without its headers. Implements `sonarpost.codec.Codec`.

    Attributes:
        packets_only: Whether only the packets are sent.
    """

    packets_only: bool = False
    model_hash: ClassVar[str] = ""

    @property
    def name(self) -> str:
        """Name in the registry."""
        return "jpeg2000-packets" if self.packets_only else "jpeg2000"

    @property
    def codec_id(self) -> int:
        """Codec id in the stream header."""
        return PACKETS_CODEC_ID if self.packets_only else RAW_CODEC_ID

    def encode(self, image: SnippetPixels, budget_bytes: int | None = None) -> bytes:
        """Return the stream (see `Codec.encode`); without a budget, at a target PSNR of 22 dB."""
        grey, header = encoder_input(self, image)
        best = min(self._candidates(grey, header.size, budget_bytes), key=lambda c: c.error, default=None)
        if best is None:
            expected = "a larger budget: the coarsest quality does not fit"
            raise StreamError(f"codec {self.name}", "budget_bytes", budget_bytes, expected)
        return header.pack() + self._body(best, grey.shape)

    def decode(self, stream: bytes, received: Mask | None = None) -> DecodedImage:
        """Reconstruct the image (see `decode_whole_body`)."""
        return decode_whole_body(self, stream, received, self._decode_body)

    def _decode_body(self, body: bytes, shape: tuple[int, int]) -> Image:
        if not self.packets_only:
            packets_of(body, *shape)  # checks the size before OpenJPEG allocates memory for it
            return _decode(body)
        if not body:
            raise StreamError("jpeg2000 body", "length", 0, "at least 1 B")
        decompositions, shift = MIN_DECOMPOSITIONS + (body[0] >> 6), _SHIFT_STEP * ((body[0] & 0x3F) - 32)
        return _shifted(_decode(codestream(*shape, decompositions, body[1:])), -shift)

    def _body(self, chosen: _Candidate, shape: tuple[int, ...]) -> bytes:
        if not self.packets_only:
            return codestream(shape[0], shape[1], chosen.decompositions, chosen.packets)
        parameters = (chosen.decompositions - MIN_DECOMPOSITIONS) << 6 | (chosen.shift // _SHIFT_STEP + 32)
        return bytes([parameters]) + chosen.packets

    def _candidates(self, grey: Image, header_bytes: int, budget_bytes: int | None) -> Iterator[_Candidate]:
        """Yield the best candidate within the budget for each number of decompositions and each brightness offset."""
        shifts = {0}
        if self.packets_only:
            centre = (128 - int(grey.sum(dtype=np.int64)) // grey.size) // _SHIFT_STEP
            shifts.add(_SHIFT_STEP * min(max(centre, -32), 31))
        allowed = (5,) if grey.size >= _LARGE_IMAGE_PX else (3, 4, 5)
        # OpenJPEG rejects decompositions below one sample a side.
        for decompositions in (number for number in allowed if 1 << number <= min(grey.shape)):
            for shift in sorted(shifts):
                overhead = header_bytes + len(self._body(_Candidate(decompositions, shift, b"", 0), grey.shape))
                shifted = _shifted(grey, shift)
                if budget_bytes is None:
                    packets: bytes | None = _encode(shifted, decompositions, DEFAULT_QUALITY_DB)
                else:
                    packets = _search(shifted, decompositions, budget_bytes - overhead)
                if packets is not None:
                    reconstructed = _shifted(
                        _decode(codestream(grey.shape[0], grey.shape[1], decompositions, packets)), -shift
                    )
                    error = int(((reconstructed.astype(np.int64) - grey) ** 2).sum())
                    yield _Candidate(decompositions, shift, packets, error)


def _segment(marker: int, content: bytes) -> bytes:
    return bytes([0xFF, marker]) + (len(content) + 2).to_bytes(2, "big") + content


def _shifted(image: Image, shift: int) -> Image:
    return np.asarray(np.clip(image.astype(np.int16) + shift, 0, 255), dtype=np.uint8)


def _search(image: Image, decompositions: int, limit_bytes: int) -> bytes | None:
    """Return the packets of the best quality of at most `limit_bytes`, or None."""
    best = None
    low, high = _SEARCH_DB
    for step in range(_SEARCH_STEPS + 1):
        quality_db = low if step == 0 else (low + high) / 2  # the coarsest first: if it does not fit, nothing fits
        packets = _encode(image, decompositions, quality_db)
        if len(packets) <= limit_bytes:
            best = packets
            low = quality_db
        elif step == 0:
            return None
        else:
            high = quality_db
    return best


def _encode(image: Image, decompositions: int, quality_db: float) -> bytes:
    """Return the packets that OpenJPEG writes.

    Raises:
        ConfigError: This OpenJPEG writes other parameters than the decoder assumes.
    """
    file = io.BytesIO()
    Pillow.fromarray(image).save(
        file,
        "JPEG2000",
        no_jp2=True,
        irreversible=True,
        num_resolutions=decompositions + 1,
        quality_mode="dB",
        quality_layers=[quality_db],
    )
    stream = _without_comments(file.getvalue())
    try:
        written, packets = packets_of(stream, image.shape[0], image.shape[1])
    except StreamError as error:
        raise ConfigError("OpenJPEG", "codestream", stream[:120].hex(), "the parameters of version 2.5") from error
    if written != decompositions:
        raise ConfigError("OpenJPEG", "decompositions", written, str(decompositions))
    return packets


def _without_comments(stream: bytes) -> bytes:
    """Return the codestream without the comment segments (COM) of its main header."""
    kept, at = [stream[:2]], 2
    while stream[at : at + 2] not in (_SOT, b""):
        end = at + 2 + int.from_bytes(stream[at + 2 : at + 4], "big")
        if stream[at : at + 2] != b"\xff\x64":
            kept.append(stream[at:end])
        at = end
    return b"".join(kept) + stream[at:]


def _decode(stream: bytes) -> Image:
    """Return the image of a codestream with a main header of this module.

    Raises:
        StreamError: OpenJPEG rejects it.
    """
    try:
        with Pillow.open(io.BytesIO(stream), formats=["JPEG2000"]) as file:
            return np.array(file, dtype=np.uint8)
    except Exception as error:  # Pillow raises many types on damaged data
        raise StreamError("jpeg2000 body", "packets", repr(error), "packets that OpenJPEG decodes") from error
