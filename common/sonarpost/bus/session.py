"""Zenoh sessions: services are clients, hubs are routers, discovery is off."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Sequence

import zenoh

from sonarpost.bus.connectivity import ConnectivityState, probe_endpoint
from sonarpost.config import TlsConfig
from sonarpost.logs import kv
from sonarpost.security.router_config import dropped_replies

log = logging.getLogger(__name__)

OPEN_TIMEOUT_MS = (1000, 2000, 4000)
"""Time-outs of the first, second and all later attempts: TLS on a busy computer may take longer than a second."""
WAIT_BEFORE_DROP_US = 50_000
RETRY_S = (0.1, 0.2, 0.5, 1.0)
_opened: dict[str, tuple[str, TlsConfig | None]] = {}
"""Endpoint and certificate of each session, which Zenoh's sessions do not return."""


def client_config(endpoints: Sequence[str], tls: TlsConfig | None = None, attempt: int = 2) -> zenoh.Config:
    """Return the configuration of a service: a client of its platform's router.

    Args:
        endpoints: The router's endpoints.
        tls: The host's own certificate for `tls/...` endpoints, where both sides present one.
        attempt: Number of the attempt to open a session, from 0; it selects one of `OPEN_TIMEOUT_MS`.
    """
    timeout_ms = OPEN_TIMEOUT_MS[min(attempt, len(OPEN_TIMEOUT_MS) - 1)]
    connect = {"endpoints": list(endpoints), "timeout_ms": timeout_ms}
    return _config({"mode": "client", "listen": {"endpoints": []}, "connect": connect}, tls)


def router_config(listen: Sequence[str], connect: Sequence[str] = ()) -> zenoh.Config:
    """Return the configuration of an embedded router that links to the routers in `connect`.

    It has neither TLS nor access control. `sonarpost pki router-config` writes configurations with both.
    """
    settings: dict[str, object] = {
        "mode": "router",
        "listen": {"endpoints": list(listen), "timeout_ms": 0, "exit_on_failure": True},
        "connect": {
            "endpoints": list(connect),
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5},
        },
    }
    return _config(settings, None)


def _config(settings: dict[str, object], tls: TlsConfig | None) -> zenoh.Config:
    # Images are published in bursts: with a full queue, a publication waits briefly before it is dropped.
    drop = {"wait_before_drop": WAIT_BEFORE_DROP_US, "max_wait_before_drop_fragments": 2 * WAIT_BEFORE_DROP_US}
    link: dict[str, object] = {"tx": {"lease": 3000, "queue": {"congestion_control": {"drop": drop}}}}
    if tls is not None:
        link["tls"] = tls_settings(tls)
    common = {
        # Endpoints are configured: discovery could join foreign networks, and its delay would slow every start.
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        # On one host, shared memory would bypass the network link and hide its behaviour.
        "transport": {"shared_memory": {"enabled": False}, "link": link},
        "qos": dropped_replies(),
    }
    return zenoh.Config.from_json5(json.dumps(settings | common))


def tls_settings(tls: TlsConfig) -> dict[str, object]:
    """Return Zenoh's `transport/link/tls` section, which holds file paths only."""
    settings: dict[str, object] = {
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        "root_ca_certificate": str(tls.ca),
    }
    for side in ("listen", "connect"):
        settings[f"{side}_certificate"] = str(tls.certificate)
        settings[f"{side}_private_key"] = str(tls.key)
    return settings


def open_with_retry(
    endpoints: Sequence[str],
    stop: threading.Event,
    tls: TlsConfig | None = None,
    on_failure: Callable[[str], None] = lambda _reason: None,
) -> zenoh.Session | None:
    """Open a client session, trying each endpoint in turn until one opens.

    Zenoh's own endless retry cannot be interrupted by a signal and only tries the first endpoint. An open session
    reconnects to its endpoint by itself. Each new reason of a failure is logged; `on_failure` receives all of them.

    Returns:
        The session, or None if `stop` was set first.
    """
    attempt, logged = 0, set[str]()
    while not stop.is_set():
        endpoint = endpoints[attempt % len(endpoints)]
        try:
            session = zenoh.open(client_config([endpoint], tls, attempt // len(endpoints)))
        except zenoh.ZError:
            reason = _failure(endpoint, tls)
            if reason not in logged:
                log.warning("Zenoh router not reached; retrying", extra=kv(router=endpoint, error=reason))
            logged.add(reason)
            on_failure(reason)
            attempt += 1
            stop.wait(RETRY_S[min(attempt // len(endpoints), len(RETRY_S) - 1)])
        else:
            _opened[str(session.zid())] = (endpoint, tls)
            return session
    return None


def lost_reason(session: zenoh.Session) -> str:
    """Return why a session has lost its router, empty if it has not or is not of `open_with_retry`; probes."""
    opened = _opened.get(str(session.zid()))
    return "" if opened is None or session.info.routers_zid() else _failure(*opened)


def _failure(endpoint: str, tls: TlsConfig | None) -> str:
    """Return why Zenoh, which reports every cause as a time-out, does not reach a router."""
    result = probe_endpoint(endpoint, tls, is_silent=True)
    if result.state is ConnectivityState.REACHED:
        return f"no reply: {endpoint} accepts connections, but does not reply as a Zenoh router"
    return result.text
