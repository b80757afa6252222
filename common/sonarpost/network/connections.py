"""Limits of a server's connections: their number, and time limits for idle, slow and half-open ones."""

from __future__ import annotations

import io
import ipaddress
import logging
import math
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, ClassVar, Final

from typing_extensions import override

from sonarpost.limits import limit
from sonarpost.logs import IntervalLog, kv

log = logging.getLogger(__name__)

_SURFACE: Final = "HTTP servers"
AT_LIMIT: Final = "the connection that waits longest for its request is closed; without one, the new connection"
MAX_CONNECTIONS: Final = limit(300, "connections", "shares", _SURFACE, "all clients", "connections", AT_LIMIT)
MAX_CONNECTIONS_OF_ADDRESS: Final = limit(
    100, "connections", "shares", _SURFACE, "address", "connections of an address", AT_LIMIT
)
REQUEST_S: Final = limit(
    10.0, "s", "deadlines", _SURFACE, "client", "request with the TLS handshake", "the connection is closed"
)
READ_S: Final = limit(
    30.0, "s", "deadlines", _SURFACE, "client", "reading 64 KiB of a response", "the connection is closed"
)
MAX_REQUEST_BYTES: Final = limit(
    65536, "bytes", "claims", "webhook, metrics", "client", "head and body of a request", "the request is refused"
)
MAX_REFUSED: Final = 16
"""Refused connections that stay open until their clients have read the refusal."""
_REFUSAL: Final = b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"

IpNetwork = ipaddress.IPv4Network | ipaddress.IPv6Network
Peer = tuple[str, int]
"""Address and port of a client."""


class TrustedProxies:
    """Addresses of reverse proxies whose `X-Forwarded-For` is used.

    Args:
        networks: Addresses and networks of the proxies.
    """

    def __init__(self, networks: Iterable[IpNetwork] = ()) -> None:
        self._networks = tuple(networks)

    def __contains__(self, host: str) -> bool:
        address = _parse_address(host)
        return address is not None and any(address in network for network in self._networks)

    def client_address(self, host: str, forwarded: str) -> str:
        """Return the address of a client.

        Args:
            host: Address of the connection.
            forwarded: Value of `X-Forwarded-For`. Each proxy appends the address of its client; the client can forge
                the entries before it.
        """
        for hop in reversed(forwarded.split(",")):
            if host not in self or not hop.strip():
                break
            host = hop.strip()
        return host[:100]


def address_group(host: str) -> str:
    """Return the name under which an address is counted: the address itself, or the /64 network of an IPv6 address."""
    address = _parse_address(host)
    if isinstance(address, ipaddress.IPv6Address):
        return str(ipaddress.IPv6Network((address, 64), strict=False))
    return host if address is None else str(address)


def _parse_address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return None
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return mapped or address


@dataclass(slots=True)
class _Open:
    """An open connection; `deadline_s` (monotonic) is infinite while the server prepares a response."""

    connection: socket.socket
    group: str
    deadline_s: float


class ConnectionLimits:
    """Open connections of a server, with their deadlines; safe for several threads.

    At a limit, a new connection replaces the one that has waited longest for its request. Without such a connection,
    the new one is closed. Idle and half-open connections therefore do not keep other clients out.

    Args:
        proxies: Proxies, to which only the total limit applies.
        max_connections: Number of connections in total.
        max_of_address: Number of connections of one address; see `address_group`.
        request_s: See `REQUEST_S`.
        read_s: See `READ_S`.
        clock: Monotonic seconds.
    """

    def __init__(
        self,
        proxies: TrustedProxies | None = None,
        *,
        max_connections: int = MAX_CONNECTIONS,
        max_of_address: int = MAX_CONNECTIONS_OF_ADDRESS,
        request_s: float = REQUEST_S,
        read_s: float = READ_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._proxies = TrustedProxies() if proxies is None else proxies
        self._max_connections = max_connections
        self._max_of_address = max_of_address
        self.request_s = request_s
        self.read_s = read_s
        self._clock = clock
        self._lock = threading.RLock()
        self._open: dict[Peer, _Open] = {}
        self._log = IntervalLog(log, logging.WARNING, "Connection limit reached")

    @property
    def count(self) -> int:
        """Number of open connections."""
        return len(self._open)

    def __contains__(self, peer: object) -> bool:
        return peer in self._open

    def add(self, peer: Peer, connection: socket.socket) -> bool:
        """Add an accepted connection; return whether the limits permit it."""
        with self._lock:
            if not self._make_room(peer):
                return False
            self._open[peer] = _Open(connection, address_group(peer[0]), self._clock() + self.request_s)
            return True

    def _make_room(self, peer: Peer) -> bool:
        group = address_group(peer[0])
        of_address = [] if peer[0] in self._proxies else [one for one in self._open.values() if one.group == group]
        full: Iterable[_Open] = ()
        if len(of_address) >= self._max_of_address:
            full = of_address
        elif len(self._open) >= self._max_connections:
            full = self._open.values()
        if full:
            self._log.log(address=peer[0], open=len(self._open))
            oldest = min(full, key=lambda one: one.deadline_s)
            if oldest.deadline_s == math.inf:
                return False
            self._end(oldest)
        return True

    def remove(self, peer: Peer, connection: socket.socket) -> None:
        """Remove a closed connection."""
        with self._lock:
            if peer in self._open and self._open[peer].connection is connection:
                del self._open[peer]

    def set_deadline(self, peer: Peer, seconds: float) -> None:
        """Close a connection after this time; infinite for never. A closed connection is ignored."""
        with self._lock:
            if peer in self._open:
                self._open[peer].deadline_s = self._clock() + seconds

    def close_overdue(self) -> None:
        """Close the connections whose deadline has passed."""
        now_s = self._clock()
        with self._lock:
            for one in [one for one in self._open.values() if one.deadline_s <= now_s]:
                self._end(one)

    def _end(self, ended: _Open) -> None:
        self._open = {peer: one for peer, one in self._open.items() if one is not ended}
        try:
            # The server sees the end of the connection and closes it.
            ended.connection.shutdown(socket.SHUT_RDWR)
        except OSError as error:
            log.debug("Connection already closed", extra=kv(reason=str(error)))


class _Connection(socket.socket):
    """An accepted connection, which reports that it is closed."""

    on_close: Callable[[], None]

    @override
    def close(self) -> None:
        self.on_close()
        super().close()


class LimitedListener(socket.socket):
    """A listening socket that applies limits to the connections that it accepts, before TLS and HTTP."""

    limits: ConnectionLimits

    @override
    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection.

        Raises:
            ConnectionAbortedError: The limits do not permit it. The event loop ignores this error.
        """
        accepted, address = super().accept()
        connection = _Connection(fileno=accepted.detach())
        peer = (str(address[0]), int(address[1]))
        connection.on_close = lambda: self.limits.remove(peer, connection)
        if not self.limits.add(peer, connection):
            connection.close()
            raise ConnectionAbortedError(f"{peer[0]}: too many connections")
        # Ends connections to clients that have disappeared, for example with their radio network.
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(1000 * self.limits.read_s))
        return connection, address


class LimitedServer(ThreadingHTTPServer):
    """HTTP server with a thread for each connection, within the limits of connections.

    A connection that is refused receives the status 503. `LimitedHandler` is the base class of its handlers.

    Args:
        address: Host and port, 0 for any.
        handler: Class of the handlers.
        limits: Limits of the connections.
    """

    daemon_threads = True
    block_on_close = False

    def __init__(
        self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler], limits: ConnectionLimits
    ) -> None:
        self.limits = limits
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self._refused: deque[socket.socket] = deque()
        super().__init__(address, handler)

    @override
    def get_request(self) -> tuple[socket.socket, Any]:
        """Accept a connection.

        Raises:
            ConnectionAbortedError: The limits do not permit it; it was refused.
        """
        connection, address = super().get_request()
        if self.limits.add(address[:2], connection):
            return connection, address
        with suppress(OSError):
            connection.settimeout(0)
            connection.send(_REFUSAL)
            connection.shutdown(socket.SHUT_WR)
        # To close it at once could discard the refusal.
        self._refused.append(connection)
        if len(self._refused) > MAX_REFUSED:
            self._refused.popleft().close()
        raise ConnectionAbortedError(f"{address[0]}: too many connections")

    @override
    def service_actions(self) -> None:
        """Close the connections whose deadline has passed; called several times a second."""
        self.limits.close_overdue()

    @override
    def server_close(self) -> None:
        super().server_close()
        while self._refused:
            self._refused.popleft().close()

    @override
    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.limits.remove(client_address[:2], request)

    @override
    def handle_error(self, request: object, client_address: object) -> None:
        """Log a lost connection, or a defect of the handler."""
        error = sys.exception()
        if isinstance(error, OSError):
            log.debug("Connection lost", extra=kv(reason=str(error)))
        else:
            log.error("Connection closed after an unexpected exception", exc_info=error)


class _LimitedReader(io.RawIOBase):
    """The first bytes from a connection, up to a limit."""

    def __init__(self, connection: socket.socket, max_bytes: int) -> None:
        self._connection = connection
        self._left_bytes = max_bytes

    @override
    def readable(self) -> bool:
        return True

    @override
    def readinto(self, buffer: Any) -> int:
        count = self._connection.recv_into(memoryview(buffer)[: self._left_bytes]) if self._left_bytes else 0
        self._left_bytes -= count
        return count


class LimitedHandler(BaseHTTPRequestHandler):
    """Handler of one request of a `LimitedServer`, of at most `MAX_REQUEST_BYTES`."""

    timeout = REQUEST_S
    server_version = "sonarpost"
    sys_version = ""
    server: LimitedServer
    close_connection: bool
    max_request_bytes: ClassVar[int] = MAX_REQUEST_BYTES

    @override
    def setup(self) -> None:
        """Limit the bytes that are read."""
        super().setup()
        self.rfile = io.BufferedReader(_LimitedReader(self.connection, self.max_request_bytes))

    def set_deadline(self, seconds: float) -> None:
        """Close the connection after this time; infinite for never, while the request is handled."""
        self.server.limits.set_deadline(self.client_address[:2], seconds)

    def reply(self, status: int, text: str) -> None:
        """Send a response, and end the connection."""
        data = text.encode()
        self.set_deadline(self.server.limits.read_s)
        self.send_response(status)
        self.send_header("Content-Type", "text/plain; charset=utf-8")
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(data)
        self.close_connection = True

    @override
    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: an address can contain a token."""
