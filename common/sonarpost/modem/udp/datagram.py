"""Format of the datagrams: one packet, or the acknowledgement of one.

All numbers are big-endian. A datagram is at most 4096 bytes.

| bytes | field |
|---|---|
| 4 | `SPM1` |
| 2 | length of the datagram |
| 1 | kind: 1 data, 2 data that requests an acknowledgement, 3 acknowledgement |
| 1 | source address |
| 1 | destination address, 255 for all |
| 1 | rate number |
| 2 | number of the packet at its source; an acknowledgement repeats it |
| 1 | number of frames, 0..255 |
| | each frame: its length in two bytes, then its bytes; 65535 for a frame that was lost |
| 4 | CRC-32 of all bytes before (`zlib.crc32`) |

An acknowledgement has an empty frame for each received one, and the length 65535 for each lost one.
The length in the datagram makes the format self-delimiting, so a byte stream can carry it, as in the simulated channel.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from typing_extensions import override

from sonarpost.errors import SentenceError
from sonarpost.modem.packet_queue import Assembler

MAGIC: Final = b"SPM1"
MAX_DATAGRAM_BYTES: Final = 4096
LOST: Final = 0xFFFF
_HEADER: Final = struct.Struct(">4sHBBBBHB")
_CRC_BYTES: Final = 4
_WHERE: Final = "modem datagram"


class DatagramKind(IntEnum):
    """What a datagram carries."""

    DATA = 1
    DATA_WITH_ACK = 2
    ACK = 3


@dataclass(frozen=True, slots=True)
class Datagram:
    """One datagram.

    Attributes:
        number: Number of the packet, 0..65535.
        frames: The frames in order; None for one that was lost.
    """

    kind: DatagramKind
    source: int
    destination: int
    rate: int
    number: int
    frames: tuple[bytes | None, ...]

    def pack(self) -> bytes:
        """Return the bytes of the datagram."""
        body = b"".join(struct.pack(">H", LOST if f is None else len(f)) + (f or b"") for f in self.frames)
        length = _HEADER.size + len(body) + _CRC_BYTES
        header = _HEADER.pack(
            MAGIC, length, self.kind, self.source, self.destination, self.rate, self.number, len(self.frames)
        )
        return header + body + zlib.crc32(header + body).to_bytes(_CRC_BYTES, "big")


def parse(data: bytes) -> Datagram:
    """Parse one datagram.

    Raises:
        SentenceError: Not exactly one valid datagram.
    """
    if len(data) < _HEADER.size + _CRC_BYTES:
        raise SentenceError(_WHERE, "length", len(data), f"at least {_HEADER.size + _CRC_BYTES}")
    magic, length, kind, source, destination, rate, number, count = _HEADER.unpack_from(data)
    if magic != MAGIC or not length == len(data) <= MAX_DATAGRAM_BYTES:
        raise SentenceError(_WHERE, "header", data[:6], f"{MAGIC!r} and the length {len(data)}")
    if zlib.crc32(data[:-_CRC_BYTES]).to_bytes(_CRC_BYTES, "big") != data[-_CRC_BYTES:]:
        raise SentenceError(_WHERE, "CRC", data[-_CRC_BYTES:], "that of the bytes before")
    if kind not in set(DatagramKind):
        raise SentenceError(_WHERE, "kind", kind, "1..3")
    frames: list[bytes | None] = []
    place, end = _HEADER.size, len(data) - _CRC_BYTES
    for _ in range(count):
        size = int.from_bytes(data[place : place + 2], "big")
        place += 2
        frames.append(None if size == LOST else data[place : place + size])
        place += 0 if size == LOST else size
    if place != end:
        raise SentenceError(_WHERE, "frames", f"{place} bytes", f"{end} bytes")
    return Datagram(DatagramKind(kind), source, destination, rate, number, tuple(frames))


class DatagramAssembler(Assembler[Datagram]):
    """Divides the bytes of a stream into datagrams."""

    @override
    def _messages(self) -> list[Datagram | SentenceError]:
        found: list[Datagram | SentenceError] = []
        while (item := self._next()) is not None:
            found.append(item)
        return found

    def _next(self) -> Datagram | SentenceError | None:
        start = self._buffer.find(MAGIC)
        if start != 0:
            # The end of the bytes may be the beginning of the next datagram.
            junk = bytes(self._buffer[: start if start > 0 else max(0, len(self._buffer) - len(MAGIC) + 1)])
            del self._buffer[: len(junk)]
            return SentenceError(_WHERE, "header", junk[:20], repr(MAGIC)) if junk else None
        length = int.from_bytes(self._buffer[len(MAGIC) : len(MAGIC) + 2], "big")
        is_short = len(self._buffer) < len(MAGIC) + 2
        if is_short or len(self._buffer) < length <= MAX_DATAGRAM_BYTES:
            return None
        try:
            datagram = parse(bytes(self._buffer[:length]))
        except SentenceError as error:
            del self._buffer[: len(MAGIC)]
            return error
        del self._buffer[:length]
        return datagram
