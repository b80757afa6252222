"""Sender of Cursor-on-Target events to a TAK endpoint: TCP or TLS connections, or one UDP datagram for each event.

CoT has no acknowledgement. Therefore each batch has a connection of its own, whose orderly end is the acknowledgement
(`cot_stream`), and a failed batch is sent again from its first event: a repeated event has the same identifier and
replaces the first one. A datagram is never acknowledged.
"""

import os
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final
from urllib.parse import urlsplit

from typing_extensions import override

from sonarpost.errors import ConfigError, PortError
from sonarpost.extensions.tak.cot_stream import SETTLE_S, RefusedError, deliver, reason_of
from sonarpost.security.client_tls import TlsFiles

MAX_BATCH: Final = 500
"""Events of one connection."""
MAX_DATAGRAM_BYTES: Final = 65_000
RETRY_S: Final = (0.2, 0.5, 1.0, 2.0, 5.0)
DATAGRAMS: Final = "sent: UDP does not show whether anything has received them"
_EXPECTED: Final = "tcp://host:port, tls://host:port or udp://host:port"


@dataclass(frozen=True, slots=True)
class TakEndpoint:
    """Destination of events; `scheme` is tcp, tls or udp."""

    scheme: str
    host: str
    port: int

    @override
    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}://{host}:{self.port}"


def parse_endpoint(text: str) -> TakEndpoint:
    """Parse `tcp://host:port`, `tls://…` (or `ssl://…`) or `udp://…`.

    A UDP host may be a multicast address; the hop limit of Linux, 1, keeps its datagrams on the local network.

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
    return TakEndpoint(scheme, host, port)


class CotSender:
    """Sends batches of events.

    Attributes:
        delivered: Number of events that the server has received; for `udp://`, that were sent.

    Args:
        endpoint: Text for `parse_endpoint`.
        tls: Files for `tls://`.
        timeout_s: Time limit of a connection attempt, and of each wait for progress.
        settle_s: Time between the acknowledgement of a batch by TCP and the end of its connection.
        clock: Monotonic clock, seconds.
        wait: Waits between attempts, argument in seconds.

    Raises:
        ConfigError: The endpoint or a file of `tls` is invalid.
    """

    def __init__(
        self,
        endpoint: str,
        tls: TlsFiles,
        *,
        timeout_s: float = 5.0,
        settle_s: float = SETTLE_S,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[float], object] = time.sleep,
    ) -> None:
        self.endpoint = parse_endpoint(endpoint)
        self.delivered = 0
        self._tls = tls.context() if self.endpoint.scheme == "tls" else None
        self._server_name = tls.server_name or self.endpoint.host
        self._timeout_s = timeout_s
        self._settle_s = settle_s
        self._clock = clock
        self._wait = wait

    def send(self, events: Sequence[bytes], give_up_after_s: float = 60.0) -> str:
        """Send events, at most `MAX_BATCH` in one connection; after an error, send the batch again.

        Without events the connection is made and ended, which shows whether the server accepts the client.

        Args:
            events: Results of `cot_event`.
            give_up_after_s: No attempt starts later than this.

        Returns:
            What shows that the server has received all events: `READ`, `ACKNOWLEDGED` or `DATAGRAMS`.

        Raises:
            PortError: A batch was not delivered; the text names the endpoint, the number of events delivered before it,
                and the reasons. The server can have received events of this batch. A refusal is not tried again.
        """
        started_s = self._clock()
        reasons: dict[str, None] = {}
        evidence = ""
        attempt = begin = 0
        while begin < len(events) or not evidence:
            batch = events[begin : begin + MAX_BATCH]
            try:
                evidence = self._send_once(batch)
            except OSError as error:
                reasons[reason_of(error)] = None
                pause_s = RETRY_S[min(attempt, len(RETRY_S) - 1)]
                attempt += 1
                if isinstance(error, RefusedError) or self._clock() + pause_s - started_s > give_up_after_s:
                    counts = f"{begin} of {len(events)} events delivered"
                    raise PortError(f"{self.endpoint}: {counts}: {'; then '.join(reasons)}") from error
                self._wait(pause_s)
            else:
                begin += MAX_BATCH
                self.delivered += len(batch)
        return evidence

    def _send_once(self, events: Sequence[bytes]) -> str:
        host, port = self.endpoint.host, self.endpoint.port
        if self.endpoint.scheme != "udp":
            data = b"".join(event + b"\n" for event in events)
            times = (self._timeout_s, self._settle_s, self._clock)
            return deliver((host, port), data, self._tls, self._server_name, *times)
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, socket.SOCK_DGRAM) as datagrams:
            datagrams.connect(address)
            for event in events:
                if len(event) > MAX_DATAGRAM_BYTES:
                    raise PortError(
                        f"{self.endpoint}: got an event of {len(event)} bytes, expected {MAX_DATAGRAM_BYTES}"
                    )
                datagrams.send(event)
            if number := datagrams.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                raise OSError(number, os.strerror(number))
        return DATAGRAMS
