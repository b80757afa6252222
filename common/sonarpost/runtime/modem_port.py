"""The port of a modem: a serial port or another pyserial URL, or the UDP port of a multicast group.

On a UDP port each write is one datagram, and each event a received one. All stations of the group share it.

udp://239.255.7.1:5007                       multicast on the default interface
udp://239.255.7.1:5007?interface=192.0.2.10  on the interface with this address
udp://239.255.7.1:5007?ttl=4                 through up to three routers (default: 1, this network only)
"""

from __future__ import annotations

import ipaddress
import logging
import select
import socket
import threading
from collections.abc import Callable
from typing import ClassVar, Final
from urllib.parse import parse_qsl, urlsplit

from typing_extensions import override

from sonarpost.errors import ConfigError, PortError
from sonarpost.logs import kv
from sonarpost.runtime.serial_port import ModemPort, PortEvent, PortLost, PortOpened, SerialPort

log = logging.getLogger(__name__)

UDP_SCHEME: Final = "udp://"
_READ_BYTES: Final = 8192
"""Longer datagrams are cut, and refused by the driver: its format has at most 4096 bytes."""
_POLL_S: Final = 0.2
_RETRY_S: Final = 1.0
_ANY: Final = "0.0.0.0"  # noqa: S104 - datagrams of a multicast group arrive on any interface


def open_modem_port(url: str, baud: int) -> ModemPort:
    """Return the port of a URL, not started.

    Args:
        url: `udp://group:port`, or as `SerialPort`.
        baud: Bits a second of a serial port.

    Raises:
        ConfigError: An invalid URL.
    """
    return UdpPort(url) if url.startswith(UDP_SCHEME) else SerialPort(url, baud)


class UdpPort(ModemPort):
    """A multicast group and port.

    Args:
        url: See the module.

    Raises:
        ConfigError: Not a multicast address of IPv4, or an unknown option.
    """

    STREAM: ClassVar[bool] = False

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self._group, self._interface, self._ttl = _parse(url)
        self._port: socket.socket | None = None

    @override
    def write(self, data: bytes) -> None:
        """Send one datagram to the group. See `ModemPort`."""
        opened = self._port
        if opened is None:
            raise PortError(f"{self.url}: not open ({self._error or 'not opened yet'})")
        try:
            opened.sendto(data, self._group)
        except OSError as error:
            raise PortError(f"{self.url}: cannot be written: {error}") from error

    @override
    def _run(self, on_event: Callable[[PortEvent], None], closing: threading.Event) -> None:
        while not closing.is_set():
            try:
                with self._open() as opened:
                    self._port, self._error = opened, None
                    log.info("Port open", extra=kv(port=self.url))
                    on_event(PortOpened())
                    self._read(opened, on_event, closing)
            except OSError as error:
                was_open, self._port, self._error = self._port is not None, None, str(error)
                log.warning("Port lost", extra=kv(port=self.url, reason=self._error))
                if was_open:
                    on_event(PortLost(self._error))
                closing.wait(_RETRY_S)
        self._port, self._error = None, "closed"

    def _open(self) -> socket.socket:
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM, socket.IPPROTO_UDP)
        try:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            opened.bind((self._group[0], self._group[1]))
            membership = socket.inet_aton(self._group[0]) + socket.inet_aton(self._interface)
            opened.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
            opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, self._ttl)
            opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
            if self._interface != _ANY:
                opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(self._interface))
        except OSError:
            opened.close()
            raise
        return opened

    @staticmethod
    def _read(opened: socket.socket, on_event: Callable[[PortEvent], None], closing: threading.Event) -> None:
        while not closing.is_set():
            if select.select([opened], [], [], _POLL_S)[0]:
                on_event(opened.recv(_READ_BYTES))


def _parse(url: str) -> tuple[tuple[str, int], str, int]:
    """Return group and port, interface and TTL of a URL.

    Raises:
        ConfigError: See `UdpPort`.
    """
    where, expected = "modem port", "udp://group:port with a multicast address, 224.0.0.0 to 239.255.255.255"
    try:
        parts = urlsplit(url)
        group, port = ipaddress.IPv4Address(parts.hostname or ""), parts.port
        options = dict(parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query)))
        interface = str(ipaddress.IPv4Address(options.pop("interface", _ANY)))
        ttl = int(options.pop("ttl", "1"))
    except ValueError as error:
        raise ConfigError(where, "url", url, expected) from error
    if not group.is_multicast or not port or parts.path or not 0 <= ttl <= 255:
        raise ConfigError(where, "url", url, expected)
    if options:
        raise ConfigError(where, "url", min(options), "interface or ttl")
    return (str(group), port), interface, ttl
