"""Where hosts plug into the emulated modems: pseudo-terminals with stable names, and TCP ports.

Ports never block. A port has at most one client; `notice` says when that changes. What was written to a port has left
the emulator; whether a client read it before it went away is not known, as with a real serial line.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import termios
import tty
from abc import ABC, abstractmethod
from pathlib import Path

from sonarpost.errors import PortError

READ_BYTES = 65536


class HostPort(ABC):
    """One modem's port."""

    device: str
    """What a host opens: a path, or a pyserial URL."""

    connected: bool = False
    """Whether a client is there, as of the last `notice`, `read` or `write`."""

    @abstractmethod
    def notice(self) -> None:
        """Look whether a client came or left."""

    @abstractmethod
    def read(self) -> bytes:
        """Return what the client sent, or nothing; a client that left is noticed."""

    @abstractmethod
    def write(self, data: bytes) -> int:
        """Write as much as fits now and return how much; a client that left is noticed."""

    @abstractmethod
    def interests(self, *, writing: bool) -> list[tuple[int, int]]:
        """Return (file descriptor, poll mask) pairs to wait on; `writing` when something waits to be written."""

    @property
    @abstractmethod
    def must_be_asked(self) -> bool:
        """Whether a change can only be seen with `notice`, not by waiting."""

    @abstractmethod
    def close(self) -> None:
        """Close it and remove its name."""


class PtyPort(HostPort):
    """A pseudo-terminal behind a symbolic link that keeps its name over restarts.

    Args:
        link: The name, for example `/tmp/modems/modem-1`. An existing link is replaced; anything else there is refused.

    Raises:
        PortError: The terminal or the link cannot be made.
    """

    def __init__(self, link: Path) -> None:
        self._link = link
        try:
            self._master, slave = os.openpty()
        except OSError as error:
            raise PortError(f"{link}: no pseudo-terminal: {error}") from error
        self._slave_name = os.ttyname(slave)
        tty.setraw(slave)
        # Without a copy of our own, the kernel tells whether a client has it open.
        os.close(slave)
        os.set_blocking(self._master, False)
        try:
            self._make_link()
        except (OSError, PortError) as error:
            os.close(self._master)
            raise PortError(f"{link}: {error}") from error
        self.device = str(link)
        self._poll = select.poll()
        self._poll.register(self._master, select.POLLIN)

    def _make_link(self) -> None:
        self._link.parent.mkdir(parents=True, exist_ok=True)
        if self._link.exists() and not self._link.is_symlink():
            raise PortError("exists and is not a symbolic link")
        fresh = self._link.with_name(f".{self._link.name}.{os.getpid()}")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self._slave_name)
        fresh.replace(self._link)

    def notice(self) -> None:
        """Look whether a client came or left."""
        masks = [mask for _, mask in self._poll.poll(0)]
        # What a client wrote before it left is read first: dropping its leftovers would drop that too.
        hung_up = any(mask & select.POLLHUP and not mask & select.POLLIN for mask in masks)
        if hung_up:
            if self.connected:
                self._left()
        elif not any(mask & select.POLLHUP for mask in masks):
            self.connected = True

    def read(self) -> bytes:
        """Return what the client sent, or nothing; a client that left is noticed."""
        try:
            return os.read(self._master, READ_BYTES)
        except OSError as error:
            self._check(error)
            return b""

    def write(self, data: bytes) -> int:
        """Write as much as fits now and return how much; a client that left is noticed."""
        try:
            return os.write(self._master, data)
        except OSError as error:
            self._check(error)
            return 0

    def _check(self, error: OSError) -> None:
        if error.errno == errno.EIO:
            if self.connected:
                self._left()
        elif error.errno not in {errno.EAGAIN, errno.EINTR}:
            raise PortError(f"{self.device}: {error}") from error

    def _left(self) -> None:
        """Drop what the client left unread, so that the next one does not take it for news."""
        self.connected = False
        try:
            slave = os.open(self._slave_name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError:
            # Held exclusively by the next client already: what it finds is then its own to drop.
            return
        try:
            termios.tcflush(slave, termios.TCIOFLUSH)
            tty.setraw(slave)
        finally:
            os.close(slave)

    def interests(self, *, writing: bool) -> list[tuple[int, int]]:
        """Return what to wait on: nothing while no client is there, as the terminal then reports a hang-up at once."""
        if not self.connected:
            return []
        return [(self._master, select.POLLIN | (select.POLLOUT if writing else 0))]

    @property
    def must_be_asked(self) -> bool:
        """A terminal does not wake anybody when a client opens it."""
        return not self.connected

    def close(self) -> None:
        """Close the terminal; remove the link unless somebody else has replaced it."""
        os.close(self._master)
        if self._link.is_symlink() and str(self._link.readlink()) == self._slave_name:
            self._link.unlink()


class TcpPort(HostPort):
    """A TCP port for `socket://` URLs. A new client takes the place of the one before, which may be a dead one.

    Args:
        host: Address to listen on.
        port: Port number, or 0 for a free one.

    Raises:
        PortError: The port cannot be had.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise PortError(f"socket://{host}:{port}: {error}") from error
        self._listener.settimeout(0)
        self._client: socket.socket | None = None
        self._newcomer: socket.socket | None = None
        self.device = f"socket://{host}:{self._listener.getsockname()[1]}"

    def notice(self) -> None:
        """Let a newcomer in; the client before it is shown as gone first, for one call."""
        if self._newcomer is None:
            try:
                self._newcomer, _ = self._listener.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            self._newcomer.settimeout(0)
            self._newcomer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._client is not None:
                self._left()
                return
        self._client, self._newcomer = self._newcomer, None
        self.connected = True

    def read(self) -> bytes:
        """Return what the client sent, or nothing; a client that left is noticed."""
        if self._client is None:
            return b""
        try:
            data = self._client.recv(READ_BYTES)
        except (BlockingIOError, InterruptedError):
            return b""
        except OSError:
            data = b""
        if not data:
            self._left()
        return data

    def write(self, data: bytes) -> int:
        """Write as much as fits now and return how much; a client that left is noticed."""
        if self._client is None:
            return 0
        try:
            return self._client.send(data)
        except (BlockingIOError, InterruptedError):
            return 0
        except OSError:
            self._left()
            return 0

    def _left(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client = None
        self.connected = False

    def interests(self, *, writing: bool) -> list[tuple[int, int]]:
        """Return what to wait on: newcomers, and the client."""
        wanted = [(self._listener.fileno(), select.POLLIN)]
        if self._client is not None:
            wanted.append((self._client.fileno(), select.POLLIN | (select.POLLOUT if writing else 0)))
        return wanted

    @property
    def must_be_asked(self) -> bool:
        """Only for the newcomer that waits for its turn."""
        return self._newcomer is not None

    def close(self) -> None:
        """Close the listener and the client."""
        for each in (self._listener, self._client, self._newcomer):
            if each is not None:
                each.close()
