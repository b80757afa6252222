"""Objects of the v1 format: pieces of pictures and long messages.

Every object carries its own check, so that no mixture of blocks and no damaged frame is taken for what was sent.
docs/specifications/acoustic-v1.md specifies the bytes.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

from sonarpost.errors import FrameError
from sonarpost.link.frames.v1.preview import MAX_NUMBER, number_after
from sonarpost.link.state import Bounds, Byte

CHECK_BYTES: Final = 4
MAX_STREAM_BYTES: Final = 0xFFFF
MAX_PIECES: Final = 255
_PIECES, _MESSAGE = 0x10, 0x20
_FINAL, _FOLLOWS, _COMMON_START, _CONSECUTIVE = 1, 2, 4, 8

PieceEnd = tuple[Annotated[int, Bounds(1, MAX_NUMBER)], Byte, Annotated[int, Bounds(0, MAX_STREAM_BYTES)]]
"""Number and link of an image, and the position after a piece of its stream."""


@dataclass(frozen=True, slots=True)
class StreamPiece:
    """Bytes of one picture's stream.

    Attributes:
        number: Of the contact.
        link: See `contact_link`.
        start: Position of the first byte in the stream.
        data: The bytes; may be none.
    """

    number: int
    link: int
    start: int
    data: bytes

    @property
    def stop(self) -> int:
        """Position after the last byte."""
        return self.start + len(self.data)


@dataclass(frozen=True, slots=True)
class PieceList:
    """Pieces of one or more pictures.

    Attributes:
        pieces: At most 255.
        final: Whether each ends where its stream, as it was planned then, ends.
    """

    pieces: tuple[StreamPiece, ...]
    final: bool

    @property
    def ends(self) -> tuple[PieceEnd, ...]:
        """Where the pieces end: what the layer above continues."""
        return tuple((p.number, p.link, p.stop) for p in self.pieces)

    def pack(self, length: int, below: Sequence[PieceEnd] | None = None) -> bytes:
        """Return an object of a length.

        Args:
            length: Of the object, check included; the rest is zeros.
            below: Ends of the pieces in the layer below in the same block, which these continue.

        Raises:
            FrameError: They do not fit, or do not continue `below`.
        """
        body = self._head(below)
        for piece in self.pieces:
            body += _varint(len(piece.data))
        body += b"".join(piece.data for piece in self.pieces)
        return _checked(bytes(body), length)

    def _head(self, below: Sequence[PieceEnd] | None) -> bytearray:
        flags = _FINAL if self.final else 0
        if below is not None:
            same = [(p.number, p.link, p.start) for p in self.pieces]
            if same != list(below):
                raise FrameError("pieces", "layer", same, "pieces that go on where the layer below ends")
            return bytearray([_PIECES | flags | _FOLLOWS])
        if not 1 <= len(self.pieces) <= MAX_PIECES:
            raise FrameError("pieces", "count", len(self.pieces), f"1..{MAX_PIECES}")
        first = self.pieces[0]
        common = all(p.start == first.start for p in self.pieces)
        consecutive = all(p.number == number_after(first.number, i) for i, p in enumerate(self.pieces))
        flags |= (_COMMON_START if common else 0) | (_CONSECUTIVE if consecutive else 0)
        head = bytearray([_PIECES | flags, len(self.pieces)]) + first.number.to_bytes(2, "big")
        if common:
            head += _varint(first.start)
        for place, piece in enumerate(self.pieces):
            if not consecutive and place:
                head += piece.number.to_bytes(2, "big")
            head.append(piece.link)
            if not common:
                head += _varint(piece.start)
        return head

    def overhead_bytes(self, below: Sequence[PieceEnd] | None = None) -> int:
        """Return how many bytes of an object are not picture, for pieces of these lengths."""
        return len(self._head(below)) + sum(len(_varint(len(p.data))) for p in self.pieces) + CHECK_BYTES


@dataclass(frozen=True, slots=True)
class MessageObject:
    """Bytes for the other end, whatever they mean there.

    Attributes:
        number: 0..255, by which repetitions are known.
        data: At most 65535 bytes.
    """

    number: int
    data: bytes

    def pack(self, length: int) -> bytes:
        """Return an object of a length.

        Raises:
            FrameError: It does not fit.
        """
        return _checked(bytes([_MESSAGE, self.number]) + len(self.data).to_bytes(2, "big") + self.data, length)


MESSAGE_OVERHEAD_BYTES: Final = 4 + CHECK_BYTES


def unpack_object(
    data: bytes, below: Sequence[PieceEnd] | None = None, where: str = "object"
) -> PieceList | MessageObject:
    """Parse an object.

    Args:
        data: The whole object.
        below: Ends of the pieces in the layer below, None for the lowest layer.
        where: Names it in errors.

    Raises:
        FrameError: Wrong check, or fields without meaning.
    """
    body, check = data[:-CHECK_BYTES], data[-CHECK_BYTES:]
    if len(data) <= CHECK_BYTES or zlib.crc32(body).to_bytes(CHECK_BYTES, "big") != check:
        raise FrameError(where, "check", check, "CRC-32 of the bytes before it")
    reader = _Reader(body, where)
    kind = reader.byte()
    if kind & 0xF0 == _PIECES:
        return _read_pieces(reader, kind & 0x0F, below)
    if kind == _MESSAGE:
        return MessageObject(reader.byte(), reader.take(reader.number()))
    raise FrameError(where, "kind", kind, "0x10..0x1F or 0x20")


def _read_pieces(reader: _Reader, flags: int, below: Sequence[PieceEnd] | None) -> PieceList:
    if flags & _FOLLOWS:
        if below is None or flags & (_COMMON_START | _CONSECUTIVE):
            raise FrameError(reader.where, "flags", flags, "a layer below, and no other way to say what goes on")
        begun = list(below)
    else:
        begun = _read_begun(reader, flags)
    lengths = [reader.varint() for _ in begun]
    pieces = []
    for (number, link, start), length in zip(begun, lengths, strict=True):
        if start + length > MAX_STREAM_BYTES:
            raise FrameError(reader.where, "piece", (start, length), f"an end at {MAX_STREAM_BYTES} or before")
        pieces.append(StreamPiece(number, link, start, reader.take(length)))
    return PieceList(tuple(pieces), bool(flags & _FINAL))


def _read_begun(reader: _Reader, flags: int) -> list[tuple[int, int, int]]:
    count, number = reader.byte(), reader.number()
    start = reader.varint() if flags & _COMMON_START else 0
    begun = []
    for place in range(count):
        if place:
            number = number_after(number, 1) if flags & _CONSECUTIVE else reader.number()
        link = reader.byte()
        begun.append((number, link, start if flags & _COMMON_START else reader.varint()))
    if not begun or any(n == 0 for n, _, _ in begun):
        raise FrameError(reader.where, "contacts", [n for n, _, _ in begun], f"at least one, each 1..{MAX_NUMBER}")
    return begun


@dataclass
class _Reader:
    data: bytes
    where: str
    at: int = 0

    def take(self, length: int) -> bytes:
        found = self.data[self.at : self.at + length]
        if len(found) < length:
            raise FrameError(self.where, "length", f"{len(found)} bytes", f"{length} at byte {self.at}")
        self.at += length
        return found

    def byte(self) -> int:
        return self.take(1)[0]

    def number(self) -> int:
        return int.from_bytes(self.take(2), "big")

    def varint(self) -> int:
        value = 0
        for shift in (0, 7, 14):
            byte = self.byte()
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise FrameError(self.where, "number", value, "at most three bytes")


def _varint(value: int) -> bytes:
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _checked(body: bytes, length: int) -> bytes:
    room = length - CHECK_BYTES
    if len(body) > room:
        raise FrameError("object", "length", f"{len(body)} bytes", f"at most {room}")
    body = body.ljust(room, b"\0")
    return body + zlib.crc32(body).to_bytes(CHECK_BYTES, "big")
