"""The only place that touches the modem's port: any pyserial URL, opened again whenever it goes away.

A thread opens the port, reads it and notices when it is gone (an unplugged adapter, a closed pseudo-terminal, a
TCP connection that ended). What it reads and each change of state is handed to a callback in that thread.
"""

from __future__ import annotations

import io
import logging
import os
import select
import socket
import termios
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import serial

from sonarpost.errors import ConfigError, PortError

log = logging.getLogger(__name__)

_READ_BYTES = 4096
_POLL_S = 0.2
_CLOSE_S = 1.0


@dataclass(frozen=True, slots=True)
class PortOpened:
    """The port is open."""


@dataclass(frozen=True, slots=True)
class PortLost:
    """The port was open and is gone; it is being opened again."""

    reason: str


PortEvent = PortOpened | PortLost | bytes
"""What the callback is given: a change of state, or bytes as they came."""


class SerialLink:
    """A serial port, or something that pyserial treats as one, that is opened again and again.

    Args:
        url: `/dev/ttyUSB0`, `/dev/pts/3`, `socket://host:port`, `rfc2217://host:port`, `loop://`.
        baud: Bits a second; 8N1 without flow control, as the Micro-Modem is set.
        first_retry_s: Wait after the first failed attempt to open; it doubles
        longest_retry_s: up to this.
        write_timeout_s: A write that the port does not take within this counts as a lost port.

    Raises:
        ConfigError: pyserial does not know this kind of URL.
    """

    def __init__(
        self,
        url: str,
        baud: int = 19200,
        *,
        first_retry_s: float = 0.2,
        longest_retry_s: float = 5.0,
        write_timeout_s: float = 5.0,
    ) -> None:
        self.url = url
        self.baud = baud
        self._first_retry_s = first_retry_s
        self._longest_retry_s = longest_retry_s
        self._write_timeout_s = write_timeout_s
        # Held while writing and while closing: a descriptor closed under a writer may be somebody else's next moment.
        self._in_use = threading.Lock()
        self._port: serial.Serial | None = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._problem: str | None = None
        self._make_port()

    @property
    def is_open(self) -> bool:
        """Whether the port is open, as far as is known."""
        return self._port is not None

    @property
    def problem(self) -> str | None:
        """Why the port is not open, for the health report; None while it is, and before the first attempt."""
        return self._problem

    def start(self, on_event: Callable[[PortEvent], None]) -> None:
        """Begin to open and read the port; returns at once.

        Args:
            on_event: Called from the reading thread, in order.

        Raises:
            PortError: Started already.
        """
        if self._thread is not None:
            raise PortError(f"{self.url}: already started")
        # Each run has its own: a thread that is slow to end must not take a new start for its own.
        self._closing = threading.Event()
        arguments = (on_event, self._closing)
        self._thread = threading.Thread(target=self._run, args=arguments, name=f"port {self.url}", daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> None:
        """Write all of `data`; blocks until the port has taken it.

        Raises:
            PortError: The port is not open, or is lost over this.
        """
        with self._in_use:
            port = self._port
            if port is None:
                raise PortError(f"{self.url}: not open ({self._problem or 'not opened yet'})")
            try:
                port.write(data)
            except (serial.SerialException, OSError) as error:
                # The reading thread sees that the port is no longer the present one, and closes it.
                self._port, self._problem = None, _why(error)
                raise PortError(f"{self.url}: cannot be written: {_why(error)}") from error

    def close(self) -> None:
        """Close the port and end the thread; returns within a second.

        A thread that hangs in the driver of a broken adapter, or in a connection attempt, ends when that lets it.
        """
        self._closing.set()
        thread, self._thread = self._thread, None
        if thread is not None and thread is not threading.current_thread():
            thread.join(_CLOSE_S)
            if thread.is_alive():
                log.warning("%s: port still busy; it closes by itself", self.url)

    def _run(self, on_event: Callable[[PortEvent], None], closing: threading.Event) -> None:
        wait_s = self._first_retry_s
        while not closing.is_set():
            port = self._open(closing)
            if port is None:
                return
            opened_s = time.monotonic()
            on_event(PortOpened())
            reason = self._read(port, on_event, closing)
            self._drop(port, reason)
            if not closing.is_set():
                log.warning("%s: port lost: %s", self.url, self._problem)
                on_event(PortLost(self._problem or reason))
            # A port that opens and is lost at once (a server that is full) is not hammered.
            lasted = time.monotonic() - opened_s > self._longest_retry_s
            wait_s = self._first_retry_s if lasted else min(2.0 * wait_s, self._longest_retry_s)
            closing.wait(wait_s)

    def _open(self, closing: threading.Event) -> serial.Serial | None:
        """Try until the port is open; None when the link is closed before that."""
        wait_s, told = self._first_retry_s, False
        while not closing.is_set():
            port = self._make_port()
            try:
                port.open()
                if self.url.startswith("socket://"):
                    _watch_connection(port.fileno())
            except (serial.SerialException, OSError, ValueError, termios.error) as error:
                _close_port(port)
                self._problem = _why(error)
                if not told:
                    log.warning("%s: port cannot be opened: %s; trying again", self.url, self._problem)
                    told = True
                closing.wait(wait_s)
                wait_s = min(2.0 * wait_s, self._longest_retry_s)
                continue
            self._port, self._problem = port, None
            log.info("%s: port open", self.url)
            return port
        return None

    def _read(self, port: serial.Serial, on_event: Callable[[PortEvent], None], closing: threading.Event) -> str:
        """Hand over bytes until the port is gone; return why."""
        try:
            descriptor: int | None = port.fileno()
        except (io.UnsupportedOperation, AttributeError):
            descriptor = None  # loop:// and rfc2217:// have none: pyserial itself waits for their bytes
        while not closing.is_set() and self._port is port:
            try:
                data = _read_object(port) if descriptor is None else _read_descriptor(descriptor)
            except (serial.SerialException, OSError, TypeError, ValueError) as error:
                return _why(error)
            if data:
                on_event(data)
        return "closed"

    def _drop(self, port: serial.Serial, reason: str) -> None:
        """Forget and close the port; the first reason is the one that counts."""
        if self._port is port:
            self._port, self._problem = None, reason
        cancel_write = getattr(port, "cancel_write", None)
        if cancel_write is not None:
            cancel_write()
        with self._in_use:
            _close_port(port)

    def _make_port(self) -> serial.Serial:
        try:
            return serial.serial_for_url(
                self.url, baudrate=self.baud, timeout=_POLL_S, write_timeout=self._write_timeout_s, do_not_open=True
            )
        except ValueError as error:
            expected = "a device path or socket://, rfc2217://, loop://"
            raise ConfigError("modem port", "url or baud", f"{self.url} {self.baud}", expected) from error


def _close_port(port: serial.Serial) -> None:
    # pyserial 3.5 forgets, without closing it, a socket whose shutdown fails because the other end has reset it.
    connection = getattr(port, "_socket", None)
    try:
        port.close()
    except (serial.SerialException, OSError) as error:
        log.debug("%s: while closing: %s", port.port, error)
    if isinstance(connection, socket.socket):
        connection.close()


def _watch_connection(descriptor: int) -> None:
    """Let the kernel notice a terminal server that has lost its power, which otherwise takes many minutes."""
    with socket.socket(fileno=os.dup(descriptor)) as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 5), ("TCP_USER_TIMEOUT", 20_000)):
            if hasattr(socket, option):
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


def _read_descriptor(descriptor: int) -> bytes:
    """Wait a moment for bytes; nothing readable is b"", the end of the stream an OSError."""
    readable, _, _ = select.select([descriptor], [], [], _POLL_S)
    if not readable:
        return b""
    try:
        data = os.read(descriptor, _READ_BYTES)
    except BlockingIOError:
        return b""
    if not data:
        raise OSError("the other end has closed")
    return data


def _read_object(port: serial.Serial) -> bytes:
    """Wait a moment for a byte, then take what else is there."""
    data = port.read(1)
    waiting = port.in_waiting if data else 0
    return bytes(data + port.read(min(waiting, _READ_BYTES))) if waiting else bytes(data)


def _why(error: BaseException) -> str:
    return str(error) or type(error).__name__
