"""Previews of the v1 format: a contact's record and the beginning of its picture.

Every entry carries its own check, so that no mixture of blocks and no damaged frame is taken for a contact.
docs/specifications/acoustic-v1.md specifies the bytes.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Final

from sonarpost.errors import FrameError
from sonarpost.link.frames.contact_record import RECORD_SIZE, ContactSummary

ENTRY_HEAD_BYTES: Final = 2 + RECORD_SIZE + 2
"""Number, record and check of a preview entry; also the whole of a CONTACT segment."""
MAX_NUMBER: Final = 0xFFFF
_LEAST_ENTRY_BYTES: Final = 44  # a record and 15 bytes of stream
_ENTRY_BYTES: Final = 56  # a record and 27 bytes of stream: the coarsest picture worth showing

_WHOLE, _ENDED = b"\x00", b"\x01"
_END_MARK: Final = b"\x80"


@dataclass(frozen=True, slots=True)
class EntryShape:
    """How preview entries lie in symbols: several to a symbol, or one over several.

    Attributes:
        entries: Entries in a symbol (1 where an entry takes several).
        symbols: Symbols of an entry (1 where a symbol has several).
        entry_bytes: Length of an entry.
    """

    entries: int
    symbols: int
    entry_bytes: int

    @property
    def prefix_bytes(self) -> int:
        """Bytes of the picture's stream in an entry."""
        return self.entry_bytes - ENTRY_HEAD_BYTES

    def source_symbols(self, contacts: int) -> int:
        """Return k of a preview block of so many contacts."""
        return -(-contacts * self.symbols // self.entries)


def entry_shape(symbol_bytes: int) -> EntryShape:
    """Return how entries lie in symbols of a length; a rule of the format.

    Raises:
        FrameError: Shorter than half an entry.
    """
    if 2 * symbol_bytes < _LEAST_ENTRY_BYTES:
        raise FrameError("preview block", "symbol", f"{symbol_bytes} bytes", f"at least {_LEAST_ENTRY_BYTES // 2}")
    if symbol_bytes < _LEAST_ENTRY_BYTES:
        return EntryShape(1, 2, 2 * symbol_bytes)
    entries = max(1, symbol_bytes // _ENTRY_BYTES)
    return EntryShape(entries, 1, symbol_bytes // entries)


@dataclass(frozen=True, slots=True)
class Preview:
    """A contact and the beginning of its picture.

    Attributes:
        number: Of the contact, 1..65535; the vehicle counts, after 65535 comes 1.
        contact: The record.
        prefix: The first bytes of the picture's stream, none or more.
        ended: Whether the stream is no longer than `prefix`.
    """

    number: int
    contact: ContactSummary
    prefix: bytes
    ended: bool = False

    @property
    def link(self) -> int:
        """Byte by which pieces of the picture name the contact beside its number."""
        return contact_link(self.number, self.contact.pack())

    def pack(self, entry_bytes: int) -> bytes:
        """Return the entry, `entry_bytes` long.

        Raises:
            FrameError: The prefix leaves no room, or does not fill it though the stream goes on.
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
            FrameError: A wrong check, or a record that does not parse.
        """
        head, check, prefix = (
            entry[: 2 + RECORD_SIZE],
            entry[2 + RECORD_SIZE : ENTRY_HEAD_BYTES],
            entry[ENTRY_HEAD_BYTES:],
        )
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


def contact_link(number: int, record: bytes) -> int:
    """Return the byte that ties pieces to a contact: a vehicle that starts its numbers anew must not mix pictures."""
    return zlib.crc32(number.to_bytes(2, "big") + record) & 0xFF


def _entry_check(variant: bytes, head: bytes, prefix: bytes) -> bytes:
    return (zlib.crc32(variant + head + prefix) & 0xFFFF).to_bytes(2, "big")


def number_after(number: int, steps: int) -> int:
    """Return the number of the contact `steps` later; 1 follows 65535."""
    return (number - 1 + steps) % MAX_NUMBER + 1


def next_number(number: int) -> int:
    """Return the number of the contact after this one."""
    return number_after(number, 1)
