"""Frames of the acoustic wire format v1: five bytes of header, then a symbol of a block or a list of segments.

docs/specifications/acoustic-v1.md specifies this byte by byte. A frame stands by itself: the checksum covers it alone,
the vehicle is known from the modem's source address, and padding that drivers add is recognised.
"""

from __future__ import annotations

import binascii
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Protocol

from sonarpost.errors import FrameError

MIN_FRAME_BYTES: Final = 32
MAX_FRAME_BYTES: Final = 256
PADDED_LENGTHS: Final = (256, 192, 128, 96, 64, 48, 32)
"""Lengths that are tried, longest first, where a frame came longer than it was sent. Part of the format."""
HEADER_BYTES: Final = 5
BLOCKS: Final = 32
MAX_INDEX: Final = 254

_CRC_BYTES: Final = 2
_TAG_BIT: Final = 0x80


class SymbolKind(IntEnum):
    """What a symbol is of. The number is in the frame's header."""

    OBJECT = 0
    LAYERED = 1
    PREVIEW = 3


_SEGMENTS: Final = 2


class SegmentKind(IntEnum):
    """What a segment is. From 16 on any kind may be added: all but CONTACT say how long they are."""

    END = 0
    MESSAGE = 1
    CONTACT = 2
    PREVIEW = 3
    SYMBOL = 4
    FEEDBACK = 5
    REQUEST = 6


CONTACT_SEGMENT_BYTES: Final = 29
MAX_SEGMENT_BYTES: Final = 255


class FrameProtection(Protocol):
    """Authenticates frames and may encrypt them; implemented by `sonarpost.link.auth.authentication`."""

    @property
    def size(self) -> int:
        """How many bytes it adds."""

    def seal(self, covered: bytes) -> bytes:
        """Return what is sent instead of `covered`, the frame after its checksum: `size` bytes longer.

        The first byte stays as it is. Nothing is consumed when it raises.
        """

    def open(self, source: int, sealed: bytes, where: str) -> bytes:
        """Return what was sealed; the hook may keep state (counters against replay).

        Raises:
            FrameError: It was not sealed by this source with the common key (field `tag`), or not now (`counter`).
        """


@dataclass(frozen=True, slots=True)
class Symbol:
    """A symbol of a block.

    Attributes:
        kind: What the block holds.
        block: Number of the block, 0..31.
        index: Which symbol, 0..254.
        parameter: k, 1..255, the number of source symbols; of a layered block a symbol of its descriptor, 0..255.
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
    """One item of a frame that carries several.

    Attributes:
        kind: A `SegmentKind`, or another number below 32 that a later version defines.
        data: At most 255 bytes; of a CONTACT exactly 29.
    """

    kind: int
    data: bytes

    @property
    def size(self) -> int:
        """Bytes it takes in a frame."""
        return (1 if self.kind == SegmentKind.CONTACT else 2) + len(self.data)


Content = Symbol | tuple[Segment, ...]


def pack_symbol(symbol: Symbol, seal: FrameProtection | None = None) -> bytes:
    """Return the frame of one symbol, 5 bytes longer than the symbol (and its tag)."""
    return _sealed(symbol.head() + symbol.data, seal)


def segments_room(frame_bytes: int, seal: FrameProtection | None = None) -> int:
    """Return how many bytes of segments (by `Segment.size`) fit a frame."""
    return frame_bytes - _CRC_BYTES - (0 if seal is None else seal.size)


def pack_segments(segments: Iterable[Segment], frame_bytes: int, seal: FrameProtection | None = None) -> bytes:
    """Return a frame of segments, padded with zeros to `frame_bytes`.

    Raises:
        FrameError: There is none, one has another length than its kind allows, or they do not fit.
    """
    listed = tuple(segments)
    if not listed:
        raise FrameError("acoustic frame", "segments", 0, "at least one")
    body = bytearray()
    for segment in listed:
        _check_segment(segment)
        body.append(segment.kind)
        if segment.kind != SegmentKind.CONTACT:
            body.append(len(segment.data))
        body += segment.data
    room = segments_room(frame_bytes, seal)
    if len(body) > room:
        raise FrameError("acoustic frame", "segments", f"{len(body)} bytes", f"at most {room} bytes")
    body[0] |= _SEGMENTS << 5
    return _sealed(bytes(body.ljust(room, b"\0")), seal)


def _check_segment(segment: Segment) -> None:
    if not 1 <= segment.kind < 32:
        raise FrameError("acoustic frame", "segment kind", segment.kind, "1..31")
    fits = len(segment.data) <= MAX_SEGMENT_BYTES
    if segment.kind == SegmentKind.CONTACT:
        fits = len(segment.data) == CONTACT_SEGMENT_BYTES
    if not fits:
        expected = f"{CONTACT_SEGMENT_BYTES} bytes of a contact, at most {MAX_SEGMENT_BYTES} of others"
        raise FrameError("acoustic frame", "segment", f"{len(segment.data)} bytes", expected)


def _sealed(covered: bytes, seal: FrameProtection | None) -> bytes:
    if seal is not None:
        covered = seal.seal(bytes([covered[0] | _TAG_BIT]) + covered[1:])
    return checksum(covered).to_bytes(_CRC_BYTES, "big") + covered


def checksum(covered: bytes) -> int:
    """Return CRC-16/IBM-3740 (polynomial 0x1021, initial value 0xFFFF, not reflected)."""
    return binascii.crc_hqx(covered, 0xFFFF)


def parse_frame(
    frame: bytes, source: int = 0, seal: FrameProtection | None = None, where: str = "acoustic frame"
) -> Content:
    """Parse a frame as it came from a modem.

    Args:
        frame: As received; zeros that a driver or modem appended are recognised.
        source: Modem address it came from, for `seal`.
        seal: When given, frames without a right tag are refused; without it, frames with a tag are.
        where: Names the frame in errors.

    Raises:
        FrameError: Wrong checksum, a field without meaning, or a wrong or unexpected tag.
    """
    covered = _undamaged(frame, where)
    has_tag = bool(covered[0] & _TAG_BIT)
    if has_tag != (seal is not None):
        raise FrameError(where, "tag", has_tag, "none" if seal is None else "a tag in every frame")
    if seal is not None:
        covered = seal.open(source, covered, where)
    if (covered[0] >> 5) & 3 == _SEGMENTS:
        return _parse_segments(bytes([covered[0] & 31]) + covered[1:], where)
    return parse_symbol(bytes([covered[0] & 0x7F]) + covered[1:], where)


def parse_symbol(data: bytes, where: str = "acoustic frame") -> Symbol:
    """Parse three bytes of head and a symbol.

    Raises:
        FrameError: Too short, or a field without meaning.
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
