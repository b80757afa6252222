"""Why the other side is not reached: Zenoh says "timeout" or nothing, so this tries one thing after the other.

An endpoint is tried with TCP and TLS alone, as Zenoh would; a shore by asking its processes whether they are there.
What the two say together is a `ConnectivityState`.
"""

from __future__ import annotations

import re
import socket
import ssl
import time
from dataclasses import dataclass
from enum import Enum

import zenoh

from sonarpost import keys
from sonarpost.bus import presence as hello
from sonarpost.config import TlsConfig
from sonarpost.errors import PayloadError

_ENDPOINT = re.compile(r"(?P<protocol>tcp|tls)/(?P<host>\[[^]]+\]|[^:\[\]]+):(?P<port>[0-9]{1,5})(?P<options>[?#;].*)?")
TIMEOUT_S = 3.0
# A server refuses a client's certificate after the handshake is over on the client's side (TLS 1.3).
REFUSAL_S = 0.7


class ConnectivityState(Enum):
    """How far something gets towards the other side."""

    REACHED = "reached"
    NOBODY_THERE = "nobody there"
    DENIED = "denied by access control"
    TLS_REFUSED = "TLS refused"
    NO_CONNECTION = "no connection"
    UNKNOWN = "no answer"


@dataclass(frozen=True, slots=True)
class ConnectivityResult:
    """What an attempt came to.

    Attributes:
        reach: How far it got.
        detail: What was met, for people.
    """

    reach: ConnectivityState
    detail: str = ""

    @property
    def text(self) -> str:
        """Both in one line."""
        return f"{self.reach.value}: {self.detail}" if self.detail else self.reach.value


def probe_endpoint(endpoint: str, tls: TlsConfig | None, timeout_s: float = TIMEOUT_S) -> ConnectivityResult:
    """Connect to an endpoint by TCP and, for `tls/…`, shake hands with the host's own certificate.

    Returns:
        REACHED (something listens and has not refused us), TLS_REFUSED (by us or by it, with the reason), or
        NO_CONNECTION. It takes up to `timeout_s`, and for `tls/…` at least a moment.
    """
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None:
        return ConnectivityResult(ConnectivityState.UNKNOWN, f"{endpoint} is not tcp/HOST:PORT or tls/HOST:PORT")
    host, port = match["host"].strip("[]"), int(match["port"])
    try:
        with socket.create_connection((host, port), timeout_s) as connection:
            if match["protocol"] == "tcp":
                return ConnectivityResult(ConnectivityState.REACHED, endpoint)
            return _shake_hands(connection, host, endpoint, tls)
    except (OSError, OverflowError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        return ConnectivityResult(ConnectivityState.NO_CONNECTION, f"{endpoint}: {reason}")


def _shake_hands(connection: socket.socket, host: str, endpoint: str, tls: TlsConfig | None) -> ConnectivityResult:
    if tls is None:
        return ConnectivityResult(
            ConnectivityState.TLS_REFUSED, f"{endpoint}: [platform] has no tls, so there is no certificate to show"
        )
    try:
        context = ssl.create_default_context(cafile=str(tls.ca))
        context.load_cert_chain(str(tls.certificate), str(tls.key))
        with context.wrap_socket(connection, server_hostname=host) as wrapped:
            wrapped.settimeout(REFUSAL_S)
            try:
                ended = wrapped.recv(1) == b""
            except TimeoutError:
                # Zenoh waits for our first message: nobody has refused us.
                return ConnectivityResult(ConnectivityState.REACHED, endpoint)
            detail = "closed after the handshake" if ended else "speaks before it is spoken to, no Zenoh router"
            return ConnectivityResult(ConnectivityState.TLS_REFUSED, f"{endpoint}: {detail}")
    except ssl.SSLCertVerificationError as error:
        return ConnectivityResult(
            ConnectivityState.TLS_REFUSED, f"{endpoint}: its certificate is not accepted here: {error.verify_message}"
        )
    except ssl.SSLError as error:
        return ConnectivityResult(ConnectivityState.TLS_REFUSED, f"{endpoint}: {_ssl_reason(error)}")


def _ssl_reason(error: ssl.SSLError) -> str:
    reason = (error.reason or str(error)).replace("_", " ").lower()
    if "alert" in reason:
        return f"it does not accept our certificate ({reason.partition('alert ')[2] or reason})"
    return reason


def query_presence(
    session: zenoh.Session, vessel: str, site: str = keys.SHORE, timeout_s: float = TIMEOUT_S
) -> ConnectivityResult:
    """Ask a site's processes, through the routers between, whether they are there for this vessel.

    Returns:
        REACHED (c2 answers), NOBODY_THERE (the shore's router answers, c2 does not) or UNKNOWN (nobody answers).
    """
    began = time.monotonic()
    answers: dict[str, str] = {}
    for reply in session.get(keys.hello_from_anybody(vessel, site), target=zenoh.QueryTarget.ALL, timeout=timeout_s):
        if reply.ok is None:
            continue
        try:
            answer = hello.parse(reply.ok.payload.to_bytes(), str(reply.ok.key_expr))
        except PayloadError as error:
            return ConnectivityResult(ConnectivityState.UNKNOWN, str(error))
        answers[answer.service] = answer.platform
    if "c2" in answers:
        return ConnectivityResult(ConnectivityState.REACHED, f"{answers['c2']} in {time.monotonic() - began:.3f} s")
    if answers:
        service, platform = next(iter(answers.items()))
        return ConnectivityResult(ConnectivityState.NOBODY_THERE, f"{service} of {platform} answers, c2 does not")
    return ConnectivityResult(ConnectivityState.UNKNOWN, f"nobody answers for {site}")


def diagnose_no_reply(
    asked: ConnectivityResult, endpoints: tuple[str, ...], tls: TlsConfig | None
) -> ConnectivityResult:
    """Return what an unanswered question is due to, after trying the endpoints of the routers in between."""
    if asked.reach is not ConnectivityState.UNKNOWN or not endpoints:
        return asked
    tried = [probe_endpoint(endpoint, tls) for endpoint in endpoints]
    refused = [outcome for outcome in tried if outcome.reach is ConnectivityState.TLS_REFUSED]
    reached = [outcome for outcome in tried if outcome.reach is ConnectivityState.REACHED]
    if reached:
        # sonarpost's own router answers every vessel that it lets in; zenohd does not, and then c2 may be away as well.
        detail = f"{reached[0].detail} takes our certificate and nothing comes back (with zenohd: or c2 is not there)"
        return ConnectivityResult(ConnectivityState.DENIED, detail)
    return (refused or tried)[0]
