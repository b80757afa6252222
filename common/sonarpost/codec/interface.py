"""The interface of all codecs, and the header that starts every stream.

A stream is `header || body`. The header has 2 to 7 bytes and the same layout for all codecs. It holds the codec, the
tag of the model and the image size. The length of the body is not in the stream: the transport knows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from sonarpost.errors import StreamError

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
SnippetPixels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

MIN_SIDE_PX = 16
MAX_SIDE_PX = 512

# Common sides of sonar snippets. The header encodes a pair of them in one byte. Part of the wire format: never change.
COMMON_SIDES_PX = (16, 32, 48, 64, 80, 96, 100, 112, 120, 128, 140, 160, 200, 256, 512)
_EXPLICIT_SIZE = 0xFF


def tag_length(codec_id: int) -> int:
    """Return the number of tag bytes in the streams of a codec.

    The tag is the start of the model's hash. Codec ids below 0x10 have no model. Ids 0x20 to 0x7F have a few models,
    shipped with the releases: one byte. All other ids can have any number of models, built by users: two bytes.
    """
    if codec_id < 0x10:
        return 0
    return 1 if 0x20 <= codec_id < 0x80 else 2


@dataclass(frozen=True, slots=True)
class StreamHeader:
    """The header of a stream.

    Layout: codec id (u8); model tag (`tag_length` bytes); size. The size is one byte, 15 * row + column in
    `COMMON_SIDES_PX` of height and width. If a side is not in that table, the size is 0xFF, then height and width in 12
    bits each. Codes 225 to 254 are reserved. All frames of an image have the same header, so receivers compare headers
    to assign a frame to its image.

    Attributes:
        codec_id: 0..255.
        model_tag: Unsigned number of `tag_length(codec_id)` bytes.
        height_px: 16..512.
        width_px: 16..512.
    """

    codec_id: int
    model_tag: int
    height_px: int
    width_px: int

    MAX_SIZE = 7

    @property
    def size(self) -> int:
        """Length of the header in bytes."""
        return 1 + tag_length(self.codec_id) + (1 if self._has_common_size else 4)

    @property
    def _has_common_size(self) -> bool:
        return self.height_px in COMMON_SIDES_PX and self.width_px in COMMON_SIDES_PX

    def pack(self) -> bytes:
        """Return the `size` bytes of the header. Does not check the ranges of the fields."""
        start = bytes([self.codec_id]) + self.model_tag.to_bytes(tag_length(self.codec_id), "big")
        if self._has_common_size:
            row, column = COMMON_SIDES_PX.index(self.height_px), COMMON_SIDES_PX.index(self.width_px)
            return start + bytes([len(COMMON_SIDES_PX) * row + column])
        return start + bytes([_EXPLICIT_SIZE]) + ((self.height_px << 12) | self.width_px).to_bytes(3, "big")

    @classmethod
    def unpack(cls, data: bytes, where: str = "stream") -> StreamHeader:
        """Parse the header at the start of `data`.

        Raises:
            StreamError: `data` is too short, the size code is reserved, a side is outside 16..512 px, or two common
                sides are written in the long form.
        """
        if not data:
            raise StreamError(where, "header", data, f"2 to {cls.MAX_SIZE} bytes")
        tag_end = 1 + tag_length(data[0])
        tag = int.from_bytes(data[1:tag_end], "big")
        code = data[tag_end : tag_end + 1]
        explicit_size = data[tag_end + 1 : tag_end + 4]
        if not code or (code[0] == _EXPLICIT_SIZE and len(explicit_size) < 3):
            needed = tag_end + (4 if code else 1)
            raise StreamError(where, "header", data, f"at least {needed} bytes for codec {data[0]:#04x}")
        if code[0] != _EXPLICIT_SIZE:
            row, column = divmod(code[0], len(COMMON_SIDES_PX))
            if row >= len(COMMON_SIDES_PX):
                raise StreamError(where, "size", code[0], f"0..{len(COMMON_SIDES_PX) ** 2 - 1} or {_EXPLICIT_SIZE}")
            return cls(data[0], tag, COMMON_SIDES_PX[row], COMMON_SIDES_PX[column])
        size = int.from_bytes(explicit_size, "big")
        header = cls(data[0], tag, size >> 12, size & 0xFFF)
        _check_sides(where, header.height_px, header.width_px)
        if header._has_common_size:
            raise StreamError(where, "size", size, "the one-byte form of a common size")
        return header


@dataclass(frozen=True, slots=True)
class DecodedImage:
    """A decoded image and its missing pixels.

    Attributes:
        image: Shape (height_px, width_px), uint8.
        missing: Same shape, True where no valid data arrived. Missing pixels are black.
        notes: Remarks of the decoder, one line each, for operators and the side-car file.
        despeckle_strength: Strength of the encoder's despeckling, 0..1; None if the stream does not contain it.
    """

    image: Image
    missing: Mask
    notes: tuple[str, ...] = ()
    despeckle_strength: float | None = None

    @classmethod
    def without_gaps(
        cls, image: Image, notes: Sequence[str] = (), despeckle_strength: float | None = None
    ) -> DecodedImage:
        """Return an image in which no pixel is missing."""
        return cls(image, np.zeros(image.shape, np.bool_), tuple(notes), despeckle_strength)

    @classmethod
    def all_missing(cls, header: StreamHeader, notes: Sequence[str]) -> DecodedImage:
        """Return a black image of the header's size in which all pixels are missing."""
        shape = (header.height_px, header.width_px)
        return cls(np.zeros(shape, np.uint8), np.ones(shape, np.bool_), tuple(notes))


@runtime_checkable
class Codec(Protocol):
    """A codec. Deterministic: the same input gives the same bytes on every machine."""

    @property
    def name(self) -> str:
        """Name in the registry and in configuration files, for example "vq"."""

    @property
    def codec_id(self) -> int:
        """Codec id in the stream header. Unique in the registry, never reused."""

    @property
    def model_hash(self) -> str:
        """Hex SHA-256 of the trained model or codebook; empty for codecs without a model."""

    def encode(self, image: SnippetPixels, budget_bytes: int | None = None) -> bytes:
        """Return the stream of a snippet, header included.

        Args:
            image: Shape (16..512, 16..512), uint8 or uint16. `to_uint8` maps uint16 to 8 bits.
            budget_bytes: Maximum length of the stream. None: the codec's default size or quality.

        Raises:
            StreamError: Size or dtype is not supported, or the budget is too small.
        """

    def decode(self, stream: bytes, received: Mask | None = None) -> DecodedImage:
        """Reconstruct the image.

        Args:
            stream: Header and body. The end of a truncated body counts as missing.
            received: Shape (len(stream) - header.size,), False for each body byte that did not arrive and was replaced
                by zero. None: all bytes arrived.

        Raises:
            StreamError: The header is invalid, the stream belongs to another codec or model, or the body is damaged in
                a way that the codec cannot decode.
        """


@runtime_checkable
class ExtensibleCodec(Protocol):
    """A codec that can extend a stream it has made."""

    def extend(self, stream: bytes, image: SnippetPixels, budget_bytes: int) -> bytes:
        """Return a longer stream of the same snippet. It starts with `stream` except for the last byte of `stream`.

        Args:
            stream: A stream of this snippet.
            image: The snippet, as passed to `encode`.
            budget_bytes: Maximum length of the longer stream.

        Returns:
            The longer stream, or `stream` itself if it cannot be extended.

        Raises:
            StreamError: The stream or the snippet is invalid, or their sizes differ.
        """


def encoder_input(codec: Codec, image: SnippetPixels) -> tuple[Image, StreamHeader]:
    """Check a snippet; return its pixels in 8 bits and the header of its stream.

    Raises:
        StreamError: Size or dtype is not supported.
    """
    check_image(image)
    tag = model_tag(codec.codec_id, codec.model_hash)
    return to_uint8(image), StreamHeader(codec.codec_id, tag, image.shape[0], image.shape[1])


def decoder_input(codec: Codec, stream: bytes, received: Mask | None) -> tuple[StreamHeader, bytes, list[str]]:
    """Return the header of a stream, its body before the first missing byte, and notes.

    For codecs that cannot decode data after a gap.

    Raises:
        StreamError: The header is invalid, the stream belongs to another codec, or `received` does not have one bool
            for each body byte.
    """
    header = StreamHeader.unpack(stream)
    if header.codec_id != codec.codec_id:
        expected = f"{codec.codec_id:#04x} ({codec.name})"
        raise StreamError("stream", "codec_id", f"{header.codec_id:#04x}", expected)
    return header, *before_gap(stream[header.size :], received)


def before_gap(body: bytes, received: Mask | None) -> tuple[bytes, list[str]]:
    """Return the bytes before the first missing one, and a note if there is a gap.

    Raises:
        StreamError: `received` does not have one bool for each body byte.
    """
    if received is None:
        return body, []
    check_received(received, len(body))
    gaps = np.flatnonzero(~received)
    if not len(gaps):
        return body, []
    return body[: gaps[0]], [f"body byte {gaps[0]} of {len(body)} did not arrive; later bytes are not used"]


def check_received(received: Mask, body_bytes: int) -> None:
    """Raise StreamError unless `received` has one bool for each body byte."""
    if received.shape != (body_bytes,) or received.dtype != np.bool_:
        actual = f"{received.dtype} {received.shape}"
        raise StreamError("stream", "received", actual, f"bool ({body_bytes},), one for each body byte")


def model_tag(codec_id: int, model_hash: str) -> int:
    """Return the tag of a model in the streams of a codec; 0 for codecs without a model."""
    return int(model_hash[: 2 * tag_length(codec_id)] or "0", 16)


def check_image(image: npt.NDArray[np.generic]) -> None:
    """Raise StreamError unless `image` is two-dimensional, uint8 or uint16, with sides of 16..512 px."""
    if image.ndim != 2:
        raise StreamError("image", "shape", image.shape, "two dimensions (height, width)")
    if image.dtype not in (np.dtype(np.uint8), np.dtype(np.uint16)):
        raise StreamError("image", "dtype", str(image.dtype), "uint8 or uint16")
    _check_sides("image", *image.shape)


def _check_sides(where: str, height_px: int, width_px: int) -> None:
    for name, value in (("height_px", height_px), ("width_px", width_px)):
        if not MIN_SIDE_PX <= value <= MAX_SIDE_PX:
            raise StreamError(where, name, value, f"{MIN_SIDE_PX}..{MAX_SIDE_PX} px")


def to_uint8(image: SnippetPixels) -> Image:
    """Map pixels to 8 bits: uint8 unchanged, uint16 from its own minimum..maximum to 0..255 (integer arithmetic)."""
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    low, high = int(image.min()), int(image.max())
    span = max(high - low, 1)
    return (((image.astype(np.int64) - low) * 255 + span // 2) // span).astype(np.uint8)
