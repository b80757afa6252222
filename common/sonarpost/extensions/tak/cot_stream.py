"""One TCP or TLS connection that carries a batch of events to a TAK server and shows whether the server has read it.

CoT has no acknowledgement, and a successful write proves nothing: a TLS 1.3 server refuses a client only after the
client's handshake, and a server of another protocol only after it has read. The client therefore ends its side of the
connection and reads on. A server that then closes its side without a reset has read all data, because TCP resets a
connection that is closed with unread data. A server that closes first has stopped, or has refused the client.
"""

import contextlib
import fcntl
import os
import select
import socket
import ssl
import struct
import termios
from collections.abc import Callable
from typing import Final

from sonarpost.limits import limit

READ: Final = "delivered: the server has read them"
ACKNOWLEDGED: Final = "delivered: the server accepts the client, and its TCP has acknowledged them"
SETTLE_S: Final = 2.0
"""Time before the client ends a connection: TAK Server authenticates the client and parses its events in other threads,
and can drop events of a client that has left."""
EXCHANGE_S: Final = limit(
    60.0, "s", "deadlines", "CoT connection", "TAK server", "time of one connection", "its events are sent again"
)
POLL_S: Final = 0.02
_FIN_WAIT2, _CLOSE = 5, 7
"""States of TCP on Linux: the other side has acknowledged data and end; both sides have closed."""


class RefusedError(OSError):
    """The server has refused the client or uses another protocol: another attempt has the same result."""


def deliver(
    address: tuple[str, int],
    data: bytes,
    context: ssl.SSLContext | None,
    server_name: str,
    timeout_s: float,
    settle_s: float,
    clock: Callable[[], float],
) -> str:
    """Connect, write `data`, end the connection, and return what shows that the server has received all of it.

    Args:
        address: Host and port of the server.
        data: Events, each with a line feed.
        context: TLS context; None for plain TCP.
        server_name: Name that the certificate of the server must have.
        timeout_s: Limit of each wait without progress: connection, handshake, acknowledgement, end by the server.
            All of them together are limited to `EXCHANGE_S`.
        settle_s: Time between the acknowledgement of the data and the end of the connection.
        clock: Monotonic clock, seconds.

    Returns:
        `READ` or `ACKNOWLEDGED`.

    Raises:
        RefusedError: The server has refused the client, or the port has another protocol.
        OSError: The server is not reached, has closed the connection too early, or has not accepted the client.
    """
    with socket.create_connection(address, timeout_s) as connection:
        connection.settimeout(0.0)
        delivery = _Delivery(connection, timeout_s, clock)
        try:
            if context is not None:
                delivery.start_tls(context, server_name)
            return delivery.run(data, settle_s)
        except ssl.SSLError as error:
            raise _refusal(error) from error


class _Delivery:
    """One connection. TLS works on buffers: an `SSLSocket` cannot read the alert that came before a failed write."""

    def __init__(self, connection: socket.socket, timeout_s: float, clock: Callable[[], float]) -> None:
        self._connection = connection
        self._timeout_s = timeout_s
        self._clock = clock
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls: ssl.SSLObject | None = None
        self._uses_tls = False
        self._is_accepted = True
        self._unsent = memoryview(b"")
        self._head = b""
        self._has_closed = self._at_end = False
        """Whether the server has ended its data, and whether no byte follows: close_notify precedes the end of TCP."""
        self._failure: OSError | None = None
        self._left_bytes = -1
        self._limit_s = 0.0
        self._end_s = clock() + EXCHANGE_S

    def start_tls(self, context: ssl.SSLContext, server_name: str) -> None:
        self._uses_tls = True
        tls = context.wrap_bio(self._incoming, self._outgoing, server_hostname=server_name)
        while self._tls is None:
            try:
                tls.do_handshake()
                self._tls = tls
            except ssl.SSLWantReadError:
                self._unsent = memoryview(bytes(self._unsent) + self._outgoing.read())
                if not self._step() or self._at_end:
                    cause = "closed by the server" if self._at_end else f"no answer within {self._timeout_s:g} s"
                    raise OSError(f"{cause} during the TLS handshake; a port without TLS needs tcp://") from None
            except ssl.SSLError:
                with contextlib.suppress(OSError):
                    self._connection.send(self._outgoing.read())  # an alert for the server
                raise
        self._is_accepted = tls.version() != "TLSv1.3"

    def run(self, data: bytes, settle_s: float) -> str:
        if self._tls is not None and data:
            self._tls.write(data)
        self._write(data if self._tls is None else self._outgoing.read())
        settled_s = self._clock() + settle_s
        while not self._has_closed and self._clock() < settled_s:
            self._step()
        if self._has_closed:
            raise self._early_end()
        if self._tls is not None:
            self._decode(self._tls)  # nothing that has arrived may be left for the following
            with contextlib.suppress(ssl.SSLWantReadError):
                self._tls.unwrap()
            self._write(self._outgoing.read())
        try:
            self._connection.shutdown(socket.SHUT_WR)
        except OSError as error:
            self._failure = error
        self._left_bytes = -1
        while (state := self._state()) != _CLOSE or not self._at_end:
            if not self._step():
                break
        if number := self._connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            self._failure = OSError(number, os.strerror(number))
        if self._failure is not None:
            raise self._early_end()
        if not self._is_accepted or state not in (_FIN_WAIT2, _CLOSE):
            raise TimeoutError(f"the server has neither accepted nor refused the client within {self._timeout_s:g} s")
        return READ if state == _CLOSE else ACKNOWLEDGED

    def _write(self, data: bytes) -> None:
        """Write, and wait for the acknowledgement by TCP or the end by the server."""
        self._unsent = memoryview(data)
        while not self._has_closed and (self._unsent or self._unacknowledged_bytes()):
            if not self._step():
                raise TimeoutError(f"not acknowledged by the server's TCP within {self._timeout_s:g} s")

    def _step(self) -> bool:
        """Write and read what is possible, or wait for `POLL_S`; return False at a time limit."""
        readers = [] if self._at_end else [self._connection]
        readable, writable, _ = select.select(readers, [self._connection] if self._unsent else [], [], POLL_S)
        try:
            if readable:
                self._take(self._connection.recv(65536))
            if writable:
                self._unsent = self._unsent[self._connection.send(self._unsent) :]
        except (ssl.SSLError, RefusedError):
            raise
        except OSError as error:
            # What the server has sent before it closed is still to be read: it can hold the reason.
            self._failure, self._unsent = self._failure or error, memoryview(b"")
        before, self._left_bytes = self._left_bytes, len(self._unsent) + self._unacknowledged_bytes()
        if self._left_bytes != before:
            self._limit_s = self._clock() + self._timeout_s
        return self._clock() <= min(self._limit_s, self._end_s)

    def _take(self, received: bytes) -> None:
        self._at_end = not received
        self._has_closed |= self._at_end
        if not self._uses_tls:
            self._check(received)
            return
        self._incoming.write(received)
        if self._tls is not None:
            self._decode(self._tls)

    def _decode(self, tls: ssl.SSLObject) -> None:
        try:
            while not self._has_closed:
                self._has_closed = not self._check(tls.read(65536))
                self._is_accepted = True
        except ssl.SSLZeroReturnError:
            self._has_closed = self._is_accepted = True
        except ssl.SSLWantReadError:
            # A server of TLS 1.3 verifies the certificate of the client before it sends a ticket, data or its end.
            self._is_accepted |= tls.session is not None and tls.session.has_ticket

    def _check(self, received: bytes) -> bytes:
        self._head = (self._head + received)[:5]
        if self._head.startswith(b"\x15\x03"):
            raise RefusedError("refused by the server with a TLS alert: the port needs tls://")
        if self._head == b"HTTP/":
            raise RefusedError("refused by the server with an HTTP reply: not a port for CoT")
        return received

    def _state(self) -> int:
        return self._connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0]

    def _unacknowledged_bytes(self) -> int:
        size: int = struct.unpack("i", fcntl.ioctl(self._connection, termios.TIOCOUTQ, bytes(4)))[0]
        return size

    def _early_end(self) -> OSError:
        hint = "" if self._uses_tls else "; a port with TLS needs tls://"
        cause = "end of data" if self._failure is None else reason_of(self._failure)
        text = "closed by the server, which has stopped or refused the client; some events can have arrived"
        return ConnectionResetError(f"{text} ({cause}){hint}")


def _refusal(error: ssl.SSLError) -> OSError:
    if isinstance(error, ssl.SSLCertVerificationError):
        return RefusedError(f"certificate verify failed, that of the server: {error.verify_message}")
    text = (error.reason or str(error)).replace("_", " ").lower()
    if "alert " in text:
        return RefusedError("refused by the server: " + text.partition("alert ")[2].replace("unknown ca", "unknown CA"))
    return OSError(f"the server's answer is not valid TLS ({text}); a port without TLS needs tcp://")


def reason_of(error: OSError) -> str:
    """Return the text of an error without its number."""
    return error.strerror or str(error) or type(error).__name__
