"""The paper's codec: a picture as the indices of tiles in a database that both ends hold.

The picture is cut into tiles that cover all of it (edge tiles are filled by repeating the last row and column, the
decoder crops); each tile is replaced by the index of the nearest database tile; indices travel in raster order, so
the first half of the body is the top half of the picture.

Two departures from the paper, both about honesty:

* **Stored tile i travels as i + 1; index 0 is reserved.** Modem drivers and the paper's own pairing of halves fill
  what did not arrive with zeros. In the paper these zeros decode as tile 0, a piece of seabed that nobody measured.
  Here a zero decodes as a black tile that is marked missing.
* The paper leaves edge pixels that do not fill a tile unsent; here the whole picture is sent.

An index above the database's last tile (or, in ASCII, anything but digits) means a damaged packet: black and missing,
as in the paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from sonarpost.codec.interface import DecodedImage, Mask, StreamHeader, check_image, model_tag, to_uint8
from sonarpost.codec.vq.tiles import TileDatabase, cut_tiles, join_tiles, tile_grid
from sonarpost.errors import ConfigError, StreamError

MAX_BODY_BYTES = 0xFFFF

_WireIndices = npt.NDArray[np.int64]


class IndexPacking(Enum):
    """How an index is written. Each packing has its own codec id, so a stream says how to read it.

    `BITS14` is the tight form. The others are the forms the paper moved through: 2 bytes (its Fig. 2), 3 bytes, and 5
    ASCII decimal digits.
    """

    BITS14 = "14bit"
    BYTES2 = "2byte"
    BYTES3 = "3byte"
    ASCII5 = "ascii5"

    @property
    def codec_id(self) -> int:
        """Codec id in the stream header: 0x10..0x13."""
        return _CODEC_IDS[self]

    @property
    def max_index(self) -> int:
        """Largest wire index that can be written."""
        return {"14bit": 0x3FFF, "2byte": 0xFFFF, "3byte": 0xFFFFFF, "ascii5": 99_999}[self.value]

    @property
    def bits(self) -> int:
        """Bits of one index."""
        return {"14bit": 14, "2byte": 16, "3byte": 24, "ascii5": 40}[self.value]

    def body_length(self, indices: int) -> int:
        """Return the bytes that `indices` indices take; unused bits at the end are zero."""
        return -(-indices * self.bits // 8)

    @classmethod
    def from_codec_id(cls, codec_id: int) -> IndexPacking | None:
        """Return the packing of a codec id, or None if it is not one of this codec's."""
        return next((packing for packing, number in _CODEC_IDS.items() if number == codec_id), None)


_CODEC_IDS = {
    IndexPacking.BITS14: 0x10,
    IndexPacking.BYTES2: 0x11,
    IndexPacking.BYTES3: 0x12,
    IndexPacking.ASCII5: 0x13,
}


def codebook_tag(tiles: TileDatabase) -> int:
    """Return the tag that streams made with a tile database carry, the same for every packing."""
    return model_tag(IndexPacking.BITS14.codec_id, tiles.identity)


@dataclass(frozen=True)
class VqCodec:
    """Vector quantisation with a shared tile database. Satisfies `sonarpost.codec.interface.Codec`.

    Attributes:
        tiles: The database; its identity is the codec's model hash.
        packing: How indices are written.

    Raises:
        ConfigError: The database has more tiles than the packing can number.
    """

    tiles: TileDatabase
    packing: IndexPacking = IndexPacking.BITS14

    def __post_init__(self) -> None:
        if len(self.tiles) > self.packing.max_index:
            raise ConfigError(
                "codec vq",
                "packing",
                f"{self.packing.value} for {len(self.tiles)} tiles",
                f"at most {self.packing.max_index} tiles, or a wider packing",
            )

    @property
    def name(self) -> str:
        """Name in the registry."""
        return "vq"

    @property
    def codec_id(self) -> int:
        """The packing's codec id."""
        return self.packing.codec_id

    @property
    def model_hash(self) -> str:
        """Identity of the tile database."""
        return self.tiles.identity

    def encode(self, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], budget_bytes: int | None = None) -> bytes:
        """Return header and packed indices.

        Args:
            image: Shape (16..512, 16..512), uint8 or uint16 (uint16 is mapped to 8 bits by `to_uint8`).
            budget_bytes: Most bytes of the whole stream. The size of this codec's stream follows from the picture's
                size alone, so a smaller budget cannot be met.

        Raises:
            StreamError: Size or dtype is not supported, or the budget (or 65,535 body bytes) is too small.
        """
        check_image(image)
        height_px, width_px = int(image.shape[0]), int(image.shape[1])
        length = self._body_length(height_px, width_px)
        header = StreamHeader(self.codec_id, self._tag, height_px, width_px)
        limit = MAX_BODY_BYTES if budget_bytes is None else min(budget_bytes - header.size, MAX_BODY_BYTES)
        if length > limit:
            needed = f"at least {length + header.size} B for {height_px} x {width_px} px"
            raise StreamError("codec vq", "budget_bytes", limit + header.size, needed)
        indices, _ = self.tiles.nearest(cut_tiles(to_uint8(image), self.tiles.tile_px))
        return header.pack() + pack_indices(indices + 1, self.packing)

    def decode(self, stream: bytes, received: Mask | None = None) -> DecodedImage:
        """Rebuild the picture from its tiles; what did not arrive is black and missing.

        Args:
            stream: Header and body. A short body counts as missing at its end; bytes beyond it are ignored and noted.
            received: Shape (body bytes in `stream`,), False where a body byte did not arrive.

        Raises:
            StreamError: The header is wrong, the stream is of another codec or packing, or it was made with a
                codebook of another identity.
        """
        header = self._check_header(stream)
        length = self._body_length(header.height_px, header.width_px)
        body, arrived, notes = _complete_body(stream[header.size :], length, received)
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
                (empty.sum(), "carry the reserved index 0 (zero padding)"),
                (damaged.sum(), "have an index outside the codebook (damaged packet)"),
            )
            if count
        ]
        chosen = self.tiles.tiles[np.where(missing, 0, wire - 1)]
        chosen[missing] = 0
        blank = np.repeat(missing[:, None].astype(np.uint8), self.tiles.tile_px**2, axis=1)
        size = (header.height_px, header.width_px, self.tiles.tile_px)
        return DecodedImage(join_tiles(chosen, *size), join_tiles(blank, *size).astype(np.bool_), tuple(notes))

    @property
    def _tag(self) -> int:
        return codebook_tag(self.tiles)

    def _body_length(self, height_px: int, width_px: int) -> int:
        rows, columns = tile_grid(height_px, width_px, self.tiles.tile_px)
        return self.packing.body_length(rows * columns)

    def _check_header(self, stream: bytes) -> StreamHeader:
        header = StreamHeader.unpack(stream)
        if header.codec_id != self.codec_id:
            expected = f"{self.codec_id:#04x} (vq, {self.packing.value} indices)"
            raise StreamError("stream", "codec_id", f"{header.codec_id:#04x}", expected)
        if header.model_tag != self._tag:
            expected = f"{self._tag:#06x}: the stream was made with a codebook of another identity"
            raise StreamError("stream", "model_tag", f"{header.model_tag:#06x}", expected)
        return header


def pack_indices(indices: _WireIndices, packing: IndexPacking) -> bytes:
    """Write wire indices, most significant bit or digit first.

    Args:
        indices: Shape (n,), int64, each 0..`packing.max_index`.
        packing: How to write them.
    """
    if packing is IndexPacking.ASCII5:
        digits = indices[:, None] // 10 ** np.arange(4, -1, -1) % 10
        return (digits + ord("0")).astype(np.uint8).tobytes()
    shifts = np.arange(packing.bits - 1, -1, -1)
    bits = (indices[:, None] >> shifts) & 1
    return np.packbits(bits.astype(np.uint8).ravel()).tobytes()


def unpack_indices(body: bytes, count: int, packing: IndexPacking) -> _WireIndices:
    """Read `count` wire indices, shape (count,), int64; -1 where ASCII holds something other than five digits.

    Five zero bytes, which padding leaves in place of ASCII digits, read as 0 like zero bits do in the other packings.
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


def _complete_body(body: bytes, length: int, received: Mask | None) -> tuple[bytes, Mask, list[str]]:
    """Cut or zero-fill the body to `length`; return it with a mask of what arrived, and notes."""
    if received is None:
        received = np.ones(len(body), dtype=np.bool_)
    elif received.shape != (len(body),) or received.dtype != np.bool_:
        met = f"{received.dtype} {received.shape}"
        raise StreamError("stream", "received", met, f"bool ({len(body)},), one for each body byte")
    arrived = np.zeros(length, dtype=np.bool_)
    arrived[: len(body)] = received[:length]
    notes = []
    if len(body) < length:
        notes.append(f"body ends after {len(body)} of {length} B")
    if len(body) > length:
        notes.append(f"{len(body) - length} B after the body ignored")
    return body[:length].ljust(length, b"\0"), arrived, notes


def _indices_arrived(arrived: Mask, count: int, bits: int) -> Mask:
    """Return, shape (count,), whether every byte that holds a bit of the index arrived."""
    lost_before = np.concatenate(([0], np.cumsum(~arrived)))
    first_bit = np.arange(count) * bits
    first, last = first_bit // 8, (first_bit + bits - 1) // 8
    return np.asarray(lost_before[last + 1] == lost_before[first], dtype=np.bool_)
