"""Payloads of the v1 format: previews of contacts, objects of blocks (pieces of images, long messages), and feedback.

Previews and objects have their own checks, so that no mixture of blocks and no damaged frame can pass as one of them.
docs/specifications/acoustic-v1.md specifies the bytes.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

from sonarpost.errors import FrameError
from sonarpost.link.frames.contact_record import RECORD_SIZE, ContactSummary
from sonarpost.link.frames.v1.frame import BLOCKS
from sonarpost.link.state import Bounds, Byte

MAX_NUMBER: Final = 0xFFFF
MAX_STREAM_BYTES: Final = 0xFFFF
MAX_PIECES: Final = 255
CHECK_BYTES: Final = 4
MESSAGE_OVERHEAD_BYTES: Final = 4 + CHECK_BYTES
ENTRY_HEAD_BYTES: Final = 2 + RECORD_SIZE + 2
"""Number, record and check of a preview entry; also the whole of a CONTACT segment."""
WINDOW: Final = BLOCKS // 2
"""Number of successive blocks that can be in transmission."""
NEVER_RECEIVED: Final = 255

ImageNumber = Annotated[int, Bounds(1, MAX_NUMBER)]
StreamPosition = Annotated[int, Bounds(0, MAX_STREAM_BYTES)]
PieceEnd = tuple[ImageNumber, Byte, StreamPosition]
"""Number and link of an image, and the position after a piece of its stream."""

_MIN_ENTRY_BYTES: Final = 44  # a record and 15 bytes of stream
_ENTRY_BYTES: Final = 56  # a record and 27 bytes of stream: the coarsest useful image
_WHOLE, _ENDED = b"\x00", b"\x01"
_END_MARK: Final = b"\x80"
_PIECES, _MESSAGE = 0x10, 0x20
_FINAL, _FOLLOWS, _COMMON_START, _CONSECUTIVE = 1, 2, 4, 8


def number_after(number: int, steps: int = 1) -> int:
    """Return the contact number `steps` later; 1 follows 65535."""
    return (number - 1 + steps) % MAX_NUMBER + 1


def contact_link(number: int, record: bytes) -> int:
    """Return the byte that ties pieces to a contact, so that images of reused numbers do not mix."""
    return zlib.crc32(number.to_bytes(2, "big") + record) & 0xFF


@dataclass(frozen=True, slots=True)
class EntryShape:
    """Layout of preview entries in symbols: several in one symbol, or one over several symbols.

    Attributes:
        entries: Entries in a symbol (1 if an entry needs several symbols).
        symbols: Symbols of an entry (1 if a symbol holds several entries).
        entry_bytes: Length of an entry.
    """

    entries: int
    symbols: int
    entry_bytes: int

    @property
    def prefix_bytes(self) -> int:
        """Bytes of the image's stream in an entry."""
        return self.entry_bytes - ENTRY_HEAD_BYTES

    def source_symbols(self, contacts: int) -> int:
        """Return the number of source symbols of a preview block of `contacts` contacts."""
        return -(-contacts * self.symbols // self.entries)


def entry_shape(symbol_bytes: int) -> EntryShape:
    """Return the layout for a symbol length; a rule of the format.

    Raises:
        FrameError: Shorter than half an entry.
    """
    if 2 * symbol_bytes < _MIN_ENTRY_BYTES:
        raise FrameError("preview block", "symbol", f"{symbol_bytes} bytes", f"at least {_MIN_ENTRY_BYTES // 2}")
    if symbol_bytes < _MIN_ENTRY_BYTES:
        return EntryShape(1, 2, 2 * symbol_bytes)
    entries = max(1, symbol_bytes // _ENTRY_BYTES)
    return EntryShape(entries, 1, symbol_bytes // entries)


@dataclass(frozen=True, slots=True)
class Preview:
    """A contact record and the beginning of its image.

    Attributes:
        number: Number of the contact, 1..65535, consecutive on a vehicle.
        contact: The record.
        prefix: The first bytes of the image's stream.
        ended: Whether the stream is not longer than `prefix`.
    """

    number: int
    contact: ContactSummary
    prefix: bytes
    ended: bool = False

    @property
    def link(self) -> int:
        """See `contact_link`."""
        return contact_link(self.number, self.contact.pack())

    def pack(self, entry_bytes: int) -> bytes:
        """Return the entry, `entry_bytes` long.

        Raises:
            FrameError: The prefix is too long, or too short although the stream continues.
        """
        room = entry_bytes - ENTRY_HEAD_BYTES
        filled = (self.prefix + _END_MARK).ljust(room, b"\0") if self.ended and len(self.prefix) < room else self.prefix
        if len(filled) != room or not 1 <= self.number <= MAX_NUMBER:
            expected = f"number 1..{MAX_NUMBER}, {room} bytes of stream or all of it"
            raise FrameError("preview", "entry", (self.number, len(self.prefix)), expected)
        head = self.number.to_bytes(2, "big") + self.contact.pack()
        variant = _ENDED if len(self.prefix) < room else _WHOLE
        return head + _entry_check(variant, head, filled) + filled

    @classmethod
    def unpack(cls, entry: bytes, where: str = "preview") -> Preview:
        """Parse an entry.

        Raises:
            FrameError: A wrong check, or an invalid record.
        """
        record_end = 2 + RECORD_SIZE
        head, check, prefix = entry[:record_end], entry[record_end:ENTRY_HEAD_BYTES], entry[ENTRY_HEAD_BYTES:]
        number = int.from_bytes(head[:2], "big")
        if len(entry) < ENTRY_HEAD_BYTES or number == 0:
            raise FrameError(where, "entry", entry[:4], f"a number and at least {ENTRY_HEAD_BYTES} bytes")
        ended = check == _entry_check(_ENDED, head, prefix)
        if not ended and check != _entry_check(_WHOLE, head, prefix):
            raise FrameError(where, "check", check, _entry_check(_WHOLE, head, prefix).hex())
        if ended:
            prefix = prefix.rstrip(b"\0")
            if not prefix.endswith(_END_MARK):
                raise FrameError(where, "prefix", prefix[-1:], "0x80 after the end of the stream")
            prefix = prefix[:-1]
        return cls(number, ContactSummary.unpack(head[2:], where), prefix, ended)


def _entry_check(variant: bytes, head: bytes, prefix: bytes) -> bytes:
    return (zlib.crc32(variant + head + prefix) & 0xFFFF).to_bytes(2, "big")


@dataclass(frozen=True, slots=True)
class StreamPiece:
    """A part of the stream of an image.

    Attributes:
        number: Number of the contact.
        link: See `contact_link`.
        start: Position of the first byte in the stream.
        data: The bytes; can be empty.
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
    """Pieces of one or several images.

    Attributes:
        pieces: At most 255.
        final: Whether each piece reaches the end of its stream as planned then.
    """

    pieces: tuple[StreamPiece, ...]
    final: bool

    @property
    def ends(self) -> tuple[PieceEnd, ...]:
        """Where the pieces end: what the layer above continues."""
        return tuple((p.number, p.link, p.stop) for p in self.pieces)

    def pack(self, length: int, below: Sequence[PieceEnd] | None = None) -> bytes:
        """Return an object.

        Args:
            length: Length of the object with its check; the rest is zeros.
            below: Ends of the pieces in the layer below in the same block, which these continue.

        Raises:
            FrameError: They do not fit, or do not continue `below`.
        """
        body = self._head(below)
        for piece in self.pieces:
            body += _varint(len(piece.data))
        body += b"".join(piece.data for piece in self.pieces)
        return _with_check(bytes(body), length)

    def _head(self, below: Sequence[PieceEnd] | None) -> bytearray:
        flags = _FINAL if self.final else 0
        if below is not None:
            starts = [(p.number, p.link, p.start) for p in self.pieces]
            if starts != list(below):
                raise FrameError("pieces", "layer", starts, "pieces that continue the layer below")
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
        """Return the bytes of an object that are not image data, for pieces of these lengths."""
        return len(self._head(below)) + sum(len(_varint(len(p.data))) for p in self.pieces) + CHECK_BYTES


@dataclass(frozen=True, slots=True)
class MessageObject:
    """A message as an object.

    Attributes:
        number: 0..255, the same in repetitions.
        data: At most 65535 bytes.
    """

    number: int
    data: bytes

    def pack(self, length: int) -> bytes:
        """Return an object of a length.

        Raises:
            FrameError: It does not fit.
        """
        return _with_check(bytes([_MESSAGE, self.number]) + len(self.data).to_bytes(2, "big") + self.data, length)


def unpack_object(
    data: bytes, below: Sequence[PieceEnd] | None = None, where: str = "object"
) -> PieceList | MessageObject:
    """Parse an object.

    Args:
        data: The whole object.
        below: Ends of the pieces in the layer below, None for the lowest layer.
        where: Name of the object in errors.

    Raises:
        FrameError: Wrong check, or invalid fields.
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
            raise FrameError(reader.where, "flags", flags, "a layer below, and no other flag for the start")
        starts = list(below)
    else:
        starts = _read_starts(reader, flags)
    lengths = [reader.varint() for _ in starts]
    pieces = []
    for (number, link, start), length in zip(starts, lengths, strict=True):
        if start + length > MAX_STREAM_BYTES:
            raise FrameError(reader.where, "piece", (start, length), f"an end at {MAX_STREAM_BYTES} or before")
        pieces.append(StreamPiece(number, link, start, reader.take(length)))
    return PieceList(tuple(pieces), bool(flags & _FINAL))


def _read_starts(reader: _Reader, flags: int) -> list[PieceEnd]:
    count, number = reader.byte(), reader.number()
    start = reader.varint() if flags & _COMMON_START else 0
    starts = []
    for place in range(count):
        if place:
            number = number_after(number) if flags & _CONSECUTIVE else reader.number()
        link = reader.byte()
        starts.append((number, link, start if flags & _COMMON_START else reader.varint()))
    if not starts or any(n == 0 for n, _, _ in starts):
        raise FrameError(reader.where, "contacts", [n for n, _, _ in starts], f"at least one, each 1..{MAX_NUMBER}")
    return starts


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


def _with_check(body: bytes, length: int) -> bytes:
    room = length - CHECK_BYTES
    if len(body) > room:
        raise FrameError("object", "length", f"{len(body)} bytes", f"at most {room}")
    body = body.ljust(room, b"\0")
    return body + zlib.crc32(body).to_bytes(CHECK_BYTES, "big")


@dataclass(frozen=True, slots=True)
class Feedback:
    """Feedback of a receiver: the symbols that are missing.

    Attributes:
        newest: Number of the newest block received, 0..31.
        frames: Frames received from this sender since the first start, modulo 65536, to measure the loss; None in a
            mini-packet.
        missing: Missing symbols of the block `newest`, the one before it, and so on, at most 16: 0 complete, 1..254
            (254: or more), 255 no symbol has arrived.
    """

    newest: int
    frames: int | None
    missing: tuple[int, ...]

    def pack(self) -> bytes:
        """Return the data of a FEEDBACK segment, 3 to 19 bytes."""
        return bytes([self.newest]) + (self.frames or 0).to_bytes(2, "big") + bytes(self.missing)

    @classmethod
    def unpack(cls, data: bytes, where: str = "feedback") -> Feedback:
        """Parse the data of a FEEDBACK segment.

        Raises:
            FrameError: Too short or too long, or an invalid block number.
        """
        if not 3 <= len(data) <= 3 + WINDOW or data[0] >= BLOCKS:
            raise FrameError(where, "data", data, f"a block below {BLOCKS}, a count, and at most {WINDOW} numbers")
        return cls(data[0], int.from_bytes(data[1:3], "big"), tuple(data[3:]))

    def missing_of(self, block: int) -> int | None:
        """Return the missing symbols of a block, None if the feedback does not include it."""
        back = (self.newest - block) % BLOCKS
        return self.missing[back] if back < len(self.missing) else None


@dataclass(frozen=True, slots=True)
class RefineRequest:
    """A request for more detail of an image than was planned.

    Attributes:
        number: Number of the contact, 1..65535.
        stream_bytes: Length of the beginning of the stream to send.
    """

    number: int
    stream_bytes: int

    def pack(self) -> bytes:
        """Return the data of a REQUEST segment, 4 bytes."""
        return self.number.to_bytes(2, "big") + self.stream_bytes.to_bytes(2, "big")

    @classmethod
    def unpack(cls, data: bytes, where: str = "request") -> RefineRequest:
        """Parse the data of a REQUEST segment.

        Raises:
            FrameError: Not 4 bytes, or contact 0.
        """
        request = cls(int.from_bytes(data[:2], "big"), int.from_bytes(data[2:], "big"))
        if len(data) != 4 or request.number == 0:
            raise FrameError(where, "data", data, "a contact 1..65535 and a length, 2 bytes each")
        return request


def unpack_mini(bits: int) -> Feedback:
    """Return the feedback of a mini-packet of 13 bits: the missing symbols of one block, without a count of frames.

    Raises:
        FrameError: More than 13 bits.
    """
    if not 0 <= bits < 1 << 13:
        raise FrameError("mini-packet", "bits", bits, "0..0x1FFF")
    return Feedback(bits >> 8, None, (bits & 255,))
