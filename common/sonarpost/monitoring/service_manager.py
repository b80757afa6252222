"""Messages to systemd (`sd_notify`): the process is ready, its state, and that it does not hang.

systemd passes the address of its socket in `NOTIFY_SOCKET` to units with `Type=notify`; without it nothing is sent.
With `WatchdogSec=`, systemd ends a process whose `alive` is not called for that time.
"""

from __future__ import annotations

import logging
import socket
from collections.abc import Mapping

from sonarpost.logs import kv

log = logging.getLogger(__name__)

SOCKET_VARIABLE = "NOTIFY_SOCKET"
WATCHDOG_VARIABLE = "WATCHDOG_USEC"
# Intervals without a call of `alive` that are not a failure: a busy host delays a call.
MISSED_INTERVALS = 3
_MAX_STATUS = 300
_SEND_S = 1.0


class ServiceManager:
    """Sender of messages to systemd.

    Args:
        environment: Variables of the process: path of systemd's socket, or `@` and the name of an abstract one, without
            which nothing is sent; time after which systemd ends a process without `alive`, by default never.
        interval_s: Interval of the calls of `alive`.
    """

    def __init__(self, environment: Mapping[str, str], interval_s: float) -> None:
        address, watchdog_us = environment.get(SOCKET_VARIABLE, ""), environment.get(WATCHDOG_VARIABLE, "")
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._watchdog_s = int(watchdog_us) / 1e6 if watchdog_us.isdecimal() else 0.0
        self._interval_s = interval_s
        self._warned = False

    def ready(self, status: str) -> None:
        """Report that the process has started. A watchdog time that is too short for the interval is extended."""
        shortest_s = MISSED_INTERVALS * self._interval_s
        extended = (f"WATCHDOG_USEC={shortest_s * 1e6:.0f}",) if 0 < self._watchdog_s < shortest_s else ()
        self._send("READY=1", f"STATUS={_one_line(status)}", *extended)

    def alive(self, status: str) -> None:
        """Report that the process does not hang, and its state."""
        self._send("WATCHDOG=1", f"STATUS={_one_line(status)}")

    def stopping(self) -> None:
        """Report that the process is stopping."""
        self._send("STOPPING=1", "STATUS=stopping")

    def _send(self, *lines: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as connection:
                connection.settimeout(_SEND_S)
                connection.sendto("\n".join(lines).encode(), self._address)
        except OSError as error:
            if not self._warned:
                log.warning("systemd not notified", extra=kv(socket=self._address, error=str(error)))
            self._warned = True


def _one_line(text: str) -> str:
    return " ".join(text.split())[:_MAX_STATUS]
