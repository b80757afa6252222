"""Message bearer of an Iridium 9602 or 9603 terminal (a RockBLOCK among others), by its AT commands."""

import termios
import threading
import time
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
        """Send a message of 1 to 340 bytes, or None to fetch only; return what was received in the same exchange.

        Raises:
            PortError: The port cannot be opened, or was lost.
            TerminalError: The terminal replied in an unexpected way.
        """
        try:
            port = self._open()
            self._ends_s = time.monotonic() + EXCHANGE_S
            return self._exchange(port, outgoing)
        except (OSError, ValueError, termios.error) as error:  # SerialException is an OSError
            self.close()
            raise PortError(f"{self._url}: {error}") from error
        except (PortError, TerminalError):
            self.close()  # the rest of the reply belongs to no later command
            raise

    def _exchange(self, port: serial.Serial, outgoing: bytes | None) -> ExchangeResult:
        port.write(b"ATE0\r")
        self._expect(port, b"OK")
        if outgoing is None:
            port.write(b"AT+SBDD0\r")  # clears the outgoing buffer, so that only the mailbox is checked
        else:
            port.write(b"AT+SBDWB=%d\r" % len(outgoing))
            self._expect(port, b"READY")
            port.write(outgoing + _checksum(outgoing))
        self._expect(port, b"0", b"OK")
        port.write(b"AT+SBDIX\r")
        mo_status, _, mt_status, _, mt_length, waiting = self._status(port)
        self._expect(port, b"OK")
        received = None
        if mt_status == 1 and mt_length:
            port.write(b"AT+SBDRB\r")
            received = self._incoming(port)
            self._expect(port, b"OK")
        return ExchangeResult(outgoing is not None and mo_status <= _MO_SENT, received, max(0, waiting))

    def _expect(self, port: serial.Serial, *replies: bytes) -> None:
        for reply in replies:
            text = self._line(port, ANSWER_S)
            if text != reply:
                raise TerminalError("Iridium terminal", "reply", text, reply.decode())

    def _status(self, port: serial.Serial) -> list[int]:
        text = self._line(port, SESSION_S)
        head, _, values = text.partition(b":")
        try:
            numbers = [int(field) for field in values.split(b",")]
        except ValueError:
            numbers = []
        if head != b"+SBDIX" or len(numbers) != 6:
            raise TerminalError("Iridium terminal", "+SBDIX", text, "six numbers")
        if not 0 <= numbers[4] <= MAX_INCOMING_BYTES:
            raise TerminalError("Iridium terminal", "MT length", numbers[4], f"0 to {MAX_INCOMING_BYTES}")
        return numbers

    def _incoming(self, port: serial.Serial) -> bytes:
        size = int.from_bytes(self._read(port, 2, ANSWER_S), "big")
        if not 1 <= size <= MAX_INCOMING_BYTES:
            raise TerminalError("Iridium terminal", "+SBDRB length", size, f"1 to {MAX_INCOMING_BYTES}")
        data = self._read(port, size + 2, ANSWER_S)
        if len(data) != size + 2 or _checksum(data[:size]) != data[size:]:
            raise TerminalError("Iridium terminal", "+SBDRB checksum", data[size:].hex(), "the sum of the bytes")
        return data[:size]

    def _line(self, port: serial.Serial, timeout_s: float) -> bytes:
        """Return the next line that is neither empty, nor the echo of a command, nor a notification."""
        for _ in range(MAX_LINES):
            line = self._read(port, MAX_LINE_BYTES, timeout_s, b"\n")
            if not line.endswith(b"\n"):
                raise TerminalError("Iridium terminal", "reply", line[:40], f"a line within {timeout_s:g} s")
            text = line.strip()
            # SBDRING and the like can come at any time.
            if text and text != b"SBDRING" and not text.startswith(b"AT"):
                return text
        raise TerminalError("Iridium terminal", "reply", "empty lines", "a reply")

    def _read(self, port: serial.Serial, size: int, timeout_s: float, end: bytes = b"") -> bytes:
        """Return `size` bytes, or those up to `end`; fewer at the end of the time."""
        if time.monotonic() > self._ends_s:
            raise TerminalError("Iridium terminal", "exchange", "no end", f"an end within {EXCHANGE_S:g} s")
        ends_s = min(time.monotonic() + timeout_s, self._ends_s)
        data = b""
        while len(data) < size and time.monotonic() < ends_s:
            if self._stopping.is_set():
                raise PortError(f"{self._url}: stopped")
            data += port.read(1)
            if end and data.endswith(end):
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


def _checksum(data: bytes) -> bytes:
    return (sum(data) & 0xFFFF).to_bytes(2, "big")
