r"""Messages of an S2C modem to its host: their limits in the stream of bytes, and their fields.

In data mode a message is `+++AT<command>:<length>:<text>\r\n`; the command is empty for a notification. In command
mode it is the text alone. Received data is binary: its length field, not an end of line, delimits it.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from typing_extensions import override

from sonarpost.errors import SentenceError
from sonarpost.modem.interface import ModemEvent
from sonarpost.modem.packet_queue import Assembler

MAX_TEXT_BYTES: Final = 4096
"""Greatest length of a message."""
MAX_DATA_BYTES: Final = 1024
"""Greatest length of the data in a message."""
MAX_DURATION_US: Final = 600_000_000
"""Greatest duration or travel time in a message."""
MAX_ADDRESS: Final = 255

_WHERE: Final = "S2C modem"
_ESCAPE: Final = b"+++AT"
_END: Final = b"\r\n"
_HEADER: Final = re.compile(rb"\+\+\+AT([^:+\r\n]{0,32}):(\d{1,4}):")
_PARTIAL_HEADER: Final = re.compile(rb"\+\+\+AT[^:+\r\n]{0,32}(:\d{0,4})?")
_RECEIVED: Final = re.compile(rb"RECV(|IM|IMS|PBM),(?:p\d{1,3},)?(\d{1,4}),")
_DATA_FIELDS: Final = {"": 7, "IM": 7, "IMS": 7, "PBM": 6}
"""Fields between the length and the data."""
_MAX_FIELDS_BYTES: Final = 160
_INTEGER: Final = re.compile(r"-?\d{1,18}")
_DECIMAL: Final = re.compile(r"-?\d{1,12}(\.\d{1,9})?")
_IGNORED: Final = frozenset(
    {"BITRATE", "SRCLEVEL", "PHYON", "PHYOFF", "RADDR", "DROPCNT", "USBLANGLES", "USBLPHYD", "USBLPHYP", "STATUS"}
)


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One message of the stream.

    Attributes:
        command: Command that it answers, "" for a notification, None in command mode, where it is not named.
        text: Its text.
    """

    command: str | None
    text: bytes


@dataclass(frozen=True, slots=True)
class S2cReply:
    """Answer to a command: `OK`, `BUSY …`, `ERROR …` or a value. `command` is as in `RawMessage`."""

    command: str | None
    text: str


@dataclass(frozen=True, slots=True)
class S2cData:
    """Data of another modem.

    Attributes:
        kind: "IM" instant message, "IMS" synchronous instant message, "PBM" piggyback message, "" burst data.
        ack: Whether an acknowledgement was requested.
        rssi_db: Signal strength, dB re 1 V.
        integrity: Signal integrity as the modem reports it.
        velocity_mps: Relative velocity.
        data: The data.
    """

    kind: str
    source: int
    destination: int
    ack: bool
    rssi_db: float
    integrity: int
    velocity_mps: float
    data: bytes


@dataclass(frozen=True, slots=True)
class DeliveryReport:
    """What became of a message: `result` is DELIVERED, FAILED, CANCELED or EXPIRED, `kind` is as in `S2cData`."""

    result: str
    kind: str
    address: int


@dataclass(frozen=True, slots=True)
class SendStart:
    """A transmission has begun; `kind` is the modem's word for it, as "im"."""

    address: int
    kind: str
    duration_s: float


@dataclass(frozen=True, slots=True)
class SendEnd:
    """A transmission has ended."""

    address: int
    kind: str
    duration_s: float


@dataclass(frozen=True, slots=True)
class ReceptionStart:
    """A reception has begun."""


@dataclass(frozen=True, slots=True)
class ReceptionEnd:
    """A reception has ended; the data of one that has not `failed` follows."""

    failed: bool


@dataclass(frozen=True, slots=True)
class UsblPosition(ModemEvent):
    """A USBL modem has measured the position of another modem.

    Attributes:
        address: Address of the other modem.
        east_m: Distance east of the USBL modem.
        north_m: Distance north of it.
        up_m: Distance above it.
        travel_s: One-way travel time.
        accuracy_m: Accuracy as the modem estimates it.
    """

    address: int
    east_m: float
    north_m: float
    up_m: float
    travel_s: float
    accuracy_m: float


@dataclass(frozen=True, slots=True)
class Ignored:
    """A notification that the driver does not use."""

    name: str


S2cMessage = (
    S2cReply | S2cData | DeliveryReport | SendStart | SendEnd | ReceptionStart | ReceptionEnd | UsblPosition | Ignored
)


class S2cMessageAssembler(Assembler[RawMessage]):
    """Divides the stream of bytes into messages of either mode."""

    @override
    def abandon(self) -> list[RawMessage | SentenceError]:
        """Give up the incomplete message; return its error, and the messages that its length field had hidden."""
        found: list[RawMessage | SentenceError] = []
        while self._buffer:
            found.append(self._reject(self._next_escape(1)))
            found += self._messages()
        return found

    @override
    def _messages(self) -> list[RawMessage | SentenceError]:
        found: list[RawMessage | SentenceError] = []
        while (item := self._next()) is not None:
            found.append(item)
        return found

    def _next(self) -> RawMessage | SentenceError | None:
        while self._buffer.startswith((b"\r", b"\n")):
            del self._buffer[0]
        if not self._buffer or _ESCAPE.startswith(bytes(self._buffer[: len(_ESCAPE)])):
            return None if len(self._buffer) < len(_ESCAPE) else self._next_escaped()
        if (received := _RECEIVED.match(self._buffer)) is not None:
            return self._next_received(received)
        return self._next_line()

    def _next_escaped(self) -> RawMessage | SentenceError | None:
        header = _HEADER.match(self._buffer)
        if header is None:
            is_partial = _PARTIAL_HEADER.fullmatch(self._buffer) is not None
            return None if is_partial else self._reject(self._next_escape(1))
        end = header.end() + int(header[2])
        if end - header.end() > MAX_TEXT_BYTES:
            return self._reject(self._next_escape(1))
        if len(self._buffer) < end + len(_END):
            return None
        if self._buffer[end : end + len(_END)] != _END:
            return self._reject(self._next_escape(1))
        return self._take(header[1].decode("latin-1"), header.end(), end)

    def _next_received(self, received: re.Match[bytes]) -> RawMessage | SentenceError | None:
        place, length = received.end(), int(received[2])
        for _ in range(_DATA_FIELDS[received[1].decode()]):
            comma = self._buffer.find(b",", place, _MAX_FIELDS_BYTES)
            fields = self._buffer[place : comma if comma >= 0 else _MAX_FIELDS_BYTES]
            if b"\r" in fields or b"\n" in fields or (len(self._buffer) >= _MAX_FIELDS_BYTES and comma < 0):
                return self._next_line()
            if comma < 0:
                return None
            place = comma + 1
        end = place + length
        if length > MAX_DATA_BYTES:
            return self._reject(self._next_escape(1))
        if len(self._buffer) < end + len(_END):
            return None
        if self._buffer[end : end + len(_END)] != _END:
            return self._next_line()
        return self._take(None, 0, end)

    def _next_line(self) -> RawMessage | SentenceError | None:
        end, escape = self._buffer.find(_END), self._next_escape(0)
        if escape < len(self._buffer) and not 0 <= end < escape:
            return self._reject(escape)
        if end >= 0:
            return self._take(None, 0, end) if end <= MAX_TEXT_BYTES else self._reject(end)
        return self._reject(escape) if len(self._buffer) > MAX_TEXT_BYTES else None

    def _next_escape(self, start: int) -> int:
        """Return where the next message of data mode may begin, or the number of bytes."""
        place = self._buffer.find(_ESCAPE, start)
        return place if place >= 0 else len(self._buffer)

    def _take(self, command: str | None, start: int, end: int) -> RawMessage:
        message = RawMessage(command, bytes(self._buffer[start:end]))
        del self._buffer[: end + len(_END)]
        return message

    def _reject(self, count: int) -> SentenceError:
        junk = bytes(self._buffer[:40])[:count]
        del self._buffer[:count]
        return SentenceError(_WHERE, "message", junk, "a message of the modem with its length and end")


def parse(raw: RawMessage) -> S2cMessage:
    """Parse one message.

    Raises:
        SentenceError: A field is missing, superfluous or out of range.
    """
    if raw.command:
        return S2cReply(raw.command, _text(raw.text[:MAX_TEXT_BYTES]))
    if (received := _RECEIVED.match(raw.text)) is not None:
        return _received(raw.text, received)
    text = _text(raw.text)
    name, *fields = text.split(",")
    if (known := _NOTIFICATIONS.get(name)) is not None:
        count, build = known
        _count(name, fields, count)
        return build(fields)
    if (report := re.fullmatch(r"(DELIVERED|FAILED|CANCELED|EXPIRED)(|IM|IMS|PBM)", name)) is not None:
        _count(name, fields, 1 if report[2] else 2)
        return DeliveryReport(report[1], report[2], _address(fields[-1]))
    if raw.command is None or name in _IGNORED:
        return Ignored(name) if name in _IGNORED else S2cReply(None, text)
    raise SentenceError(_WHERE, "notification", text[:40], "a notification of the modem")


def _received(text: bytes, received: re.Match[bytes]) -> S2cData:
    kind, length = received[1].decode(), int(received[2])
    *fields, data = text[received.end() :].split(b",", _DATA_FIELDS[kind])
    name = "RECV" + kind
    _count(name, [_text(field) for field in fields], _DATA_FIELDS[kind])
    if len(data) != length or length > MAX_DATA_BYTES:
        raise SentenceError(_WHERE, f"length of {name}", length, f"{len(data)}, at most {MAX_DATA_BYTES}")
    values = [_text(field) for field in fields]
    # Signal strength, integrity and velocity; burst data has the travel time before the velocity.
    first = {"": 3, "PBM": 3}.get(kind, 4)
    rssi, integrity, velocity = values[first], values[first + 1], values[-1]
    return S2cData(
        kind,
        _address(values[0]),
        _address(values[1]),
        kind == "" or (kind == "IM" and values[2] == "ack"),
        _decimal(name, rssi),
        _integer(name, integrity, 100_000),
        _decimal(name, velocity),
        data,
    )


def _text(data: bytes) -> str:
    try:
        return data.decode("ascii")
    except UnicodeDecodeError as error:
        raise SentenceError(_WHERE, "text", data[:40], "ASCII") from error


def _count(name: str, fields: list[str], count: int) -> None:
    if len(fields) != count:
        raise SentenceError(_WHERE, name, f"{len(fields)} fields", f"{count} fields")


def _integer(name: str, text: str, limit: int) -> int:
    if _INTEGER.fullmatch(text) is None or not -limit <= int(text) <= limit:
        raise SentenceError(_WHERE, name, text[:40], f"a whole number of at most {limit}")
    return int(text)


def _decimal(name: str, text: str) -> float:
    if _DECIMAL.fullmatch(text) is None:
        raise SentenceError(_WHERE, name, text[:40], "a decimal number")
    return float(text)


def _address(text: str) -> int:
    address = _integer("address", text, MAX_ADDRESS)
    if address < 0:
        raise SentenceError(_WHERE, "address", text[:40], f"0..{MAX_ADDRESS}")
    return address


def _seconds(text: str) -> float:
    duration_us = _integer("duration", text, MAX_DURATION_US)
    if duration_us < 0:
        raise SentenceError(_WHERE, "duration", text[:40], f"0..{MAX_DURATION_US} µs")
    return duration_us / 1e6


def parse_travel_time_s(text: str) -> float | None:
    """Return the travel time of a reply to `AT?T`, given in microseconds; None if it is no such time."""
    try:
        travel_s = _seconds(text)
    except SentenceError:
        return None
    return travel_s if travel_s > 0 else None


def _usbl(fields: list[str]) -> UsblPosition:
    east_m, north_m, up_m, accuracy_m = (_decimal("USBLLONG", fields[number]) for number in (6, 7, 8, 15))
    return UsblPosition(_address(fields[2]), east_m, north_m, up_m, _seconds(fields[12]), accuracy_m)


_NOTIFICATIONS: Final[Mapping[str, tuple[int, Callable[[list[str]], S2cMessage]]]] = MappingProxyType(
    {
        "RECVSTART": (0, lambda fields: ReceptionStart()),
        "RECVEND": (4, lambda fields: ReceptionEnd(failed=False)),
        "RECVFAILED": (3, lambda fields: ReceptionEnd(failed=True)),
        "SENDSTART": (4, lambda fields: SendStart(_address(fields[0]), fields[1], _seconds(fields[2]))),
        "SENDEND": (4, lambda fields: SendEnd(_address(fields[0]), fields[1], _seconds(fields[3]))),
        "USBLLONG": (16, _usbl),
    }
)
"""Notifications by name: the number of their fields, and a function that reads them."""
