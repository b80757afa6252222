"""One HTTP request to a server outside, with a deadline for the whole exchange and a limit of the reply."""

from __future__ import annotations

import concurrent.futures
import contextlib
import http.client
import io
import socket
import ssl
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from typing_extensions import override

from sonarpost.limits import limit

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

TIMEOUT_S: Final = limit(
    10.0, "s", "deadlines", "HTTP request", "server", "exchange, with resolving the name", "the exchange has failed"
)
MAX_REPLY_BYTES: Final = limit(
    1 << 16, "bytes", "claims", "HTTP request", "server", "reply with all heads", "the exchange has failed"
)
_POLL_S: Final = 0.1


@dataclass(frozen=True, slots=True)
class Reply:
    """Reply of a server.

    Attributes:
        status: HTTP status, 200 or above.
        reason: Text of the status.
        body: Body; empty if it was not requested.
    """

    status: int
    reason: str
    body: bytes


def post(
    url: str,
    body: bytes,
    headers: Mapping[str, str],
    *,
    context: ssl.SSLContext | None = None,
    server_name: str | None = None,
    timeout_s: float = TIMEOUT_S,
    reads_body: bool = False,
    stop: threading.Event | None = None,
) -> Reply:
    """Send a POST request and return the reply. Redirections are not followed.

    Args:
        url: `https://…` or `http://…`.
        body: Body of the request.
        headers: Further headers.
        context: TLS context for `https`; None verifies with the authorities of the operating system.
        server_name: Name that the server's certificate must have; None for the host of the address.
        timeout_s: Time limit of the whole exchange.
        reads_body: Whether the body of the reply is read. Without it, the exchange ends with the head of the reply.
        stop: Ends the exchange when it is set.

    Raises:
        OSError: No complete reply before the deadline, before `stop`, or within the limit of its size. The server can
            have received the request.
    """
    parts = urlsplit(url)
    if parts.scheme == "https" and context is None:
        context = ssl.create_default_context()
    connection = _Connection(parts.hostname or "", parts.port, timeout_s, context, server_name)
    target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    future: concurrent.futures.Future[Reply] = concurrent.futures.Future()

    def exchange() -> None:
        try:
            connection.request("POST", target, body, dict(headers))
            with connection.getresponse() as reply:
                content = reply.read() if reads_body else b""
                future.set_result(Reply(reply.status, reply.reason, content))
        except http.client.HTTPException as error:
            future.set_exception(ConnectionError(f"no valid HTTP reply: {str(error) or type(error).__name__}"))
        except Exception as error:  # noqa: BLE001 raised in the thread that waits
            future.set_exception(error if isinstance(error, OSError) else ConnectionError(str(error)))
        finally:
            connection.close()

    # The resolution of a name has no time limit. The thread ends with it, or when its socket is shut down.
    threading.Thread(target=exchange, name="http", daemon=True).start()
    deadline_s = time.monotonic() + timeout_s
    while not concurrent.futures.wait([future], min(_POLL_S, timeout_s)).done:
        is_stopped = stop is not None and stop.is_set()
        if is_stopped or time.monotonic() >= deadline_s:
            connection.abort()
            raise TimeoutError("ended by a signal" if is_stopped else f"no complete reply within {timeout_s:g} s")
    return future.result()


class _Reply(http.client.HTTPResponse):
    """Reply whose heads and body are limited; `http.client` reads interim replies without a limit of their number."""

    def __init__(self, sock: socket.socket, debuglevel: int = 0, method: str | None = None) -> None:
        super().__init__(sock, debuglevel, method)
        self.fp = io.BufferedReader(_LimitedReader(self.fp.detach()))


class _LimitedReader(io.RawIOBase):
    def __init__(self, raw: io.RawIOBase) -> None:
        self._raw = raw
        self._left_bytes = MAX_REPLY_BYTES

    @override
    def readable(self) -> bool:
        return True

    @override
    def readinto(self, buffer: WriteableBuffer) -> int:
        if self._left_bytes <= 0:
            raise ConnectionError(f"reply of more than {MAX_REPLY_BYTES} bytes")
        count = self._raw.readinto(buffer) or 0
        self._left_bytes -= count
        return int(count)

    @override
    def close(self) -> None:
        self._raw.close()
        super().close()


class _Connection(http.client.HTTPConnection):
    """Connection that another thread can end, also during the TLS handshake."""

    response_class = _Reply

    def __init__(
        self, host: str, port: int | None, timeout_s: float, context: ssl.SSLContext | None, server_name: str | None
    ) -> None:
        self.default_port = 80 if context is None else 443
        super().__init__(host, port, timeout=timeout_s)
        self._context = context
        self._server_name = server_name or host
        self._connected: socket.socket | None = None
        self._is_ended = False

    @override
    def connect(self) -> None:
        self.sock = socket.create_connection((self.host, self.port), self.timeout)
        self.sock.settimeout(None)
        if self._context is not None:
            self.sock = self._context.wrap_socket(
                self.sock, server_hostname=self._server_name, do_handshake_on_connect=False
            )
        self._connected = self.sock  # http.client forgets its own before the end of some replies
        if self._is_ended:
            raise TimeoutError
        if isinstance(self.sock, ssl.SSLSocket):
            self.sock.do_handshake()

    def abort(self) -> None:
        self._is_ended = True
        if self._connected is not None:
            with contextlib.suppress(OSError):
                # Not that of SSLSocket, which would change its state while the other thread uses it.
                socket.socket.shutdown(self._connected, socket.SHUT_RDWR)
