"""What is known of every service of every platform: its last health record, when it came, and whether it lives.

`FleetTracker` holds it, with the clock as an argument; `FleetWatcher` fills it from a router. Ages are measured by the
clock of this host from the arrival of a record, never by the record's own: clocks of platforms differ.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import zenoh

from sonarpost import keys, wire
from sonarpost.bus.session import open_with_retry
from sonarpost.config import TlsConfig
from sonarpost.errors import BadInputError, PayloadError
from sonarpost.logs import kv
from sonarpost.messages import Health

log = logging.getLogger(__name__)

MAX_SERVICES: Final = 1000
"""Whoever may publish could invent names without end."""

Name = tuple[str, str]


@dataclass(frozen=True, slots=True)
class ServiceStatus:
    """What is known of one service.

    Attributes:
        platform: Its platform.
        service: Its name.
        health: Its last record, None before the first.
        age_s: Since that record came; None before the first.
        alive: Whether its liveliness token is there; None while the router is not reached.
    """

    platform: str
    service: str
    health: Health | None
    age_s: float | None
    alive: bool | None


@dataclass(frozen=True, slots=True)
class FleetState:
    """Everything known at one moment.

    Attributes:
        services: Ordered by platform and service.
        connected: Whether a router is reached.
        rejected: Records that could not be used since the start.
    """

    services: tuple[ServiceStatus, ...]
    connected: bool
    rejected: int


class FleetTracker:
    """Collects health records and tokens, from any thread.

    Args:
        forget_after_s: A service that is not alive is forgotten when nothing came from it for this long.
    """

    def __init__(self, forget_after_s: float = 3600.0) -> None:
        self._forget_after_s = forget_after_s
        self._lock = threading.Lock()
        self._health: dict[Name, Health] = {}
        self._last_s: dict[Name, float] = {}
        self._alive: frozenset[Name] = frozenset()
        self._connected = False
        self._rejected = 0

    def take(self, key: str, payload: bytes, now_s: float) -> None:
        """Take a health record; what cannot be used is logged, counted and dropped.

        Args:
            key: It came on; what it says of platform and service must agree, as nobody speaks for another.
            payload: The record.
            now_s: Time of arrival, monotonic.
        """
        try:
            name = keys.service_of(key)
            health = wire.decode(Health, payload, key)
            if (health.platform_id, health.service) != name:
                raise PayloadError(key, "platform_id, service", f"{health.platform_id}, {health.service}", str(name))
            with self._lock:
                if name not in self._last_s and len(self._last_s) >= MAX_SERVICES:
                    raise PayloadError(key, "service", name[1], f"no more than {MAX_SERVICES} services")
                self._health[name] = health
                self._last_s[name] = now_s
        except BadInputError as error:
            with self._lock:
                self._rejected += 1
            log.warning("Health record rejected", extra=kv(reason=str(error)))

    def set_alive(self, tokens: Iterable[str] | None, now_s: float) -> None:
        """Take the keys of all liveliness tokens there are; None when the router is not reached."""
        names: set[Name] = set()
        for token in tokens or ():
            try:
                names.add(keys.service_of(token))
            except BadInputError as error:
                log.debug("Token ignored", extra=kv(reason=str(error)))
        with self._lock:
            self._connected = tokens is not None
            self._alive = frozenset(sorted(names)[:MAX_SERVICES])
            for name in self._alive:
                # A service that was never heard counts from when its token was met.
                self._last_s.setdefault(name, now_s)
            for name in [n for n, last_s in self._last_s.items() if now_s - last_s > self._forget_after_s]:
                if name not in self._alive:
                    del self._last_s[name]
                    self._health.pop(name, None)

    def state(self, now_s: float) -> FleetState:
        """Return everything known at `now_s`, monotonic."""
        with self._lock:
            services = tuple(self._seen(name, now_s) for name in sorted(self._last_s))
            return FleetState(services, self._connected, self._rejected)

    def _seen(self, name: Name, now_s: float) -> ServiceStatus:
        health = self._health.get(name)
        age_s = None if health is None else max(0.0, now_s - self._last_s[name])
        return ServiceStatus(*name, health, age_s, name in self._alive if self._connected else None)


class FleetWatcher:
    """Fills a fleet from a router: subscribes to health, asks for tokens now and then, comes back after cuts.

    Args:
        endpoints: The router's, tried in turn.
        tls: Certificate, for `tls/…` endpoints.
        fleet: Where everything goes.
        poll_s: How often tokens are asked for.
    """

    def __init__(
        self,
        endpoints: Sequence[str],
        tls: TlsConfig | None = None,
        fleet: FleetTracker | None = None,
        poll_s: float = 1.0,
    ) -> None:
        self.fleet = fleet or FleetTracker()
        self._endpoints = tuple(endpoints)
        self._tls = tls
        self._poll_s = poll_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fleet", daemon=True)
        self._clock: Callable[[], float] = time.monotonic

    def __enter__(self) -> FleetWatcher:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(timeout=5.0)

    def state(self) -> FleetState:
        """Return everything known now."""
        return self.fleet.state(self._clock())

    def _run(self) -> None:
        session = open_with_retry(self._endpoints, self._stop, self._tls)
        if session is None:
            return
        # `with` closes it: a session that is only dropped keeps the process from ending.
        with session:
            session.declare_subscriber(keys.health_everywhere(), self._on_health)
            while True:
                self._ask(session)
                if self._stop.wait(self._poll_s):
                    return

    def _on_health(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self.fleet.take(str(sample.key_expr), sample.payload.to_bytes(), self._clock())

    def _ask(self, session: zenoh.Session) -> None:
        """Ask for the tokens; a token that ends while the link is cut is then found to be gone by itself."""
        try:
            tokens: list[str] | None = None
            if session.info.routers_zid():
                replies = session.liveliness().get(keys.alive_everywhere(), timeout=2.0)
                tokens = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        except zenoh.ZError as error:
            log.warning("Tokens not told", extra=kv(error=str(error)))
            tokens = None
        self.fleet.set_alive(tokens, self._clock())
