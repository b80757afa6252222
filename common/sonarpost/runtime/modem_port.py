"""The port of a modem: a serial port or another pyserial URL, or UDP datagrams."""

from __future__ import annotations

from typing import Final

from sonarpost.runtime.serial_port import ModemPort, SerialPort
from sonarpost.runtime.udp_port import UdpPort

UDP_SCHEME: Final = "udp://"


def open_modem_port(url: str, baud: int) -> ModemPort:
    """Return the port of a URL, not started.

    Args:
        url: `udp://group:port`, or as `SerialPort`.
        baud: Bits a second of a serial port.

    Raises:
        ConfigError: An invalid URL.
    """
    return UdpPort(url) if url.startswith(UDP_SCHEME) else SerialPort(url, baud)
