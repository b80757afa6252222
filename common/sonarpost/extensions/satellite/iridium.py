"""Message bearer of an Iridium 9602 or 9603 terminal (a RockBLOCK among others), by its AT commands.

`exchange_steps` is the sans-I/O part: one exchange with the network, bytes in, bytes out. `IridiumTerminal` runs it on
a serial port or another URL of pyserial.
"""

import termios
import threading
import time
from collections.abc import Generator
from dataclasses import dataclass
from typing import Final

import serial

from sonarpost.errors import BadInputError, PortError
from sonarpost.limits import limit
from sonarpost.runtime.serial_device import close_port, open_port

MAX_INCOMING_BYTES: Final = 270
MAX_LINE_BYTES: Final = 200
MAX_LINES: Final = 20
ANSWER_S: Final = 10.0
POLL_S: Final = 0.3
SESSION_S: Final = 90.0
"""The terminal itself gives up after about a minute."""
EXCHANGE_S: Final = limit(
    150.0, "s", "deadlines", "satellite terminal", "terminal", "exchange of a message", "the message counts as not sent"
)
_MO_SENT: Final = 4
"""Highest status of +SBDIX that means that the message was sent."""


class TerminalError(BadInputError):
    """The terminal replied in another way than its manual specifies."""


@dataclass(frozen=True, slots=True)
class ExchangeResult:
    """Result of one exchange with the network.

    Attributes:
        sent: Whether the outgoing message was taken over by the network.
        received: The incoming message; None if there was none.
        waiting: Further incoming messages at the network.
    """

    sent: bool
    received: bytes | None = None
    waiting: int = 0


@dataclass(frozen=True, slots=True)
class Write:
    """Write these bytes to the terminal."""

    data: bytes


@dataclass(frozen=True, slots=True)
class ReadLine:
    """Read up to a line feed, at most 200 bytes."""

    timeout_s: float = ANSWER_S


@dataclass(frozen=True, slots=True)
class ReadBytes:
    """Read exactly this many bytes."""

    size: int


Action = Write | ReadLine | ReadBytes


def exchange_steps(outgoing: bytes | None) -> Generator[Action, bytes, ExchangeResult]:
    """Yield the actions of one exchange; receive the bytes that each read action returned.

    Args:
        outgoing: Message, 1 to 340 bytes; None clears the outgoing buffer, so that only the mailbox is checked.

    Raises:
        TerminalError: The terminal replied in an unexpected way; a read action returned too few bytes.
    """
    yield from _command(b"ATE0", b"OK")
    if outgoing is None:
        yield from _command(b"AT+SBDD0", b"0", b"OK")
    else:
        yield from _command(b"AT+SBDWB=%d" % len(outgoing), b"READY")
        yield Write(outgoing + _checksum(outgoing))
        yield from _expect(b"0")
        yield from _expect(b"OK")
    yield Write(b"AT+SBDIX\r")
    fields = yield from _status()
    mo_status, mt_status, mt_length, waiting = fields[0], fields[2], fields[4], fields[5]
    yield from _expect(b"OK")
    received = None
    if mt_status == 1 and mt_length:
        yield Write(b"AT+SBDRB\r")
        received = yield from _incoming()
        yield from _expect(b"OK")
    return ExchangeResult(outgoing is not None and mo_status <= _MO_SENT, received, max(0, waiting))


def _command(command: bytes, *replies: bytes) -> Generator[Action, bytes, None]:
    yield Write(command + b"\r")
    for reply in replies:
        yield from _expect(reply)


def _line(timeout_s: float) -> Generator[Action, bytes, bytes]:
    """Return the next line that is neither empty nor the echo of a command."""
    for _ in range(MAX_LINES):
        line = yield ReadLine(timeout_s)
        if not line.endswith(b"\n"):
            raise TerminalError("Iridium terminal", "reply", line[:40], f"a line within {timeout_s:g} s")
        text = line.strip()
        if text and not text.startswith(b"AT"):
            return text
    raise TerminalError("Iridium terminal", "reply", "empty lines", "a reply")


def _expect(reply: bytes) -> Generator[Action, bytes, None]:
    for _ in range(MAX_LINES):
        text = yield from _line(ANSWER_S)
        if text == reply:
            return
        # SBDRING and the like can come at any time.
        if text != b"SBDRING":
            raise TerminalError("Iridium terminal", "reply", text, reply.decode())
    raise TerminalError("Iridium terminal", "reply", "SBDRING", reply.decode())


def _status() -> Generator[Action, bytes, list[int]]:
    for _ in range(MAX_LINES):
        text = yield from _line(SESSION_S)
        if text == b"SBDRING":
            continue
        head, _, values = text.partition(b":")
        fields = values.split(b",")
        try:
            numbers = [int(field) for field in fields]
        except ValueError:
            numbers = []
        if head != b"+SBDIX" or len(numbers) != 6:
            break
        if not 0 <= numbers[4] <= MAX_INCOMING_BYTES:
            raise TerminalError("Iridium terminal", "MT length", numbers[4], f"0 to {MAX_INCOMING_BYTES}")
        return numbers
    raise TerminalError("Iridium terminal", "+SBDIX", text, "six numbers")


def _incoming() -> Generator[Action, bytes, bytes]:
    size = int.from_bytes((yield ReadBytes(2)), "big")
    if not 1 <= size <= MAX_INCOMING_BYTES:
        raise TerminalError("Iridium terminal", "+SBDRB length", size, f"1 to {MAX_INCOMING_BYTES}")
    data = yield ReadBytes(size + 2)
    if len(data) != size + 2 or _checksum(data[:size]) != data[size:]:
        raise TerminalError("Iridium terminal", "+SBDRB checksum", data[size:].hex(), "the sum of the bytes")
    return data[:size]


def _checksum(data: bytes) -> bytes:
    return (sum(data) & 0xFFFF).to_bytes(2, "big")


class IridiumTerminal:
    """A terminal on a serial port. Its calls take as long as the network does, up to a minute and a half.

    Args:
        url: Serial port, or another URL of pyserial: `/dev/ttyUSB0`, `socket://host:port`.
        baud: Bits a second.
    """

    def __init__(self, url: str, baud: int = 19200) -> None:
        self._url = url
        self._baud = baud
        self._port: serial.Serial | None = None
        self._stopping = threading.Event()
        self._ends_s = 0.0

    def exchange(self, outgoing: bytes | None) -> ExchangeResult:
        """Send a message, or None to fetch only; return what was received in the same exchange.

        Raises:
            PortError: The port cannot be opened, or was lost.
            TerminalError: The terminal replied in an unexpected way.
        """
        try:
            port = self._open()
            self._ends_s = time.monotonic() + EXCHANGE_S
            steps = exchange_steps(outgoing)
            action = next(steps)
            while True:
                action = steps.send(self._perform(port, action))
        except StopIteration as finished:
            result: ExchangeResult = finished.value
            return result
        except (OSError, ValueError, termios.error) as error:  # SerialException is an OSError
            self.close()
            raise PortError(f"{self._url}: {error}") from error
        except (PortError, TerminalError):
            self.close()  # the rest of the reply belongs to no later command
            raise

    def _perform(self, port: serial.Serial, action: Action) -> bytes:
        if time.monotonic() > self._ends_s:
            raise TerminalError("Iridium terminal", "exchange", "no end", f"an end within {EXCHANGE_S:g} s")
        if isinstance(action, Write):
            port.write(action.data)
            return b""
        timeout_s = action.timeout_s if isinstance(action, ReadLine) else ANSWER_S
        size = MAX_LINE_BYTES if isinstance(action, ReadLine) else action.size
        ends_s = min(time.monotonic() + timeout_s, self._ends_s)
        data = b""
        while len(data) < size and time.monotonic() < ends_s:
            if self._stopping.is_set():
                raise PortError(f"{self._url}: stopped")
            data += port.read(1)
            if isinstance(action, ReadLine) and data.endswith(b"\n"):
                break
        return data

    def _open(self) -> serial.Serial:
        if self._port is None:
            self._port = serial.serial_for_url(
                self._url, baudrate=self._baud, timeout=POLL_S, write_timeout=ANSWER_S, do_not_open=True
            )
            open_port(self._port)
        return self._port

    def stop(self) -> None:
        """End the exchange in progress, and all further ones, with a PortError within half a second."""
        self._stopping.set()

    def close(self) -> None:
        """Close the port; the next exchange opens it again."""
        port, self._port = self._port, None
        if port is not None:
            close_port(port)
