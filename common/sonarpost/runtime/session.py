"""Zenoh sessions as sonarpost uses them: services are clients, hubs are routers, nothing is discovered by itself."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Sequence

import zenoh

from sonarpost.runtime.logs import kv

log = logging.getLogger(__name__)

OPEN_TIMEOUT_MS = 1000
RETRY_S = (0.1, 0.2, 0.5, 1.0)


def client_config(endpoints: Sequence[str]) -> zenoh.Config:
    """Return the configuration of a service: a client of its platform's router."""
    return _config("client", listen=(), connect=endpoints)


def router_config(listen: Sequence[str], connect: Sequence[str] = ()) -> zenoh.Config:
    """Return the configuration of an embedded router, linked to the routers it connects to."""
    return _config("router", listen=listen, connect=connect)


def _config(mode: str, listen: Sequence[str], connect: Sequence[str]) -> zenoh.Config:
    settings = {
        "mode": mode,
        "listen": {"endpoints": list(listen)},
        "connect": {"endpoints": list(connect), "timeout_ms": OPEN_TIMEOUT_MS},
        # Endpoints are written down: discovery would join strangers, and its delay would slow every start.
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        # Shared memory would bypass the network link on one host and hide its behaviour.
        "transport": {"shared_memory": {"enabled": False}, "link": {"tx": {"lease": 3000}}},
    }
    if mode == "router":
        settings["connect"] = {
            "endpoints": list(connect),
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5},
        }
        settings["listen"] = {"endpoints": list(listen), "timeout_ms": 0, "exit_on_failure": True}
    return zenoh.Config.from_json5(json.dumps(settings))


def open_with_retry(endpoints: Sequence[str], stop: threading.Event) -> zenoh.Session | None:
    """Open a client session, trying each endpoint in turn until one opens or `stop` is set (then None).

    The library's own endless retry cannot be interrupted by a signal and stays with the first endpoint, so the loop is
    here. Once open, the session finds back to its endpoint by itself.
    """
    attempt = 0
    while not stop.is_set():
        endpoint = endpoints[attempt % len(endpoints)]
        try:
            return zenoh.open(client_config([endpoint]))
        except zenoh.ZError as error:
            if attempt == 0:
                log.warning("Zenoh router not reached, trying again", extra=kv(router=endpoint, error=str(error)[:200]))
            attempt += 1
            stop.wait(RETRY_S[min(attempt // len(endpoints), len(RETRY_S) - 1)])
    return None
