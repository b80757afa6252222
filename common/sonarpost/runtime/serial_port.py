"""A serial port that is opened again when it is lost; any pyserial URL.

A thread opens the port, reads it and detects its loss: an unplugged adapter, a closed pseudo-terminal, a closed TCP
connection. It calls back with the bytes it reads and with each change of state.
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
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import serial
from typing_extensions import override

from sonarpost.errors import ConfigError, PortError
from sonarpost.logs import kv
from sonarpost.runtime.serial_device import close_port, open_port

log = logging.getLogger(__name__)

_READ_BYTES = 4096
_POLL_S = 0.2
_CLOSE_S = 1.0
FIRST_RETRY_S, MAX_RETRY_S = 0.2, 5.0
"""Delay after the first failed attempt to open, which doubles with each attempt, and its maximum."""
WRITE_TIMEOUT_S = 5.0
"""A write that takes longer counts as a lost port."""


@dataclass(frozen=True, slots=True)
class PortOpened:
    """The port is open."""


@dataclass(frozen=True, slots=True)
class PortLost:
    """The port was open and is lost; it is opened again."""

    reason: str


PortEvent = PortOpened | PortLost | bytes
"""Argument of the callback: a change of state, or received bytes."""


class ModemPort(ABC):
    """A port that a thread opens, reads and, after a loss, opens again.

    Class attributes:
        STREAM: Whether received bytes come in any parts; False: each event is one datagram.
    """

    STREAM: ClassVar[bool] = True
    _port: object | None = None

    def __init__(self, url: str) -> None:
        self.url = url
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._error: str | None = None

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    @property
    def error(self) -> str | None:
        """Why the port is not open; None while it is open, and before the first attempt."""
        return self._error

    def start(self, on_event: Callable[[PortEvent], None]) -> None:
        """Start to open and read the port; returns at once.

        Args:
            on_event: Called from the reading thread, in order.

        Raises:
            PortError: Already started.
        """
        if self._thread is not None:
            raise PortError(f"{self.url}: already started")
        # One event a run: a thread that ends slowly must not react to the event of the next run.
        self._closing = threading.Event()
        arguments = (on_event, self._closing)
        self._thread = threading.Thread(target=self._guarded, args=arguments, name=f"port {self.url}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close the port and end the thread; returns within a second.

        A thread that is blocked in an adapter's driver or in a connection attempt ends later by itself.
        """
        self._closing.set()
        thread, self._thread = self._thread, None
        if thread is not None and thread is not threading.current_thread():
            thread.join(_CLOSE_S)
            if thread.is_alive():
                log.warning("Port still busy; it closes later", extra=kv(port=self.url))

    def _guarded(self, on_event: Callable[[PortEvent], None], closing: threading.Event) -> None:
        while not closing.is_set():
            try:
                self._run(on_event, closing)
            except Exception as error:  # a library's own error, for example of an adapter's driver
                was_open, self._port, self._error = self._port is not None, None, _reason(error)
                log.exception("Port failed; opening it again", extra=kv(port=self.url))
                if was_open:
                    on_event(PortLost(self._error))
                closing.wait(_CLOSE_S)

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Write all of `data`, on a datagram port as one datagram; blocks until it is written.

        Raises:
            PortError: The port is not open, or is lost during the write.
        """

    @abstractmethod
    def _run(self, on_event: Callable[[PortEvent], None], closing: threading.Event) -> None:
        """Open and read the port until `closing` is set."""


class SerialPort(ModemPort):
    """A serial port, or another pyserial URL, that reconnects. A serial port is opened exclusively.

    Args:
        url: `/dev/ttyUSB0`, `/dev/pts/3`, `socket://host:port`, `rfc2217://host:port`, `loop://`.
        baud: Bits a second; 8N1 without flow control, as the Micro-Modem is set.

    Raises:
        ConfigError: pyserial does not support this kind of URL.
    """

    def __init__(self, url: str, baud: int = 19200) -> None:
        super().__init__(url)
        self.baud = baud
        # Held while writing and while closing: a closed descriptor may be reused by another file at once.
        self._in_use = threading.Lock()
        self._port: serial.Serial | None = None
        self._make_port()

    @override
    def write(self, data: bytes) -> None:
        with self._in_use:
            port = self._port
            if port is None:
                raise PortError(f"{self.url}: not open ({self._error or 'not opened yet'})")
            try:
                port.write(data)
            except (serial.SerialException, OSError) as error:
                # The reading thread detects the change and closes the port.
                self._port, self._error = None, _reason(error)
                raise PortError(f"{self.url}: cannot be written: {_reason(error)}") from error

    @override
    def _run(self, on_event: Callable[[PortEvent], None], closing: threading.Event) -> None:
        wait_s = FIRST_RETRY_S
        while not closing.is_set():
            port = self._open(closing)
            if port is None:
                return
            opened_s = time.monotonic()
            on_event(PortOpened())
            reason = self._read(port, on_event, closing)
            self._discard(port, reason)
            if not closing.is_set():
                log.warning("Port lost", extra=kv(port=self.url, reason=self._error))
                on_event(PortLost(self._error or reason))
            # A port that is lost at once after opening (a server without free connections) is retried more slowly.
            was_stable = time.monotonic() - opened_s > MAX_RETRY_S
            wait_s = FIRST_RETRY_S if was_stable else min(2.0 * wait_s, MAX_RETRY_S)
            closing.wait(wait_s)

    def _open(self, closing: threading.Event) -> serial.Serial | None:
        """Retry until the port is open; return None if it is closed before."""
        wait_s, logged = FIRST_RETRY_S, ""
        while not closing.is_set():
            port = self._make_port()
            try:
                open_port(port)
                if self.url.startswith("socket://"):
                    _enable_keepalive(port.fileno())
            except (serial.SerialException, OSError, ValueError, termios.error) as error:
                close_port(port)
                self._error = _reason(error)
                if self._error != logged:
                    log.warning("Port cannot be opened; retrying", extra=kv(port=self.url, reason=self._error))
                    logged = self._error
                closing.wait(wait_s)
                wait_s = min(2.0 * wait_s, MAX_RETRY_S)
                continue
            self._port, self._error = port, None
            log.info("Port open", extra=kv(port=self.url))
            return port
        return None

    def _read(self, port: serial.Serial, on_event: Callable[[PortEvent], None], closing: threading.Event) -> str:
        """Call back with received bytes until the port is lost; return the reason."""
        try:
            descriptor: int | None = port.fileno()
        except (io.UnsupportedOperation, AttributeError):
            descriptor = None  # loop:// and rfc2217:// have none; pyserial waits for their bytes
        while not closing.is_set() and self._port is port:
            try:
                data = _read_object(port) if descriptor is None else _read_descriptor(descriptor)
            except Exception as error:
                # The caller closes the port: while it is open, it cannot be opened again.
                log.debug("Port cannot be read", exc_info=True, extra=kv(port=self.url))
                return _reason(error)
            if data:
                on_event(data)
        return "closed"

    def _discard(self, port: serial.Serial, reason: str) -> None:
        """Close the port and store why; an earlier reason is kept."""
        if self._port is port:
            self._port, self._error = None, reason
        cancel_write = getattr(port, "cancel_write", None)
        if cancel_write is not None:
            cancel_write()
        with self._in_use:
            close_port(port)

    def _make_port(self) -> serial.Serial:
        try:
            return serial.serial_for_url(
                self.url, baudrate=self.baud, timeout=_POLL_S, write_timeout=WRITE_TIMEOUT_S, do_not_open=True
            )
        except ValueError as error:
            expected = "a device path or socket://, rfc2217://, loop://"
            raise ConfigError("modem port", "url or baud", f"{self.url} {self.baud}", expected) from error


def _enable_keepalive(descriptor: int) -> None:
    """Enable TCP keepalive: without it, the loss of a terminal server is detected only after many minutes."""
    with socket.socket(fileno=os.dup(descriptor)) as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 5), ("TCP_USER_TIMEOUT", 20_000)):
            if hasattr(socket, option):
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


def _read_descriptor(descriptor: int) -> bytes:
    """Return received bytes, b"" if none arrive within the poll interval.

    Raises:
        OSError: End of the stream.
    """
    readable, _, _ = select.select([descriptor], [], [], _POLL_S)
    if not readable:
        return b""
    try:
        data = os.read(descriptor, _READ_BYTES)
    except BlockingIOError:
        return b""
    if not data:
        raise OSError("closed by the other end")
    return data


def _read_object(port: serial.Serial) -> bytes:
    """Return received bytes, b"" if none arrive within the poll interval."""
    data = port.read(1)
    waiting = port.in_waiting if data else 0
    return bytes(data + port.read(min(waiting, _READ_BYTES))) if waiting else bytes(data)


def _reason(error: BaseException) -> str:
    return str(error) or type(error).__name__
