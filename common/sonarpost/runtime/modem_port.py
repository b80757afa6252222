"""The port of a modem: a serial port or another pyserial URL, or UDP datagrams."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol

from sonarpost.runtime.serial_port import PortEvent, SerialPort
from sonarpost.runtime.udp_port import UdpPort

UDP_SCHEME: Final = "udp://"


class ModemPort(Protocol):
    """What a `ModemRunner` needs of a port; see `SerialPort`."""

    @property
    def url(self) -> str:
        """Name of the port."""

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""

    @property
    def error(self) -> str | None:
        """Why the port is not open; None while it is open, and before the first attempt."""

    def start(self, on_event: Callable[[PortEvent], None]) -> None:
        """Start to open and read the port; returns at once."""

    def write(self, data: bytes) -> None:
        """Write all of `data`, on a datagram port as one datagram."""

    def close(self) -> None:
        """Close the port and end its thread."""


def open_modem_port(url: str, baud: int) -> ModemPort:
    """Return the port of a URL, not started.

    Args:
        url: `udp://group:port`, or as `SerialPort`.
        baud: Bits a second of a serial port.

    Raises:
        ConfigError: An invalid URL.
    """
    return UdpPort(url) if url.startswith(UDP_SCHEME) else SerialPort(url, baud)
