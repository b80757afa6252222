"""Sender of Cursor-on-Target events to a TAK endpoint: TCP or TLS connections, or one UDP datagram for each event.

CoT has no acknowledgement. Therefore each batch has a connection of its own, whose orderly end is the acknowledgement
(`cot_stream`), and a failed batch is sent again from its first event: a repeated event has the same identifier and
replaces the first one. A datagram is never acknowledged.
"""

from __future__ import annotations

import os
import socket
import ssl
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.serialization import BestAvailableEncryption, Encoding, PrivateFormat, pkcs12

from sonarpost.config import read_passphrase
from sonarpost.errors import ConfigError, PortError
from sonarpost.export.tak.cot_stream import SETTLE_S, RefusedError, deliver, reason_of

MAX_BATCH: Final = 500
"""Events of one connection."""
MAX_DATAGRAM_BYTES: Final = 65_000
RETRY_S: Final = (0.2, 0.5, 1.0, 2.0, 5.0)
DATAGRAMS: Final = "sent: UDP does not show whether anything has received them"
_EXPECTED: Final = "tcp://host:port, tls://host:port or udp://host:port"
_PKCS12: Final = (".p12", ".pfx")
_NO_PASSPHRASE: Final = b"-"


@dataclass(frozen=True, slots=True)
class TakEndpoint:
    """Destination of events; `scheme` is tcp, tls or udp."""

    scheme: str
    host: str
    port: int

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


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """Files for `tls://`: PEM, or PKCS#12 with a name that ends in .p12 or .pfx, as TAK servers make them.

    Attributes:
        ca: Trusted certificate authorities; None trusts those of the operating system.
        certificate: Client certificate, if the server requires one; a PKCS#12 file holds its key as well.
        key: Private key of a PEM certificate.
        passphrase_file: Passphrase of the key and of PKCS#12 files in its first line, readable by its owner only.
        server_name: Name in the server's certificate; None for the host of the endpoint.
    """

    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    passphrase_file: Path | None = None
    server_name: str | None = None

    def context(self) -> ssl.SSLContext:
        """Return a TLS context that verifies the server's certificate and its name.

        Raises:
            ConfigError: A file is missing or has another format, a key is encrypted and its passphrase missing or
                wrong, or others can read the passphrase. The message holds no secret.
        """
        passphrase = None if self.passphrase_file is None else read_passphrase(self.passphrase_file)
        asked: list[bool] = []

        def give_passphrase() -> bytes:
            asked.append(True)  # OpenSSL asks for that of an encrypted key only
            return passphrase or b""

        try:
            if self.ca is not None and self.ca.suffix in _PKCS12:
                context = ssl.create_default_context(cadata=_pem_of(self.ca, passphrase).decode() or "no certificate")
            else:
                context = ssl.create_default_context(cafile=self.ca)
            if self.certificate is not None and self.certificate.suffix in _PKCS12:
                with tempfile.NamedTemporaryFile() as file:  # OpenSSL reads files only; the key in it is encrypted
                    file.write(_pem_of(self.certificate, passphrase))
                    file.flush()
                    context.load_cert_chain(file.name, password=passphrase or _NO_PASSPHRASE)
            elif self.certificate is not None:
                context.load_cert_chain(self.certificate, self.key, give_passphrase)
        except OSError as error:  # includes ssl.SSLError
            if asked:
                raise _encrypted(self.key or self.certificate, "an encrypted key") from error
            files = ", ".join(str(p) for p in (self.ca, self.certificate, self.key) if p is not None)
            raise ConfigError("CoT endpoint", "TLS", files, f"readable PEM files ({error})") from error
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        return context


def _encrypted(path: Path | None, got: str) -> ConfigError:
    return ConfigError(str(path), "TLS", got, "no passphrase, or its passphrase in --cot-passphrase-file")


def _pem_of(path: Path, passphrase: bytes | None) -> bytes:
    """Return the certificates and the key of a PKCS#12 file; the key is encrypted with the same passphrase."""
    try:
        content = pkcs12.load_pkcs12(path.read_bytes(), passphrase)
    except (ValueError, UnsupportedAlgorithm) as error:
        raise _encrypted(path, f"an encrypted or damaged file ({error})") from error
    lock = BestAvailableEncryption(passphrase or _NO_PASSPHRASE)
    found = [entry for entry in (content.cert, *content.additional_certs) if entry is not None]
    key = b"" if content.key is None else content.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, lock)
    return key + b"".join(entry.certificate.public_bytes(Encoding.PEM) for entry in found)


def _sleep(timeout_s: float) -> bool:
    time.sleep(timeout_s)
    return False


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
        settle_s: float = SETTLE_S,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[float], bool] = _sleep,
    ) -> None:
        self.endpoint = parse_endpoint(endpoint)
        self.delivered = 0
        tls = tls or TlsFiles()
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
                is_over = isinstance(error, RefusedError) or self._clock() + pause_s - started_s > give_up_after_s
                if is_over or self._wait(pause_s):
                    counts = f"{begin} of {len(events)} events delivered"
                    raise PortError(f"{self.endpoint}: {counts}: {'; then '.join(reasons)}") from error
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
