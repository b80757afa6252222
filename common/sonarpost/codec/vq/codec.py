"""The paper's codec: an image as indices of tiles in a database that both ends have.

The image is cut into tiles that cover it; edge tiles repeat the last row and column, and the decoder crops. Each tile
is replaced by the index of the nearest database tile. Indices are sent in raster order, so the first half of the body
is the top half of the image.

Two differences from the paper:

* Stored tile i is sent as i + 1; index 0 is reserved. Modem drivers and the pairing of halves fill missing data with
  zeros. In the paper these decode as tile 0, which looks like measured seabed. Here a zero decodes as a black tile that
  is marked as missing.
* The paper does not send edge pixels that do not fill a tile. Here the whole image is sent.

An index above the last tile, or ASCII other than digits, indicates a damaged packet: the tile is black and missing, as
in the paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from sonarpost.codec.interface import (
    DecodedImage,
    Mask,
    SnippetPixels,
    StreamHeader,
    check_received,
    encoder_input,
    model_tag,
)
from sonarpost.codec.vq.tiles import TileDatabase, cut_tiles, join_tiles, tile_grid
from sonarpost.errors import ConfigError, StreamError

MAX_BODY_BYTES = 0xFFFF

_WireIndices = npt.NDArray[np.int64]


class IndexPacking(Enum):
    """Format of an index. Each packing has its own codec id.

    `BITS14` is the compact form. The others are the forms of the paper: 2 bytes (its Fig. 2), 3 bytes, and 5 ASCII
    decimal digits.
    """

    BITS14 = "14bit"
    BYTES2 = "2byte"
    BYTES3 = "3byte"
    ASCII5 = "ascii5"

    @property
    def codec_id(self) -> int:
        """Codec id in the stream header: 0x10..0x13."""
        return {"14bit": 0x10, "2byte": 0x11, "3byte": 0x12, "ascii5": 0x13}[self.value]

    @property
    def max_index(self) -> int:
        """Largest wire index."""
        return 99_999 if self is IndexPacking.ASCII5 else (1 << self.bits) - 1

    @property
    def bits(self) -> int:
        """Bits of one index."""
        return {"14bit": 14, "2byte": 16, "3byte": 24, "ascii5": 40}[self.value]

    def body_length(self, indices: int) -> int:
        """Return the bytes of a body. Unused bits at the end are zero."""
        return -(-indices * self.bits // 8)

    @classmethod
    def from_codec_id(cls, codec_id: int) -> IndexPacking | None:
        """Return the packing of a codec id, or None for an id of another codec."""
        return next((packing for packing in cls if packing.codec_id == codec_id), None)


def codebook_tag(tiles: TileDatabase) -> int:
    """Return the tag of a tile database in stream headers, the same for every packing."""
    return model_tag(IndexPacking.BITS14.codec_id, tiles.identity)


@dataclass(frozen=True)
class VqCodec:
    """Vector quantisation with a shared tile database. Implements `sonarpost.codec.Codec`.

    Attributes:
        tiles: The database. Its identity is the model hash.
        packing: Format of the indices.

    Raises:
        ConfigError: The database has more tiles than the packing can number.
    """

    tiles: TileDatabase
    packing: IndexPacking = IndexPacking.BITS14
    name: ClassVar[str] = "vq"

    def __post_init__(self) -> None:
        if len(self.tiles) > self.packing.max_index:
            packing = f"{self.packing.value} for {len(self.tiles)} tiles"
            expected = f"at most {self.packing.max_index} tiles, or a wider packing"
            raise ConfigError("codec vq", "packing", packing, expected)

    @property
    def codec_id(self) -> int:
        """The packing's codec id."""
        return self.packing.codec_id

    @property
    def model_hash(self) -> str:
        """Identity of the tile database."""
        return self.tiles.identity

    def encode(self, image: SnippetPixels, budget_bytes: int | None = None) -> bytes:
        """Return the stream (see `Codec.encode`). Its length depends on the image size only.

        Raises:
            StreamError: Size or dtype is not supported, or the stream exceeds the budget or 65,535 body bytes.
        """
        grey, header = encoder_input(self, image)
        length = self._body_length(header.height_px, header.width_px)
        limit = MAX_BODY_BYTES if budget_bytes is None else min(budget_bytes - header.size, MAX_BODY_BYTES)
        if length > limit:
            needed = f"at least {length + header.size} B for {header.width_px} × {header.height_px} px"
            raise StreamError("codec vq", "budget_bytes", limit + header.size, needed)
        indices, _ = self.tiles.nearest(cut_tiles(grey, self.tiles.tile_px))
        return header.pack() + pack_indices(indices + 1, self.packing)

    def decode(self, stream: bytes, received: Mask | None = None) -> DecodedImage:
        """Reconstruct the image (see `Codec.decode`). Tiles with a missing or invalid index are black and missing."""
        header = self._check_header(stream)
        length = self._body_length(header.height_px, header.width_px)
        body, arrived, notes = _padded_body(stream[header.size :], length, received)
        rows, columns = tile_grid(header.height_px, header.width_px, self.tiles.tile_px)
        wire = unpack_indices(body, rows * columns, self.packing)
        lost = ~_indices_arrived(arrived, rows * columns, self.packing.bits)
        empty = ~lost & (wire == 0)
        damaged = ~lost & ((wire < 0) | (wire > len(self.tiles)))
        missing = lost | empty | damaged
        notes += [
            f"{int(count)} of {rows * columns} tiles {what}"
            for count, what in (
                (lost.sum(), "did not arrive"),
                (empty.sum(), "have the reserved index 0 (zero padding)"),
                (damaged.sum(), "have an index outside the codebook (damaged packet)"),
            )
            if count
        ]
        chosen = self.tiles.tiles[np.where(missing, 0, wire - 1)]
        chosen[missing] = 0
        mask = np.repeat(missing[:, None].astype(np.uint8), self.tiles.tile_px**2, axis=1)
        size = (header.height_px, header.width_px, self.tiles.tile_px)
        return DecodedImage(join_tiles(chosen, *size), join_tiles(mask, *size).astype(np.bool_), tuple(notes))

    def _body_length(self, height_px: int, width_px: int) -> int:
        rows, columns = tile_grid(height_px, width_px, self.tiles.tile_px)
        return self.packing.body_length(rows * columns)

    def _check_header(self, stream: bytes) -> StreamHeader:
        header = StreamHeader.unpack(stream)
        if header.codec_id != self.codec_id:
            expected = f"{self.codec_id:#04x} (vq, {self.packing.value} indices)"
            raise StreamError("stream", "codec_id", f"{header.codec_id:#04x}", expected)
        tag = codebook_tag(self.tiles)
        if header.model_tag != tag:
            expected = f"{tag:#06x}: the stream was made with a codebook of another identity"
            raise StreamError("stream", "model_tag", f"{header.model_tag:#06x}", expected)
        return header


def pack_indices(indices: _WireIndices, packing: IndexPacking) -> bytes:
    """Pack wire indices, shape (n,), each 0..`packing.max_index`, most significant bit or digit first."""
    if packing is IndexPacking.ASCII5:
        digits = indices[:, None] // 10 ** np.arange(4, -1, -1) % 10
        return (digits + ord("0")).astype(np.uint8).tobytes()
    shifts = np.arange(packing.bits - 1, -1, -1)
    bits = (indices[:, None] >> shifts) & 1
    return np.packbits(bits.astype(np.uint8).ravel()).tobytes()


def unpack_indices(body: bytes, count: int, packing: IndexPacking) -> _WireIndices:
    """Unpack `count` wire indices, shape (count,), int64; -1 for ASCII other than five digits.

    Five zero bytes, the padding of ASCII digits, give 0, as zero bits do in the other packings.
    """
    data = np.frombuffer(body, dtype=np.uint8)
    if packing is IndexPacking.ASCII5:
        characters = data[: count * 5].reshape(count, 5).astype(np.int64)
        digits = characters - ord("0")
        values = digits @ (10 ** np.arange(4, -1, -1, dtype=np.int64))
        good = ((digits >= 0) & (digits <= 9)).all(axis=1)
        padding = (characters == 0).all(axis=1)
        return np.where(padding, 0, np.where(good, values, -1)).astype(np.int64)
    bits = np.unpackbits(data)[: count * packing.bits].reshape(count, packing.bits).astype(np.int64)
    return np.asarray(bits @ (np.int64(1) << np.arange(packing.bits - 1, -1, -1, dtype=np.int64)), dtype=np.int64)


def _padded_body(body: bytes, length: int, received: Mask | None) -> tuple[bytes, Mask, list[str]]:
    """Truncate or zero-pad the body to `length`; return it with a mask of the bytes that arrived, and notes."""
    if received is None:
        received = np.ones(len(body), dtype=np.bool_)
    check_received(received, len(body))
    arrived = np.zeros(length, dtype=np.bool_)
    arrived[: len(body)] = received[:length]
    notes = []
    if len(body) < length:
        notes.append(f"body ends after {len(body)} of {length} B")
    if len(body) > length:
        notes.append(f"{len(body) - length} B after the body ignored")
    return body[:length].ljust(length, b"\0"), arrived, notes


def _indices_arrived(arrived: Mask, count: int, bits: int) -> Mask:
    """Return, shape (count,), whether all bytes of each index arrived."""
    lost_before = np.concatenate(([0], np.cumsum(~arrived)))
    first_bit = np.arange(count) * bits
    first, last = first_bit // 8, (first_bit + bits - 1) // 8
    return np.asarray(lost_before[last + 1] == lost_before[first], dtype=np.bool_)
