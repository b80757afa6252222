"""Frames of the acoustic wire format v1: five bytes of header, then a symbol of a block or a list of segments.

docs/specifications/acoustic-v1.md specifies every byte. Each frame can be decoded alone: it has its own checksum, the
modem's source address identifies the vehicle, and padding that drivers append is detected.
"""

from __future__ import annotations

import binascii
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final

from sonarpost.errors import FrameError

if TYPE_CHECKING:
    from sonarpost.link.auth.authentication import FrameAuthenticator

MIN_FRAME_BYTES: Final = 32
MAX_FRAME_BYTES: Final = 256
PADDED_LENGTHS: Final = (256, 192, 128, 96, 64, 48, 32)
"""Lengths to try, longest first, for a frame with padding. Part of the format."""
HEADER_BYTES: Final = 5
BLOCKS: Final = 32
MAX_INDEX: Final = 254

_CRC_BYTES: Final = 2
_TAG_BIT: Final = 0x80


class SymbolKind(IntEnum):
    """Content of a block. The number is in the header of its frames."""

    OBJECT = 0
    LAYERED = 1
    PREVIEW = 3


_SEGMENTS: Final = 2


class SegmentKind(IntEnum):
    """Content of a segment. Kinds from 16 on can be added: all but CONTACT have a length field."""

    END = 0
    MESSAGE = 1
    CONTACT = 2
    PREVIEW = 3
    SYMBOL = 4
    FEEDBACK = 5
    REQUEST = 6


CONTACT_SEGMENT_BYTES: Final = 29
MAX_SEGMENT_BYTES: Final = 255


@dataclass(frozen=True, slots=True)
class Symbol:
    """A symbol of a block.

    Attributes:
        kind: Content of the block.
        block: Number of the block, 0..31.
        index: Index of the symbol, 0..254.
        parameter: Number of source symbols k, 1..255; in a layered block a symbol of its descriptor, 0..255.
        data: The symbol.
    """

    kind: SymbolKind
    block: int
    index: int
    parameter: int
    data: bytes

    def head(self) -> bytes:
        """Return the three bytes before the data."""
        return bytes([self.kind << 5 | self.block, self.index, self.parameter])


@dataclass(frozen=True, slots=True)
class Segment:
    """One item of a frame with several.

    Attributes:
        kind: A `SegmentKind`, or another number below 32 of a later version.
        data: At most 255 bytes; exactly 29 for CONTACT.
    """

    kind: int
    data: bytes

    @property
    def size(self) -> int:
        """Length in a frame, in bytes."""
        return (1 if self.kind == SegmentKind.CONTACT else 2) + len(self.data)


Content = Symbol | tuple[Segment, ...]


def pack_symbol(symbol: Symbol, protection: FrameAuthenticator | None = None) -> bytes:
    """Return the frame of one symbol, 5 bytes longer than the symbol (and its tag)."""
    return _protected(symbol.head() + symbol.data, protection)


def segments_room(frame_bytes: int, protection: FrameAuthenticator | None = None) -> int:
    """Return how many bytes of segments (see `Segment.size`) a frame holds."""
    return frame_bytes - _CRC_BYTES - (0 if protection is None else protection.overhead_bytes)


def pack_segments(segments: Iterable[Segment], frame_bytes: int, protection: FrameAuthenticator | None = None) -> bytes:
    """Return a frame of segments, padded with zeros to `frame_bytes`.

    Raises:
        FrameError: There are no segments, one has an invalid kind or length, or they do not fit.
    """
    listed = tuple(segments)
    if not listed:
        raise FrameError("acoustic frame", "segments", 0, "at least one")
    body = bytearray()
    for segment in listed:
        length, is_contact = len(segment.data), segment.kind == SegmentKind.CONTACT
        if not 1 <= segment.kind < 32:
            raise FrameError("acoustic frame", "segment kind", segment.kind, "1..31")
        if length != CONTACT_SEGMENT_BYTES if is_contact else length > MAX_SEGMENT_BYTES:
            expected = f"{CONTACT_SEGMENT_BYTES} bytes of a contact, at most {MAX_SEGMENT_BYTES} of others"
            raise FrameError("acoustic frame", "segment", f"{length} bytes", expected)
        body += bytes([segment.kind] if is_contact else [segment.kind, length]) + segment.data
    room = segments_room(frame_bytes, protection)
    if len(body) > room:
        raise FrameError("acoustic frame", "segments", f"{len(body)} bytes", f"at most {room} bytes")
    body[0] |= _SEGMENTS << 5
    return _protected(bytes(body.ljust(room, b"\0")), protection)


def _protected(covered: bytes, protection: FrameAuthenticator | None) -> bytes:
    if protection is not None:
        covered = protection.protect(bytes([covered[0] | _TAG_BIT]) + covered[1:])
    return checksum(covered).to_bytes(_CRC_BYTES, "big") + covered


def checksum(covered: bytes) -> int:
    """Return CRC-16/IBM-3740, also called CCITT-FALSE.

    Polynomial 0x1021, initial value 0xFFFF, not reflected, no final exclusive-or; of b"123456789" it is 0x29B1.
    """
    return binascii.crc_hqx(covered, 0xFFFF)


def parse_frame(
    frame: bytes, source: int = 0, protection: FrameAuthenticator | None = None, where: str = "acoustic frame"
) -> Content:
    """Parse a frame from a modem.

    Args:
        frame: As received; zeros that a driver or modem appended are detected.
        source: Modem address of the sender, for `protection`.
        protection: With it, frames without a correct tag are rejected; without it, frames with a tag.
        where: Name of the frame in errors.

    Raises:
        FrameError: Wrong checksum, an invalid field, or a wrong or unexpected tag.
    """
    covered = _undamaged(frame, where)
    has_tag = bool(covered[0] & _TAG_BIT)
    if has_tag != (protection is not None):
        raise FrameError(where, "tag", has_tag, "none" if protection is None else "a tag in every frame")
    if protection is not None:
        covered = protection.verify(source, covered, where)
    if (covered[0] >> 5) & 3 == _SEGMENTS:
        return _parse_segments(bytes([covered[0] & 31]) + covered[1:], where)
    return parse_symbol(bytes([covered[0] & 0x7F]) + covered[1:], where)


def parse_symbol(data: bytes, where: str = "acoustic frame") -> Symbol:
    """Parse three bytes of head and a symbol.

    Raises:
        FrameError: Too short, or an invalid field.
    """
    if len(data) < 4 or data[0] >> 5 not in tuple(SymbolKind):
        raise FrameError(where, "symbol", data[:4], "three bytes of head with a known kind, and data")
    symbol = Symbol(SymbolKind(data[0] >> 5), data[0] & 31, data[1], data[2], data[3:])
    if symbol.index > MAX_INDEX:
        raise FrameError(where, "symbol index", symbol.index, f"0..{MAX_INDEX}")
    if symbol.kind != SymbolKind.LAYERED and symbol.parameter == 0:
        raise FrameError(where, "source symbols", 0, "1..255")
    return symbol


def _undamaged(frame: bytes, where: str) -> bytes:
    """Return the frame after its checksum, without padding."""
    length = len(frame)
    if length <= HEADER_BYTES:
        raise FrameError(where, "length", length, f"more than {HEADER_BYTES} bytes")
    sent = int.from_bytes(frame[:_CRC_BYTES], "big")
    used = len(frame.rstrip(b"\0"))
    for tried in (length, *(n for n in PADDED_LENGTHS if used <= n < length)):
        covered = frame[_CRC_BYTES:tried]
        if checksum(covered) == sent:
            return covered
    raise FrameError(where, "checksum", f"{sent:#06x}", f"{checksum(frame[_CRC_BYTES:]):#06x}")


def _parse_segments(body: bytes, where: str) -> tuple[Segment, ...]:
    segments: list[Segment] = []
    at = 0
    while at < len(body) and body[at] != SegmentKind.END:
        kind = body[at]
        at += 1
        if kind == SegmentKind.CONTACT:
            length = CONTACT_SEGMENT_BYTES
        else:
            length = body[at] if at < len(body) else 0
            at += 1
        if kind > 31 or at + length > len(body):
            raise FrameError(where, f"segment {len(segments)}", body[at - 1 : at + 1], "a kind below 32 and its bytes")
        segments.append(Segment(kind, body[at : at + length]))
        at += length
    if not segments:
        raise FrameError(where, "segments", body[:2], "at least one")
    return tuple(segments)
