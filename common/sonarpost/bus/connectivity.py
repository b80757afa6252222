"""Connectivity of a vessel to its shore sites, with the reason when a site is not reached.

Zenoh reports a refused connection as a time-out, and a message denied by access control not at all. This module
therefore queries the processes of a site for their presence and, without a reply, probes the routers on the way with
plain TCP and TLS.
"""

from __future__ import annotations

import logging
import re
import socket
import ssl
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Annotated

import msgpack
import zenoh
from pydantic import BaseModel, ConfigDict, Field

from sonarpost import keys, wire
from sonarpost.config import TlsConfig
from sonarpost.errors import BadInputError, PayloadError
from sonarpost.logs import kv

log = logging.getLogger(__name__)

TIMEOUT_S = 3.0
# With TLS 1.3, a server refuses the client's certificate after the handshake has ended on the client's side.
TLS_REFUSAL_S = 0.7
# A presence query costs some hundred bytes of the radio link.
PROBE_INTERVAL_REACHED_S = 120.0
PROBE_INTERVAL_NOT_REACHED_S = (2.0, 5.0, 15.0, 30.0)
_ENDPOINT = re.compile(r"(?P<protocol>tcp|tls)/(?P<host>\[[^]]+\]|[^:\[\]]+):(?P<port>[0-9]{1,5})(?P<options>[?#;].*)?")


class ConnectivityState(Enum):
    """Result of an attempt to reach a site or an endpoint."""

    REACHED = "reached"
    NO_C2 = "c2 not running"
    DENIED = "denied by access control"
    TLS_REFUSED = "TLS refused"
    NO_CONNECTION = "no connection"
    NO_REPLY = "no reply"


# Faults that a person has to correct: a wrong certificate or access control list.
FAULTS = (ConnectivityState.TLS_REFUSED, ConnectivityState.DENIED)


@dataclass(frozen=True, slots=True)
class ConnectivityResult:
    """Result of an attempt, with details for people."""

    state: ConnectivityState
    detail: str = ""

    @property
    def text(self) -> str:
        """State and detail in one line."""
        return f"{self.state.value}: {self.detail}" if self.detail else self.state.value


# Presence


class PresenceReply(BaseModel):
    """Reply to a presence query: a running process of a platform."""

    model_config = ConfigDict(frozen=True, strict=True)

    v: Annotated[int, Field(ge=1, le=1)]
    platform: Annotated[str, Field(min_length=1, max_length=40)]
    service: Annotated[str, Field(min_length=1, max_length=40)]

    def pack(self) -> bytes:
        """Return the reply as msgpack."""
        packed: bytes = msgpack.packb(self.model_dump())
        return packed


def declare_presence(
    session: zenoh.Session, platform: str, service: str, site: str = keys.SHORE
) -> zenoh.Queryable[None]:
    """Reply to presence queries of every vessel until the session closes or the queryable is undeclared.

    A vessel queries a key below its own prefix, which access control treats as it treats the vessel's records. A reply
    therefore shows that routers, certificates and access control let the records pass.
    """
    payload = PresenceReply(v=1, platform=platform, service=service).pack()

    def on_query(query: zenoh.Query) -> None:
        # The key is `.../inbox/{vessel}/hello/{service or *}`.
        vessel = str(query.key_expr).split("/")[-3]
        try:
            with query:
                query.reply(keys.presence(vessel, service, site), payload)
        except (zenoh.ZError, BadInputError) as error:
            log.debug("Presence reply not sent", extra=kv(key=str(query.key_expr), error=str(error)))

    return session.declare_queryable(keys.presence_all_vessels(service, site), on_query)


def query_presence(session: zenoh.Session, vessel: str, site: str = keys.SHORE) -> ConnectivityResult:
    """Query the processes of a site through the routers between.

    Returns:
        REACHED (c2 replies), NO_C2 (the router of the shore replies, c2 does not) or NO_REPLY.
    """
    began_s = time.monotonic()
    platforms: dict[str, str] = {}
    for reply in session.get(keys.presence_any(vessel, site), target=zenoh.QueryTarget.ALL, timeout=TIMEOUT_S):
        if reply.ok is None:
            continue
        try:
            where = str(reply.ok.key_expr)
            presence = wire.validated(PresenceReply, wire.unpack_map(reply.ok.payload.to_bytes(), where), where)
        except PayloadError as error:
            return ConnectivityResult(ConnectivityState.NO_REPLY, str(error))
        platforms[presence.service] = presence.platform
    if "c2" in platforms:
        took_s = time.monotonic() - began_s
        return ConnectivityResult(ConnectivityState.REACHED, f"{platforms['c2']} in {took_s:.3f} s")
    if platforms:
        service, platform = next(iter(platforms.items()))
        return ConnectivityResult(ConnectivityState.NO_C2, f"{service} of {platform} replies, c2 does not")
    return ConnectivityResult(ConnectivityState.NO_REPLY, f"no reply from {site}")


# Endpoints


def probe_endpoint(endpoint: str, tls: TlsConfig | None, *, is_silent: bool = False) -> ConnectivityResult:
    """Connect to an endpoint by TCP and, for `tls/...`, with the host's own certificate.

    With `is_silent`, of an endpoint that does not reply to Zenoh, the port of `tcp/...` is checked for TLS.

    Returns:
        REACHED (a listener has accepted the connection), TLS_REFUSED (by either side, with the reason), NO_CONNECTION,
        or NO_REPLY for an unsupported endpoint. Takes at most about 3 s for each address of the host.
    """
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None:
        return ConnectivityResult(ConnectivityState.NO_REPLY, f"{endpoint} is not tcp/HOST:PORT or tls/HOST:PORT")
    host, port = match["host"].strip("[]"), int(match["port"])
    try:
        with socket.create_connection((host, port), TIMEOUT_S) as connection:
            refused = _probe_tls(connection, host, tls) if match["protocol"] == "tls" else ""
            if is_silent and match["protocol"] == "tcp" and _expects_tls(connection):
                refused = "the port expects TLS: tls/..."
    except (OSError, OverflowError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        if "handshake operation timed out" in reason:
            reason = "no reply to the TLS handshake; a port without TLS is tcp/..."
        if isinstance(error, FileNotFoundError):
            reason = f"a certificate file of this host is missing ({reason})"
        return ConnectivityResult(ConnectivityState.NO_CONNECTION, f"{endpoint}: {reason}")
    if refused:
        return ConnectivityResult(ConnectivityState.TLS_REFUSED, f"{endpoint}: {refused}")
    return ConnectivityResult(ConnectivityState.REACHED, endpoint)


def _probe_tls(connection: socket.socket, host: str, tls: TlsConfig | None) -> str:
    """Return why TLS is refused, empty if it is not."""
    if tls is None:
        return "[platform] has no tls, so there is no certificate to present"
    try:
        context = ssl.create_default_context(cafile=str(tls.ca))
        context.load_cert_chain(str(tls.certificate), str(tls.key))
        with context.wrap_socket(connection, server_hostname=host) as wrapped:
            wrapped.settimeout(TLS_REFUSAL_S)
            try:
                closed = wrapped.recv(1) == b""
            except TimeoutError:
                return ""  # Zenoh waits for the first message of the client: the certificate was accepted.
            return "closed after the handshake" if closed else "sends data first, so it is not a Zenoh router"
    except ssl.SSLCertVerificationError as error:
        return f"its certificate is not accepted here: {error.verify_message}"
    except ssl.SSLError as error:
        reason = (error.reason or str(error)).replace("_", " ").lower()
        if "alert" in reason:
            return f"it does not accept our certificate ({reason.partition('alert ')[2] or reason})"
        return reason


def _expects_tls(connection: socket.socket) -> bool:
    """Return whether a TLS server replies, with any certificate."""
    connection.settimeout(TLS_REFUSAL_S)
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).wrap_socket(connection, server_hostname="localhost").close()
    except OSError as error:
        return isinstance(error, ssl.SSLCertVerificationError)
    return True


def diagnose_no_reply(
    result: ConnectivityResult, endpoints: Sequence[str], tls: TlsConfig | None
) -> ConnectivityResult:
    """Return the cause of a missing reply by probing the routers on the way; other results are returned unchanged."""
    if result.state is not ConnectivityState.NO_REPLY or not endpoints:
        return result
    probes = [probe_endpoint(endpoint, tls, is_silent=True) for endpoint in endpoints]
    for probe in probes:
        if probe.state is ConnectivityState.REACHED:
            # The embedded router replies to every vessel that it admits; zenohd does not, so c2 can be down as well.
            detail = f"{probe.detail} accepts our certificate, but no reply arrives (with zenohd: or c2 is not running)"
            return ConnectivityResult(ConnectivityState.DENIED, detail)
    return next((probe for probe in probes if probe.state is ConnectivityState.TLS_REFUSED), probes[0])


# Monitor


@dataclass(frozen=True, slots=True)
class MonitoredSite:
    """A site whose connectivity is monitored.

    Attributes:
        name: Name of the site in keys.
        session: Returns the session that leads to it, None while it is not open.
        endpoints: Routers on the way that this host or its router connects to; probed when no reply arrives.
    """

    name: str
    session: Callable[[], zenoh.Session | None]
    endpoints: tuple[str, ...] = ()


class SiteMonitor:
    """Checks the connectivity to every site periodically and reports changes in log and health.

    Args:
        vessel: The platform that queries.
        sites: The sites.
        tls: The host's own certificate.
    """

    def __init__(self, vessel: str, sites: Sequence[MonitoredSite], tls: TlsConfig | None) -> None:
        self._vessel = vessel
        self._sites = sites
        self._tls = tls
        self._lock = threading.Lock()
        self._results: dict[str, ConnectivityResult] = {}

    def run(self, stop: threading.Event) -> None:
        """Check all sites repeatedly until `stop` is set."""
        failures = 0
        while not stop.is_set():
            for site in self._sites:
                if stop.is_set():
                    return
                self.update(site.name, self.check(site))
            if not self._texts(lambda state: state is not ConnectivityState.REACHED):
                failures = 0
                stop.wait(PROBE_INTERVAL_REACHED_S)
            else:
                stop.wait(PROBE_INTERVAL_NOT_REACHED_S[min(failures, len(PROBE_INTERVAL_NOT_REACHED_S) - 1)])
                failures += 1

    def check(self, site: MonitoredSite) -> ConnectivityResult:
        """Check one site: query its presence and, without a reply, probe the routers on the way."""
        session = site.session()
        if session is None:
            result = ConnectivityResult(ConnectivityState.NO_REPLY, "router of the site not reached")
        else:
            try:
                result = query_presence(session, self._vessel, site.name)
            except zenoh.ZError as error:
                result = ConnectivityResult(ConnectivityState.NO_REPLY, str(error)[:200])
        return diagnose_no_reply(result, site.endpoints, self._tls)

    def update(self, name: str, result: ConnectivityResult) -> None:
        """Store a site's result; log it if the state has changed. A state is in the log before it is in the health."""
        with self._lock:
            before = self._results.get(name)
            if before is None or before.state is not result.state:
                self._log_change(name, result)
            self._results[name] = result

    @staticmethod
    def _log_change(name: str, result: ConnectivityResult) -> None:
        if result.state is ConnectivityState.REACHED:
            log.info("Shore reached", extra=kv(site=name, by=result.detail))
        else:
            log.warning("Shore not reached", extra=kv(site=name, reason=result.state.value, detail=result.detail))

    def degraded_reason(self) -> str:
        """Return the faults that a person has to correct, empty for none."""
        return self._texts(lambda state: state in FAULTS)

    def warning(self) -> str:
        """Return the sites that are not reached for another reason, empty for none."""
        return self._texts(lambda state: state not in FAULTS and state is not ConnectivityState.REACHED)

    def gauges(self) -> Mapping[str, float]:
        """Return for each checked site whether it was reached: 1 or 0."""
        with self._lock:
            return {f"reached_{n}": float(r.state is ConnectivityState.REACHED) for n, r in self._results.items()}

    def _texts(self, selected: Callable[[ConnectivityState], bool]) -> str:
        with self._lock:
            return "; ".join(f"{n}: {r.text}" for n, r in self._results.items() if selected(r.state))
