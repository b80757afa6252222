"""Limits of connections: their number in total and by address, and time limits for idle, slow and half-open ones."""

from __future__ import annotations

import ipaddress
import logging
import math
import socket
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Final

from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from sonarpost.logs import IntervalLog, kv

log = logging.getLogger(__name__)

MAX_CONNECTIONS: Final = 300
MAX_CONNECTIONS_OF_ADDRESS: Final = 100
REQUEST_S: Final = 10.0
"""Time for the TLS handshake, the head and the body of a request, counted from the connection or the last response."""
READ_S: Final = 30.0
"""Time in which a client has to read `CHUNK_BYTES` of a response."""
CHUNK_BYTES: Final = 65536
CHECK_INTERVAL_S: Final = 1

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
    """Open connections of a server, with their deadlines. All methods are called in the thread of the server.

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
        self._open[peer] = _Open(connection, group, self._clock() + self.request_s)
        return True

    def remove(self, peer: Peer, connection: socket.socket) -> None:
        """Remove a closed connection."""
        if peer in self._open and self._open[peer].connection is connection:
            del self._open[peer]

    def set_deadline(self, peer: Peer, seconds: float) -> None:
        """Close a connection after this time; infinite for never. A closed connection is ignored."""
        if peer in self._open:
            self._open[peer].deadline_s = self._clock() + seconds

    async def close_overdue(self) -> None:
        """Close the connections whose deadline has passed."""
        now_s = self._clock()
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

    def close(self) -> None:
        self.on_close()
        super().close()


class LimitedListener(socket.socket):
    """A listening socket that applies limits to the connections that it accepts, before TLS and HTTP."""

    limits: ConnectionLimits

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


class ConnectionDeadlines:
    """ASGI middleware that sets the deadlines of connections.

    A client has `request_s` to send a request, and `read_s` to read each chunk of the response. While the server
    prepares a response, and between the events of a stream, there is no deadline.

    Args:
        app: The application.
        limits: The open connections.
    """

    def __init__(self, app: ASGIApp, limits: ConnectionLimits) -> None:
        self._app = app
        self._limits = limits

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limits, peer = self._limits, scope["client"]
        if peer not in limits:
            # The connection was closed for another one, and its address is unknown.
            response = PlainTextResponse("too many connections", 503, {"Connection": "close"})
            await response(scope, receive, send)
            return

        async def receive_in_time() -> Message:
            message = await receive()
            if not message.get("more_body", False):
                limits.set_deadline(peer, math.inf)
            return message

        async def send_in_time(message: Message) -> None:
            for part in _parts(message):
                limits.set_deadline(peer, limits.read_s)
                await send(part)
            limits.set_deadline(peer, math.inf)

        if scope["method"] in ("GET", "HEAD"):
            limits.set_deadline(peer, math.inf)
        try:
            await self._app(scope, receive_in_time, send_in_time)
        finally:
            limits.set_deadline(peer, limits.request_s)


def _parts(message: Message) -> Iterable[Message]:
    """Split the body of a response: the server waits for the client only between messages."""
    body = message.get("body", b"")
    if message["type"] != "http.response.body" or len(body) <= CHUNK_BYTES:
        yield message
        return
    for start in range(0, len(body), CHUNK_BYTES):
        yield {**message, "body": bytes(body[start : start + CHUNK_BYTES]), "more_body": True}
    yield {**message, "body": b""}
