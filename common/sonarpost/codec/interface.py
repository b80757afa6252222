"""What every codec is: a name, an encoder, a decoder, and one stream header that all streams share.

The stream of any codec is `header || body`. The header is two to seven bytes, the same for all codecs: in a 22-byte
picture every one of them counts. It says codec, model and picture size; how long the body is, whoever carries it knows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from sonarpost.errors import StreamError

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

MIN_SIDE_PX = 16
MAX_SIDE_PX = 512

# Sides that sonar snippets commonly have; a picture with two of these says its size in one byte. Part of the wire
# format: never changed.
COMMON_SIDES_PX = (16, 32, 48, 64, 80, 96, 100, 112, 120, 128, 140, 160, 200, 256, 512)
_OTHER_SIZE = 0xFF


def tag_length(codec_id: int) -> int:
    """Return how many bytes of the model's hash a codec's streams carry.

    Ids below 0x10 have no model. Ids 0x20 to 0x7F have models that ship with releases and are few: one byte tells them
    apart. The others have models that users build, any number of them: two bytes.
    """
    if codec_id < 0x10:
        return 0
    return 1 if 0x20 <= codec_id < 0x80 else 2


@dataclass(frozen=True, slots=True)
class StreamHeader:
    """The start of every codec stream.

    Layout: codec id (u8); model tag (`tag_length` bytes, the first of the model's hash); size: one byte
    15 * row + column into `COMMON_SIDES_PX` for height and width, or, when either side is not among them, 0xFF and
    height and width in 12 bits each. Codes 225 to 254 are reserved. One picture has one header: a receiver compares
    headers to tell which frames belong together.

    Attributes:
        codec_id: 0..255.
        model_tag: 0 up to what `tag_length(codec_id)` bytes hold.
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
        return 1 + tag_length(self.codec_id) + (1 if self._is_common else 4)

    @property
    def _is_common(self) -> bool:
        return self.height_px in COMMON_SIDES_PX and self.width_px in COMMON_SIDES_PX

    def pack(self) -> bytes:
        """Return the `size` bytes. The fields must be within their limits; this does not check them."""
        head = bytes([self.codec_id]) + self.model_tag.to_bytes(tag_length(self.codec_id), "big")
        if self._is_common:
            row, column = COMMON_SIDES_PX.index(self.height_px), COMMON_SIDES_PX.index(self.width_px)
            return head + bytes([len(COMMON_SIDES_PX) * row + column])
        return head + bytes([_OTHER_SIZE]) + ((self.height_px << 12) | self.width_px).to_bytes(3, "big")

    @classmethod
    def unpack(cls, data: bytes, where: str = "stream") -> StreamHeader:
        """Parse the start of `data`.

        Raises:
            StreamError: Too short, a reserved size code, a picture side outside 16..512 px, or two common sides in the
                long form.
        """
        if not data:
            raise StreamError(where, "header", data, f"2 to {cls.MAX_SIZE} bytes")
        after_tag = 1 + tag_length(data[0])
        tag = int.from_bytes(data[1:after_tag], "big")
        code = data[after_tag : after_tag + 1]
        more = data[after_tag + 1 : after_tag + 4]
        if not code or (code[0] == _OTHER_SIZE and len(more) < 3):
            needed = after_tag + (4 if code else 1)
            raise StreamError(where, "header", data, f"at least {needed} bytes for codec {data[0]:#04x}")
        if code[0] != _OTHER_SIZE:
            row, column = divmod(code[0], len(COMMON_SIDES_PX))
            if row >= len(COMMON_SIDES_PX):
                raise StreamError(where, "size", code[0], f"0..{len(COMMON_SIDES_PX) ** 2 - 1} or {_OTHER_SIZE}")
            return cls(data[0], tag, COMMON_SIDES_PX[row], COMMON_SIDES_PX[column])
        size = int.from_bytes(more, "big")
        header = cls(data[0], tag, size >> 12, size & 0xFFF)
        for name, value in (("height_px", header.height_px), ("width_px", header.width_px)):
            if not MIN_SIDE_PX <= value <= MAX_SIDE_PX:
                raise StreamError(where, name, value, f"{MIN_SIDE_PX}..{MAX_SIDE_PX} px")
        if header._is_common:
            raise StreamError(where, "size", size, "the one-byte form of a common size")
        return header


@dataclass(frozen=True, slots=True)
class DecodedImage:
    """A decoded picture and what of it is not measured.

    Attributes:
        image: Shape (height_px, width_px), uint8.
        missing: Same shape, True where no data arrived or the data could not be right; those pixels are black.
        notes: What the decoder met, one line each (for the operator and the side-car file).
    """

    image: Image
    missing: Mask
    notes: tuple[str, ...] = ()


@runtime_checkable
class Codec(Protocol):
    """A codec. Implementations are pure: the same input gives the same bytes on every machine."""

    @property
    def name(self) -> str:
        """Name in the registry and in configurations, for example "vq"."""

    @property
    def codec_id(self) -> int:
        """Number in the stream header, unique in the registry, never reused."""

    @property
    def model_hash(self) -> str:
        """Hex sha256 of the trained model or codebook in use; empty for codecs without one."""

    def encode(self, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], budget_bytes: int | None = None) -> bytes:
        """Return the stream, header included.

        Args:
            image: Shape (16..512, 16..512), uint8 or uint16 (uint16 is mapped to 8 bits over its own full range
                by `to_uint8`).
            budget_bytes: Upper bound of the whole stream's length; None for the codec's natural size.

        Raises:
            StreamError: The picture's size or depth is not supported, or the budget cannot be met.
        """

    def decode(self, stream: bytes, received: Mask | None = None) -> DecodedImage:
        """Rebuild the picture.

        Args:
            stream: Header and body; a body that ends early counts as missing at its end.
            received: Shape (len(stream) - header.size,), False where a body byte did not arrive and its place holds a
                zero; None when everything did.

        Raises:
            StreamError: The header is wrong, or the stream was made with another codec or model.
        """


@runtime_checkable
class ExtensibleCodec(Protocol):
    """A codec that can go on with a stream it has made."""

    def extend(self, stream: bytes, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], budget_bytes: int) -> bytes:
        """Return a longer stream of the picture that begins as `stream` does, but for its last byte.

        Args:
            stream: Of this picture.
            image: The picture, as `encode` had it.
            budget_bytes: Upper bound of the longer stream's length.

        Returns:
            The longer stream; `stream` itself where there is none.

        Raises:
            StreamError: The stream or the picture cannot be used, or they do not belong together.
        """


def received_body(
    stream: bytes, received: Mask | None, codec_id: int, name: str
) -> tuple[StreamHeader, bytes, list[str]]:
    """Return a stream's header, its body up to the first byte that did not arrive, and notes.

    Shared by the codecs that cannot decode anything behind a gap.

    Raises:
        StreamError: The header is wrong, the stream is another codec's, or `received` has not one bool for each
            body byte.
    """
    header = StreamHeader.unpack(stream)
    if header.codec_id != codec_id:
        raise StreamError("stream", "codec_id", f"{header.codec_id:#04x}", f"{codec_id:#04x} ({name})")
    body = stream[header.size :]
    if received is None:
        return header, body, []
    if received.shape != (len(body),) or received.dtype != np.bool_:
        met = f"{received.dtype} {received.shape}"
        raise StreamError("stream", "received", met, f"bool ({len(body)},), one for each body byte")
    gaps = np.flatnonzero(~received)
    if not len(gaps):
        return header, body, []
    return header, body[: gaps[0]], [f"body byte {gaps[0]} of {len(body)} did not arrive; what follows it is not used"]


def model_tag(codec_id: int, model_hash: str) -> int:
    """Return the tag of a model hash that streams of a codec carry; 0 for codecs without a model."""
    return int(model_hash[: 2 * tag_length(codec_id)] or "0", 16)


def check_image(image: npt.NDArray[np.generic], where: str = "image") -> None:
    """Raise StreamError unless `image` is two-dimensional, uint8 or uint16, and 16..512 px a side."""
    if image.ndim != 2:
        raise StreamError(where, "shape", image.shape, "two dimensions (height, width)")
    if image.dtype not in (np.dtype(np.uint8), np.dtype(np.uint16)):
        raise StreamError(where, "dtype", str(image.dtype), "uint8 or uint16")
    for name, value in (("height_px", image.shape[0]), ("width_px", image.shape[1])):
        if not MIN_SIDE_PX <= value <= MAX_SIDE_PX:
            raise StreamError(where, name, value, f"{MIN_SIDE_PX}..{MAX_SIDE_PX} px")


def to_uint8(image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> Image:
    """Map to 8 bits: uint8 unchanged, uint16 from its own minimum..maximum to 0..255 (integer arithmetic)."""
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    low, high = int(image.min()), int(image.max())
    span = max(high - low, 1)
    return (((image.astype(np.int64) - low) * 255 + span // 2) // span).astype(np.uint8)
