"""State of all services of all platforms: last health record, its age, and liveliness. Last status of each vehicle.

`FleetTracker` holds the state, with the time as an argument; `FleetWatcher` updates it from a router. Ages are measured
with the clock of this host from the arrival of a record, because the clocks of platforms differ.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import groupby, islice
from operator import itemgetter
from typing import Final

import zenoh

from sonarpost import keys, wire
from sonarpost.bus.session import lost_reason, open_with_retry
from sonarpost.config import TlsConfig
from sonarpost.errors import BadInputError, PayloadError
from sonarpost.limits import limit
from sonarpost.logs import IntervalLog, kv
from sonarpost.messages import Health, ReceivedStatus, VehicleRange

log = logging.getLogger(__name__)

_SURFACE: Final = "state of the fleet"
MAX_SERVICES: Final = limit(1000, "services", "shares", _SURFACE, "all platforms", "services", "others are ignored")
MAX_SERVICES_OF_PLATFORM: Final = limit(
    40, "services", "shares", _SURFACE, "platform", "its services", "others are ignored"
)
MAX_HEALTH_BYTES: Final = limit(65536, "bytes", "claims", _SURFACE, "platform", "a health record", "it is ignored")
MAX_VEHICLES: Final = limit(200, "vehicles", "shares", _SURFACE, "vessel", "its vehicles", "others are ignored")

Name = tuple[str, str]


@dataclass(frozen=True, slots=True)
class ServiceStatus:
    """State of one service.

    Attributes:
        platform: Platform of the service.
        service: Name of the service.
        health: Last health record; None before the first.
        age_s: Time since its arrival; None before the first.
        alive: Whether its liveliness token exists; None while the router is not reached.
    """

    platform: str
    service: str
    health: Health | None
    age_s: float | None
    alive: bool | None


@dataclass(frozen=True, slots=True)
class VehicleState:
    """Last status of a vehicle as a vessel received it.

    Attributes:
        received: The record.
        age_s: Time since its arrival at this host.
    """

    received: ReceivedStatus
    age_s: float


@dataclass(frozen=True, slots=True)
class FleetState:
    """State of the fleet at one moment.

    Attributes:
        services: Services, ordered by platform and name.
        connected: Whether a router is reached.
        rejected: Number of invalid records since the start.
        vehicles: Vehicles with a status since the start, ordered by vessel and name.
        ranges: Last measured distances with the time since their arrival, in the same order.
        failure: Why no router is reached, as far as it is known.
    """

    services: tuple[ServiceStatus, ...]
    connected: bool
    rejected: int
    vehicles: tuple[VehicleState, ...] = ()
    ranges: tuple[tuple[VehicleRange, float], ...] = ()
    failure: str = ""


class FleetTracker:
    """Collects health records and liveliness tokens; safe for several threads.

    Args:
        expire_after_s: Time without a record after which a service without a token is removed.
    """

    def __init__(self, expire_after_s: float = 3600.0) -> None:
        self._expire_after_s = expire_after_s
        self._lock = threading.Lock()
        self._health: dict[Name, Health] = {}
        self._last_s: dict[Name, float] = {}
        self._alive: frozenset[Name] = frozenset()
        self._vehicles: dict[Name, tuple[ReceivedStatus, float]] = {}
        self._ranges: dict[Name, tuple[VehicleRange, float]] = {}
        self._connected, self._failure = False, ""
        self._rejected = 0
        self._rejected_log = IntervalLog(log, logging.WARNING, "Record of a service or of a vehicle rejected")

    @contextmanager
    def _rejecting(self) -> Iterator[None]:
        """Log, count and drop an invalid record."""
        try:
            yield
        except BadInputError as error:
            with self._lock:
                self._rejected += 1
            self._rejected_log.log(reason=str(error)[:300])

    def add(self, key: str, payload: bytes, now_s: float) -> None:
        """Add a health record; an invalid one is logged, counted and dropped.

        Args:
            key: Key of the record; its platform and service must be those of the record.
            payload: The record.
            now_s: Time of arrival, monotonic.
        """
        with self._rejecting():
            name = keys.service_of(key)
            if len(payload) > MAX_HEALTH_BYTES:
                raise PayloadError(key, "payload", f"{len(payload)} bytes", f"at most {MAX_HEALTH_BYTES} bytes")
            health = wire.decode(Health, payload, key)
            if (health.platform_id, health.service) != name:
                raise PayloadError(key, "platform_id, service", f"{health.platform_id}, {health.service}", str(name))
            with self._lock:
                if name not in self._last_s and len(self._last_s) >= MAX_SERVICES:
                    raise PayloadError(key, "service", name[1], f"no more than {MAX_SERVICES} services")
                _check_number(key, "service", name, self._last_s, MAX_SERVICES_OF_PLATFORM)
                self._health[name] = health
                self._last_s[name] = now_s

    def add_status(self, key: str, payload: bytes, now_s: float) -> None:
        """Add the status of a vehicle; an invalid one is logged, counted and dropped.

        Args:
            key: Key of the record, on the vessel or at a shore site; its vessel must be that of the record.
            payload: The record.
            now_s: Time of arrival, monotonic.
        """
        with self._rejecting():
            record = wire.decode(ReceivedStatus, payload, key)
            at_shore = key.split("/")[-2:] == ["status", record.vessel_id]
            if key != keys.acoustic_status(record.vessel_id) and not at_shore:
                raise PayloadError(key, "vessel_id", record.vessel_id, "the vessel in the key")
            name = (record.vessel_id, record.vehicle_id)
            with self._lock:
                _check_number(key, "vehicle_id", name, self._vehicles, MAX_VEHICLES)
                known = self._vehicles.get(name)
                # At a shore site a record can arrive twice, directly and later through the relay.
                if known is None or known[0] != record:
                    self._vehicles[name] = (record, now_s)

    def add_range(self, key: str, payload: bytes, now_s: float) -> None:
        """Add the measured distance of a vehicle; an invalid one is logged, counted and dropped. As `add_status`."""
        with self._rejecting():
            record = wire.decode(VehicleRange, payload, key)
            if key != keys.acoustic_range(record.vessel_id):
                raise PayloadError(key, "vessel_id", record.vessel_id, "the vessel in the key")
            name = (record.vessel_id, record.vehicle_id)
            with self._lock:
                _check_number(key, "vehicle_id", name, self._ranges, MAX_VEHICLES)
                self._ranges[name] = (record, now_s)

    def set_alive(self, tokens: Iterable[str] | None, now_s: float, failure: str = "") -> None:
        """Set the keys of all present liveliness tokens; None if the router is not reached, with the reason."""
        names: set[Name] = set()
        for token in tokens or ():
            try:
                names.add(keys.service_of(token))
            except BadInputError as error:
                log.debug("Token ignored", extra=kv(reason=str(error)))
        with self._lock:
            self._connected, self._failure = tokens is not None, failure
            of_platforms = groupby(sorted(names), key=itemgetter(0))
            shown = [name for _, group in of_platforms for name in islice(group, MAX_SERVICES_OF_PLATFORM)]
            self._alive = frozenset(shown[:MAX_SERVICES])
            for name in self._alive:
                # The age of a service without a record counts from its token.
                self._last_s.setdefault(name, now_s)
            for name in [n for n, last_s in self._last_s.items() if now_s - last_s > self._expire_after_s]:
                if name not in self._alive:
                    del self._last_s[name]
                    self._health.pop(name, None)

    def state(self, now_s: float) -> FleetState:
        """Return the state at `now_s`, monotonic."""
        with self._lock:
            services = tuple(self._status(name, now_s) for name in sorted(self._last_s))
            statuses = [record_and_time for _, record_and_time in sorted(self._vehicles.items())]
            vehicles = tuple(VehicleState(record, max(0.0, now_s - at_s)) for record, at_s in statuses)
            ranges = tuple((record, max(0.0, now_s - at_s)) for _, (record, at_s) in sorted(self._ranges.items()))
            return FleetState(services, self._connected, self._rejected, vehicles, ranges, self._failure)

    def _status(self, name: Name, now_s: float) -> ServiceStatus:
        health = self._health.get(name)
        age_s = None if health is None else max(0.0, now_s - self._last_s[name])
        return ServiceStatus(*name, health, age_s, name in self._alive if self._connected else None)


def _check_number(key: str, field: str, name: Name, known: Collection[Name], limit_of_source: int) -> None:
    """Reject a new name of a platform or vessel that has as many as are permitted."""
    if name not in known and sum(each[0] == name[0] for each in known) >= limit_of_source:
        raise PayloadError(key, field, name[1], f"no more than {limit_of_source} of {name[0]}")


class FleetWatcher:
    """Updates a tracker from a router: subscribes to health, polls the liveliness tokens, reconnects.

    Args:
        endpoints: Endpoints of the router, tried in turn.
        tls: Certificate for `tls/...` endpoints.
        fleet: The tracker.
        poll_s: Interval of the polls.
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

    def __enter__(self) -> FleetWatcher:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(timeout=5.0)

    def state(self) -> FleetState:
        """Return the present state."""
        return self.fleet.state(time.monotonic())

    def _run(self) -> None:
        on_failure = partial(self.fleet.set_alive, None, time.monotonic())  # no service is known yet: none expires
        session = open_with_retry(self._endpoints, self._stop, self._tls, on_failure)
        if session is None:
            return
        # A session that is not closed would keep the process from exiting.
        with session:
            for key, add in (
                (keys.health_everywhere(), self.fleet.add),
                (keys.acoustic_status_everywhere(), self.fleet.add_status),
                (keys.shore_status_everywhere(), self.fleet.add_status),
                (keys.acoustic_range_everywhere(), self.fleet.add_range),
            ):
                session.declare_subscriber(key, partial(_add_sample, add))
            while True:
                self._poll(session)
                if self._stop.wait(self._poll_s):
                    return

    def _poll(self, session: zenoh.Session) -> None:
        """Query the tokens; this also finds tokens that ended during a link cut."""
        try:
            tokens: list[str] | None = None
            if session.info.routers_zid():
                replies = session.liveliness().get(keys.alive_everywhere(), timeout=2.0)
                tokens = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        except zenoh.ZError as error:
            log.warning("Liveliness tokens not received", extra=kv(error=str(error)))
            tokens = None
        self.fleet.set_alive(tokens, time.monotonic(), lost_reason(session))


def _add_sample(add: Callable[[str, bytes, float], None], sample: zenoh.Sample) -> None:
    if sample.kind == zenoh.SampleKind.PUT:
        add(str(sample.key_expr), sample.payload.to_bytes(), time.monotonic())
