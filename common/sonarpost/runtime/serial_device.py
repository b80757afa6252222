"""Opens serial devices exclusively: a device in use is reported with the program that uses it."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
import logging
import os
import socket
import termios
from pathlib import Path

import serial

from sonarpost.logs import kv

log = logging.getLogger(__name__)

IN_USE = "in use by "
_PTY_MAJORS = range(136, 144)


def open_port(port: serial.Serial) -> None:
    """Open the port of a pyserial URL; line settings and buffers of a device in use are not changed.

    The lock (`flock`) stops every user's programs that lock as well. `TIOCEXCL` stops all programs of unprivileged
    users; a pseudo-terminal would keep it after the end of a killed program.

    Raises:
        OSError, ValueError, termios.error: It cannot be opened; `IN_USE` begins the text if another program has it.
    """
    device = Path(str(port.port))
    port.exclusive = True
    try:
        port.open()
    except OSError as error:  # SerialException is an OSError
        if error.errno in (errno.EBUSY, errno.EWOULDBLOCK):
            raise OSError(IN_USE + _program_on(device)) from error
        raise
    if device.is_char_device() and os.major(device.stat().st_rdev) not in _PTY_MAJORS:
        fcntl.ioctl(port.fileno(), termios.TIOCEXCL)


def close_port(port: serial.Serial) -> None:
    """Close a port, also one that is lost."""
    # pyserial 3.5 does not close a socket whose shutdown fails because the peer has reset it.
    connection = getattr(port, "_socket", None)
    try:
        port.close()
    except OSError as error:
        log.debug("Error while closing", extra=kv(port=port.port, error=str(error)))
    if isinstance(connection, socket.socket):
        connection.close()


def _program_on(device: Path) -> str:
    """Return name and process number of the program that has a device, as far as Linux shows them to this user."""
    with contextlib.suppress(OSError, IndexError):
        path, file = os.path.realpath(device), device.stat()
        lock = f"{os.major(file.st_dev):02x}:{os.minor(file.st_dev):02x}:{file.st_ino}"
        # All users can read who holds a lock; the open files of other users' processes are hidden.
        locks = map(str.split, Path("/proc/locks").read_text().splitlines())
        numbers = [fields[fields.index(lock) - 1] for fields in locks if lock in fields]
        for link in () if numbers else glob.iglob("/proc/[0-9]*/fd/*"):  # noqa: PTH207  Path.glob may raise
            with contextlib.suppress(OSError):  # closed, or of another user
                numbers += [link.split("/")[2]] if os.path.realpath(link) == path else []
        name = Path("/proc", numbers[0], "comm").read_text(errors="replace")
        return f"{''.join(filter(str.isprintable, name))} (process {numbers[0]})"
    return "another program"
