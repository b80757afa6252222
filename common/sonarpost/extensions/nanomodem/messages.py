"""Messages between the host and a nanomodem v3. Numbers are decimal digits; `xxx` is an address, `nn` a length.

| command | confirmation | later |
|---|---|---|
| `$?` status | `#AxxxVyyyyy` and, with newer firmware, more text | |
| `$Axxx` set the address | `#Axxx` | |
| `$Bnn` and data: broadcast | `$Bnn` | |
| `$Mxxxnn` and data: unicast with acknowledgement | `$Mxxxnn` | `#RxxxTyyyyy` or `#TO` |
| `$Pxxx` ping | `$Pxxx` | `#RxxxTyyyyy` or `#TO` |

Received data come as `#Bxxxnn` and data (broadcast, `xxx` is the source) or `#Unn` and data (unicast). `E` refuses a
command. Each message of the modem ends with CR LF, a command has no end. `yyyyy` of `#R` is the one-way travel time in
steps of 31.25 µs. The modem has no checksum on this line, so a message is valid only with its exact length and end.
"""

import re
from dataclasses import dataclass
from typing import Final

from typing_extensions import override

from sonarpost.errors import SentenceError
from sonarpost.extensions.nanomodem.rates import MAX_PAYLOAD_BYTES
from sonarpost.modem.packet_queue import Assembler

TRAVEL_STEP_S: Final = 31.25e-6
"""Unit of the travel time."""
MAX_STATUS_BYTES: Final = 64
"""Longest text after the address in a status."""
MAX_SUFFIX_BYTES: Final = 26
"""Longest link quality and time, which newer firmware adds to a reception when its host has switched them on."""
_SUFFIX: Final = frozenset(b"QDT+-0123456789")
_PRINTABLE: Final = frozenset(range(0x20, 0x7F)) - frozenset(b"#$")
_WHERE: Final = "nanomodem message"
_START: Final = re.compile(rb"[#$E]")
_RELEASE: Final = re.compile(r"R([0-9.]{1,20})")


@dataclass(frozen=True, slots=True)
class Status:
    """`#A`: the modem's address, and its firmware where the modem reports it."""

    address: int
    firmware: str | None


@dataclass(frozen=True, slots=True)
class Confirmation:
    """`$B`, `$M`, `$U` or `$P`: the modem has accepted a command and transmits.

    Attributes:
        text: The confirmation without its end, as `$B64`.
    """

    text: bytes


@dataclass(frozen=True, slots=True)
class Refusal:
    """`E`: the modem has refused a command."""


@dataclass(frozen=True, slots=True)
class Answer:
    """`#R`: the other modem has answered a ping or acknowledged a message."""

    source: int
    travel_s: float


@dataclass(frozen=True, slots=True)
class NoAnswer:
    """`#TO`: the other modem has not answered in time."""


@dataclass(frozen=True, slots=True)
class NanoData:
    """`#B` or `#U`: data from another modem.

    Attributes:
        source: Address of the sender of a broadcast, None for a unicast message.
        data: 1 to 64 bytes.
    """

    source: int | None
    data: bytes


NanoMessage = Status | Confirmation | Refusal | Answer | NoAnswer | NanoData


def broadcast_command(data: bytes) -> tuple[bytes, bytes]:
    """Return the command that broadcasts 2 to 64 bytes, and its confirmation."""
    head = b"$B%02d" % len(data)
    return head + data, head


def unicast_command(destination: int, data: bytes) -> tuple[bytes, bytes]:
    """Return the command that sends 2 to 64 bytes with acknowledgement, and its confirmation."""
    head = b"$M%03d%02d" % (destination, len(data))
    return head + data, head


def ping_command(destination: int) -> tuple[bytes, bytes]:
    """Return the command that pings, and its confirmation."""
    head = b"$P%03d" % destination
    return head, head


class _IncompleteError(Exception):
    """The bytes end within a message."""


class _Cursor:
    """Reads the fields of a message that begins at `at`."""

    def __init__(self, data: bytearray, at: int) -> None:
        self.data, self.at = data, at

    def peek(self) -> int:
        if self.at >= len(self.data):
            raise _IncompleteError
        return self.data[self.at]

    def expect(self, text: bytes) -> None:
        for each in text:
            if self.peek() != each:
                raise SentenceError(_WHERE, "text", bytes((self.peek(),)), repr(bytes((each,))))
            self.at += 1

    def number(self, name: str, digits: int, least: int, most: int) -> int:
        value = 0
        for _ in range(digits):
            digit = self.peek() - ord("0")
            if not 0 <= digit <= 9:
                raise SentenceError(_WHERE, name, bytes((self.peek(),)), f"{digits} decimal digits")
            value = 10 * value + digit
            self.at += 1
        if not least <= value <= most:
            raise SentenceError(_WHERE, name, value, f"{least}..{most}")
        return value

    def take(self, count: int) -> bytes:
        if self.at + count > len(self.data):
            raise _IncompleteError
        self.at += count
        return bytes(self.data[self.at - count : self.at])

    def run(self, allowed: frozenset[int], limit: int) -> bytes:
        start = self.at
        while self.at - start < limit and self.peek() in allowed:
            self.at += 1
        return bytes(self.data[start : self.at])


def _parse(cursor: _Cursor) -> NanoMessage:
    """Parse one message; its end is `cursor.at`.

    Raises:
        SentenceError: No message begins here.
        _IncompleteError: The bytes end within the message.
    """
    start = cursor.at
    if cursor.peek() == ord("E"):
        cursor.expect(b"E\r\n")
        return Refusal()
    kind = cursor.take(2)
    message: NanoMessage
    if kind == b"#A":
        address = cursor.number("address", 3, 0, 255)
        text = cursor.run(_PRINTABLE, MAX_STATUS_BYTES).decode("ascii")
        release = _RELEASE.search(text)
        message = Status(address, release.group(1) if release else None)
    elif kind in (b"#B", b"#U"):
        source = cursor.number("address", 3, 0, 255) if kind == b"#B" else None
        message = NanoData(source, cursor.take(cursor.number("length", 2, 1, MAX_PAYLOAD_BYTES)))
        cursor.run(_SUFFIX, MAX_SUFFIX_BYTES)
    elif kind == b"#R":
        source = cursor.number("address", 3, 0, 255)
        cursor.expect(b"T")
        message = Answer(source, cursor.number("travel time", 5, 0, 99_999) * TRAVEL_STEP_S)
        cursor.run(_SUFFIX, MAX_SUFFIX_BYTES)
    elif kind == b"#T":
        cursor.expect(b"O")
        message = NoAnswer()
    elif kind in (b"$B", b"$M", b"$U", b"$P"):
        if kind != b"$B":
            cursor.number("address", 3, 0, 255)
        if kind != b"$P":
            cursor.number("length", 2, 0, MAX_PAYLOAD_BYTES)
        message = Confirmation(bytes(cursor.data[start : cursor.at]))
    else:
        raise SentenceError(_WHERE, "kind", kind, "#A, #B, #U, #R, #TO, $B, $M, $U, $P or E")
    cursor.expect(b"\r\n")
    return message


class NanoMessageAssembler(Assembler[NanoMessage]):
    """Divides the bytes of the modem into messages. It keeps less than the longest message."""

    @override
    def abandon(self) -> list[NanoMessage | SentenceError]:
        found: list[NanoMessage | SentenceError] = []
        if self._buffer:
            found.append(SentenceError(_WHERE, "end", bytes(self._buffer[:20]), "a complete message"))
        while self._buffer:
            del self._buffer[0]
            found += (item for item in self._messages() if not isinstance(item, SentenceError))
        return found

    @override
    def _messages(self) -> list[NanoMessage | SentenceError]:
        found: list[NanoMessage | SentenceError] = []
        at, skipping = 0, False
        while at < len(self._buffer):
            cursor = _Cursor(self._buffer, at)
            try:
                found.append(_parse(cursor))
            except _IncompleteError:
                break
            except SentenceError as error:
                start = _START.search(self._buffer, at + 1)
                end = start.start() if start else len(self._buffer)
                if not skipping and self._buffer[at:end].strip(b"\r\n"):
                    found.append(error)
                    skipping = True
                at = end
            else:
                at, skipping = cursor.at, False
        del self._buffer[:at]
        return found
