"""What every codec is: a name, an encoder, a decoder, and one stream header that all streams share.

The stream of any codec is `header || body`. The header is 8 bytes, the same for all codecs, so that the acoustic
link can repeat it in every frame and a receiver knows picture size, codec, model and body length from any of them.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from sonarpost.errors import StreamError

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

MIN_SIDE_PX = 16
MAX_SIDE_PX = 512


@dataclass(frozen=True, slots=True)
class StreamHeader:
    """The first 8 bytes of every codec stream.

    Layout, big endian: codec id (u8); model tag (u16, the first two bytes of the model's hash, 0 for codecs
    without a model); height and width in pixels (12 bits each); body length in bytes (u16).
    """

    codec_id: int
    model_tag: int
    height_px: int
    width_px: int
    body_length: int

    SIZE = 8

    def pack(self) -> bytes:
        """Return the 8 bytes."""
        size = (self.height_px << 12) | self.width_px
        return struct.pack(">BH3sH", self.codec_id, self.model_tag, size.to_bytes(3, "big"), self.body_length)

    @classmethod
    def unpack(cls, data: bytes, where: str = "stream") -> StreamHeader:
        """Parse the first 8 bytes of `data`.

        Raises:
            StreamError: Too short, or a picture size outside 16..512 px.
        """
        if len(data) < cls.SIZE:
            raise StreamError(where, "header", data, f"at least {cls.SIZE} bytes")
        codec_id, model_tag, size_bytes, body_length = struct.unpack(">BH3sH", data[: cls.SIZE])
        size = int.from_bytes(size_bytes, "big")
        height_px, width_px = size >> 12, size & 0xFFF
        for name, value in (("height_px", height_px), ("width_px", width_px)):
            if not MIN_SIDE_PX <= value <= MAX_SIDE_PX:
                raise StreamError(where, name, value, f"{MIN_SIDE_PX}..{MAX_SIDE_PX} px")
        return cls(codec_id, model_tag, height_px, width_px, body_length)


@dataclass(frozen=True, slots=True)
class Decoded:
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
        """Hex sha256 of the trained model or catalogue in use; empty for codecs without one."""

    def encode(self, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], budget_bytes: int | None = None) -> bytes:
        """Return the stream, header included.

        Args:
            image: Shape (16..512, 16..512), uint8 or uint16 (uint16 is mapped to 8 bits over its own full range
                by `to_uint8`).
            budget_bytes: Upper bound of the whole stream's length; None for the codec's natural size.

        Raises:
            StreamError: The picture's size or depth is not supported, or the budget cannot be met.
        """

    def decode(self, stream: bytes, received: Mask | None = None) -> Decoded:
        """Rebuild the picture.

        Args:
            stream: Header and body; a body shorter than the header says counts as missing at its end.
            received: Shape (body_length,), False where a body byte did not arrive and its place holds a zero;
                None when everything did.

        Raises:
            StreamError: The header is wrong, or the stream was made with another codec or model.
        """


def model_tag(model_hash: str) -> int:
    """Return the 16-bit tag of a model hash that travels in the stream header."""
    return int(model_hash[:4], 16) if model_hash else 0


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
