"""Sender of Cursor-on-Target events to a TAK endpoint: a stream over TCP or TLS, or one UDP datagram for each event.

CoT has no acknowledgement. Therefore the sender detects a connection closed by the peer before each batch, repeats an
interrupted batch from its first event, and waits for the peer before it closes a connection. A repeated event has the
same identifier and replaces the first one.
"""

from __future__ import annotations

import contextlib
import ipaddress
import select
import socket
import ssl
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from sonarpost.errors import ConfigError, PortError

MAX_DATAGRAM_BYTES: Final = 65_000
RETRY_S: Final = (0.2, 0.5, 1.0, 2.0, 5.0)
_LINGER_S: Final = 2.0
_EXPECTED: Final = "tcp://host:port, tls://host:port or udp://host:port"


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Destination of events; `scheme` is tcp, tls or udp."""

    scheme: str
    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}://{host}:{self.port}"


def parse_endpoint(text: str) -> Endpoint:
    """Parse `tcp://host:port`, `tls://…` (or `ssl://…`) or `udp://…`. UDP hosts may be multicast addresses.

    Raises:
        ConfigError: The text is not an endpoint.
    """
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise ConfigError("CoT endpoint", "", text, _EXPECTED) from error
    scheme = "tls" if parts.scheme == "ssl" else parts.scheme
    extra = parts.path or parts.query or parts.fragment or parts.username
    if scheme not in ("tcp", "tls", "udp") or not host or not port or extra:
        raise ConfigError("CoT endpoint", "", text, _EXPECTED)
    return Endpoint(scheme, host, port)


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """PEM files for `tls://`.

    Attributes:
        ca: Trusted certificate authorities; None trusts those of the operating system.
        certificate: Client certificate, if the server requires one.
        key: Private key of the client certificate, without a passphrase.
    """

    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None

    def context(self) -> ssl.SSLContext:
        """Return a TLS context that verifies the server's certificate and host name.

        Raises:
            ConfigError: A file is missing or has another format.
        """
        try:
            context = ssl.create_default_context(cafile=self.ca)
            if self.certificate is not None:
                # The callback prevents a passphrase prompt on the terminal.
                context.load_cert_chain(self.certificate, self.key, password=lambda: b"")
        except OSError as error:  # includes ssl.SSLError
            files = ", ".join(str(p) for p in (self.ca, self.certificate, self.key) if p is not None)
            raise ConfigError("CoT endpoint", "TLS", files, f"readable PEM files ({error})") from error
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        return context


def _sleep(timeout_s: float) -> bool:
    time.sleep(timeout_s)
    return False


class CotSender:
    """Sends batches of events, and connects when needed.

    Args:
        endpoint: Text for `parse_endpoint`.
        tls: PEM files for `tls://`.
        timeout_s: Time limit of a connection attempt and of each write.
        multicast_ttl: Hop limit of multicast datagrams; 1 keeps them on the local network.
        clock: Monotonic clock, seconds.
        wait: Waits between attempts, argument in seconds; returns True to stop trying. `threading.Event.wait` fits.

    Raises:
        ConfigError: The endpoint or a file of `tls` is invalid.
    """

    def __init__(
        self,
        endpoint: str,
        tls: TlsFiles | None = None,
        *,
        timeout_s: float = 5.0,
        multicast_ttl: int = 1,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[float], bool] = _sleep,
    ) -> None:
        self.endpoint = parse_endpoint(endpoint)
        self._tls = (tls or TlsFiles()).context() if self.endpoint.scheme == "tls" else None
        self._timeout_s = timeout_s
        self._multicast_ttl = multicast_ttl
        self._clock = clock
        self._wait = wait
        self._socket: socket.socket | None = None

    def __enter__(self) -> CotSender:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def send(self, events: Sequence[bytes], give_up_after_s: float = 60.0) -> None:
        """Send a batch; after an error, reconnect and send it again from its first event.

        Args:
            events: Results of `cot_event`.
            give_up_after_s: No attempt starts later than this.

        Raises:
            PortError: All attempts failed. The text names the endpoint and the last reason.
        """
        started_s = self._clock()
        attempt = 0
        while True:
            try:
                self._send_once(events)
            except OSError as error:
                self._drop()
                pause_s = RETRY_S[min(attempt, len(RETRY_S) - 1)]
                attempt += 1
                if self._clock() + pause_s - started_s > give_up_after_s or self._wait(pause_s):
                    raise PortError(f"{self.endpoint}: {len(events)} events not sent: {_reason(error)}") from error
            else:
                return

    def close(self) -> None:
        """Close the connection after the peer has read all data, or after 2 s."""
        if self._socket is None:
            return
        if self.endpoint.scheme != "udp":
            # An error here means that the peer has already closed the connection.
            with contextlib.suppress(OSError):
                self._shut_down(self._socket)
        self._drop()

    def _send_once(self, events: Sequence[bytes]) -> None:
        if self._socket is not None and self.endpoint.scheme != "udp":
            self._discard_input(self._socket)
        if self._socket is None:
            self._socket = self._connect()
        if self.endpoint.scheme != "udp":
            self._socket.sendall(b"".join(event + b"\n" for event in events))
            return
        for event in events:
            if len(event) > MAX_DATAGRAM_BYTES:
                raise PortError(f"{self.endpoint}: got an event of {len(event)} bytes, expected {MAX_DATAGRAM_BYTES}")
            self._socket.send(event)

    def _connect(self) -> socket.socket:
        host, port = self.endpoint.host, self.endpoint.port
        if self.endpoint.scheme == "udp":
            return self._open_datagram_socket(host, port)
        plain = socket.create_connection((host, port), self._timeout_s)
        if self._tls is None:
            return plain
        try:
            return self._tls.wrap_socket(plain, server_hostname=host)
        except BaseException:
            plain.close()
            raise

    def _open_datagram_socket(self, host: str, port: int) -> socket.socket:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        datagrams = socket.socket(family, socket.SOCK_DGRAM)
        if ipaddress.ip_address(str(address[0]).partition("%")[0]).is_multicast:
            level, option = (
                (socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS)
                if family == socket.AF_INET6
                else (socket.IPPROTO_IP, socket.IP_MULTICAST_TTL)
            )
            datagrams.setsockopt(level, option, self._multicast_ttl)
        try:
            datagrams.connect(address)
        except OSError:
            datagrams.close()
            raise
        return datagrams

    def _discard_input(self, connection: socket.socket) -> None:
        """Discard data from the server (events of other clients), and detect a closed connection.

        Raises:
            OSError: The connection is closed.
        """
        connection.settimeout(0.0)
        try:
            while connection.recv(65536):
                pass
        except (BlockingIOError, ssl.SSLWantReadError):
            connection.settimeout(self._timeout_s)
        else:
            raise ConnectionResetError("closed by the peer")

    def _shut_down(self, connection: socket.socket) -> None:
        """Shut down sending, and read until the peer closes.

        Closing a socket with unread data resets the connection, and the peer loses data that it has not yet read.
        """
        if isinstance(connection, ssl.SSLSocket):
            connection.settimeout(0.0)
            with contextlib.suppress(ssl.SSLError):
                # Sends close_notify. The reply is read below.
                connection.unwrap()
        connection.shutdown(socket.SHUT_WR)
        deadline_s = time.monotonic() + _LINGER_S
        while (left_s := deadline_s - time.monotonic()) > 0 and select.select([connection], [], [], left_s)[0]:
            if not connection.recv(65536):
                return

    def _drop(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _reason(error: OSError) -> str:
    return error.strerror or str(error) or type(error).__name__
