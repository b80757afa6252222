"""Huffman coding of quantised grey levels, one of the four codecs the paper compares.

Up to 16 grey levels are chosen for the picture so that the squared error is least (by dynamic programming over its
histogram); more are equally spaced, and with a spacing of 1 the picture is exact. Every pixel costs at least one bit,
so for small budgets the picture is first reduced to n/32 of its sides. Of all n, each with as many levels as fit, the
one with the least error after enlarging again is sent: a few levels in full resolution are often worse than many in
less.

Body, most significant bit first: n - 1 (u8); kind (u8); levels; code lengths; the pixels in raster order.

* kind 0..15: kind + 1 levels follow, one byte each, rising.
* kind 16..30: levels are spaced by kind - 15; lowest level (u8) and number of levels - 1 (u8) follow.
* Code lengths, 0 (level unused) to 15, as differences from the one before (the first from 0) in Elias gamma code of
  2d + 1 (d >= 0) or -2d. Absent for one level (no pixel needs a bit) and for two (one bit each). The codes
  are canonical.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarpost.codec.baselines.huffman_code import Bits, EndOfBitsError, read_symbols
from sonarpost.codec.baselines.huffman_levels import (
    FULL_SCALE,
    MAX_CHOSEN_LEVELS,
    chosen_levels,
    enlarge,
    enlarge_mask,
    nearest,
    read_levels,
    reduced_side,
)
from sonarpost.codec.interface import DecodedImage, Mask, StreamHeader, check_image, received_body, to_uint8
from sonarpost.errors import ConfigError, StreamError

CODEC_ID = 0x01
NATURAL_LEVELS = 4


@dataclass(frozen=True)
class HuffmanCodec:
    """Huffman coding of grey levels. Satisfies `sonarpost.codec.interface.Codec`.

    Attributes:
        levels: Grey levels when no budget is given, 1..16.

    Raises:
        ConfigError: `levels` is out of bounds.
    """

    levels: int = NATURAL_LEVELS

    def __post_init__(self) -> None:
        if not 1 <= self.levels <= MAX_CHOSEN_LEVELS:
            raise ConfigError("codec huffman", "levels", self.levels, f"1..{MAX_CHOSEN_LEVELS}")

    @property
    def name(self) -> str:
        """Name in the registry."""
        return "huffman"

    @property
    def codec_id(self) -> int:
        """Number in the stream header."""
        return CODEC_ID

    @property
    def model_hash(self) -> str:
        """Empty: there is no model."""
        return ""

    def encode(self, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], budget_bytes: int | None = None) -> bytes:
        """Return the stream.

        Args:
            image: Shape (16..512, 16..512), uint8 or uint16 (uint16 is mapped to 8 bits by `to_uint8`).
            budget_bytes: Most bytes of the whole stream; the number of levels and the resolution that show most within
                it are used. None for `levels` grey levels in full resolution, as in the paper.

        Raises:
            StreamError: Size or dtype is not supported, or not even one level fits the budget.
        """
        check_image(image)
        grey = to_uint8(image)
        header = StreamHeader(CODEC_ID, 0, grey.shape[0], grey.shape[1]).pack()
        if budget_bytes is None:
            return header + next(chosen_levels(grey, FULL_SCALE, [self.levels])).body()
        limit = 8 * (budget_bytes - len(header))
        coded = nearest(grey, limit)
        if coded is None:
            raise StreamError("codec huffman", "budget_bytes", budget_bytes, f"at least {len(header) + 3} B")
        return header + coded.body()

    def decode(self, stream: bytes, received: Mask | None = None) -> DecodedImage:
        """Rebuild the picture; pixels behind the first byte that did not arrive are black and missing.

        Args:
            stream: Header and body; bytes beyond the last pixel's are ignored and noted.
            received: Shape (body bytes in `stream`,), False where a body byte did not arrive.

        Raises:
            StreamError: The header is wrong, the stream is another codec's, or levels or code lengths cannot be
                right.
        """
        header, body, notes = received_body(stream, received, CODEC_ID, self.name)
        shape = (header.height_px, header.width_px)
        bits = Bits(body)
        try:
            scale, levels = read_levels(bits)
            symbols, count = read_symbols(
                bits, len(levels), reduced_side(shape[0], scale) * reduced_side(shape[1], scale)
            )
        except EndOfBitsError:
            notes.append(f"body ends after {len(body)} B, before the first pixel")
            return DecodedImage(np.zeros(shape, np.uint8), np.ones(shape, np.bool_), tuple(notes))
        if count < len(symbols):
            notes.append(f"{len(symbols) - count} of {len(symbols)} pixels did not arrive")
        elif bits.bytes_left:
            notes.append(f"{bits.bytes_left} B after the body ignored")
        small = (reduced_side(shape[0], scale), reduced_side(shape[1], scale))
        lost = (np.arange(len(symbols)) >= count).reshape(small)
        rebuilt = enlarge(levels[symbols].reshape(small).astype(np.uint8), shape)
        missing = enlarge_mask(lost, shape)
        rebuilt[missing] = 0
        return DecodedImage(rebuilt, missing, tuple(notes))
