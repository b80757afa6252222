"""Ports by which hosts reach the emulated modems: pseudo-terminals with stable names, and TCP ports.

Ports never block and have at most one client. Bytes written to a port may be lost when the client leaves before it
reads them, as with a real serial line.
"""

import errno
import os
import select
import socket
import termios
import tty
from pathlib import Path

from sonarpost.errors import PortError

READ_BYTES = 65536


class PtyPort:
    """A pseudo-terminal behind a symbolic link whose name stays the same over restarts.

    Args:
        link: The name, for example `/tmp/modems/modem-1`. An existing link is replaced; any other file is refused.

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
        # Without an open slave of its own, the process sees by POLLHUP whether a client has it open.
        os.close(slave)
        os.set_blocking(self._master, False)
        try:
            self._make_link()
        except (OSError, PortError) as error:
            os.close(self._master)
            raise PortError(f"{link}: {error}") from error
        self.device = str(link)
        self.connected = False
        self._poll = select.poll()
        self._poll.register(self._master, select.POLLIN)

    def _make_link(self) -> None:
        self._link.parent.mkdir(parents=True, exist_ok=True)
        if self._link.exists() and not self._link.is_symlink():
            raise PortError("exists and is not a symbolic link")
        temporary = self._link.with_name(f".{self._link.name}.{os.getpid()}")
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(self._slave_name)
        temporary.replace(self._link)

    def update_connection(self) -> None:
        """Update `connected`."""
        masks = [mask for _, mask in self._poll.poll(0)]
        # Bytes that the client wrote before it left are read first: the flush in `_disconnect` would drop them.
        hung_up = any(mask & select.POLLHUP and not mask & select.POLLIN for mask in masks)
        if hung_up:
            self._disconnect()
        elif not any(mask & select.POLLHUP for mask in masks):
            self.connected = True

    def read(self) -> bytes:
        """Return the bytes from the client, possibly none."""
        try:
            return os.read(self._master, READ_BYTES)
        except OSError as error:
            self._check(error)
            return b""

    def write(self, data: bytes) -> int:
        """Write as many bytes as possible without blocking and return their number."""
        try:
            return os.write(self._master, data)
        except OSError as error:
            self._check(error)
            return 0

    def _check(self, error: OSError) -> None:
        if error.errno == errno.EIO:
            self._disconnect()
        elif error.errno not in {errno.EAGAIN, errno.EINTR}:
            raise PortError(f"{self.device}: {error}") from error

    def _disconnect(self) -> None:
        """Drop the output that the client did not read, so that the next client does not receive it."""
        if not self.connected:
            return
        self.connected = False
        try:
            slave = os.open(self._slave_name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError:
            # The next client has the terminal open exclusively.
            return
        try:
            termios.tcflush(slave, termios.TCIOFLUSH)
            tty.setraw(slave)
        finally:
            os.close(slave)

    def poll_masks(self, *, writing: bool) -> list[tuple[int, int]]:
        """Return file descriptors with poll masks; none without a client, as the terminal then reports POLLHUP."""
        if not self.connected:
            return []
        return [(self._master, select.POLLIN | (select.POLLOUT if writing else 0))]

    @property
    def needs_polling(self) -> bool:
        """Whether `update_connection` must be called periodically: a terminal does not report that it is opened."""
        return not self.connected

    def close(self) -> None:
        """Remove the link unless another process has replaced it, then close the terminal.

        In this order: the next terminal that any program makes can have the same name.
        """
        if self._link.is_symlink() and str(self._link.readlink()) == self._slave_name:
            self._link.unlink()
        os.close(self._master)


class TcpPort:
    """A TCP port for `socket://` URLs. A new client replaces the previous one, whose connection may be dead.

    Port 0 selects a free one.

    Raises:
        PortError: The port cannot be opened.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise PortError(f"socket://{host}:{port}: {error}") from error
        self._listener.settimeout(0)
        self.connected = False
        self._client: socket.socket | None = None
        self._next_client: socket.socket | None = None
        self.device = f"socket://{host}:{self._listener.getsockname()[1]}"

    def update_connection(self) -> None:
        """Accept a new client; the previous one is reported as disconnected for one call first."""
        if self._next_client is None:
            try:
                self._next_client, _ = self._listener.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            self._next_client.settimeout(0)
            self._next_client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._client is not None:
                self._disconnect()
                return
        self._client, self._next_client = self._next_client, None
        self.connected = True

    def read(self) -> bytes:
        """Return the bytes from the client, possibly none."""
        if self._client is None:
            return b""
        try:
            data = self._client.recv(READ_BYTES)
        except (BlockingIOError, InterruptedError):
            return b""
        except OSError:
            data = b""
        if not data:
            self._disconnect()
        return data

    def write(self, data: bytes) -> int:
        """Write as many bytes as possible without blocking and return their number."""
        if self._client is None:
            return 0
        try:
            return self._client.send(data)
        except (BlockingIOError, InterruptedError):
            return 0
        except OSError:
            self._disconnect()
            return 0

    def _disconnect(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client = None
        self.connected = False

    def poll_masks(self, *, writing: bool) -> list[tuple[int, int]]:
        """Return file descriptors with the poll masks to wait for; `writing` when output is pending."""
        masks = [(self._listener.fileno(), select.POLLIN)]
        if self._client is not None:
            masks.append((self._client.fileno(), select.POLLIN | (select.POLLOUT if writing else 0)))
        return masks

    @property
    def needs_polling(self) -> bool:
        """Whether a new client waits for the next `update_connection`."""
        return self._next_client is not None

    def close(self) -> None:
        """Close the listener and the clients."""
        for each in (self._listener, self._client, self._next_client):
            if each is not None:
                each.close()
