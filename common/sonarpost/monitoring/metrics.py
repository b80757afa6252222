"""Health of a fleet as Prometheus metrics. `docs/explanation/operations.md` lists the names.

One exporter reads the health records of every platform that a router reaches: services need no listening port, a
vehicle no Prometheus, and what is scraped is what the radio link carries anyway.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from sonarpost.monitoring.fleet import FleetState, ServiceStatus

LABELS: Final = ("platform", "service")
STATES: Final = ("starting", "ok", "degraded", "stopping")
MAX_VALUES: Final = 200
"""Counters, and gauges, of one service: a record could name any number of them."""
_NAME: Final = re.compile(r"[a-z_][a-z0-9_]{0,79}")
# Endings that exposition formats give a meaning of their own.
_RESERVED: Final = re.compile(r"_(total|created|bucket|count|sum|info)$")
_OWN: Final = frozenset({"up", "state", "started_time_seconds", "health_time_seconds", "health_age_seconds"})


class FleetCollector(Collector):
    """Makes the metrics of a fleet anew at each scrape, so that no series outlives what it says.

    Args:
        state: What is known now.
        stale_after_s: Counters and gauges of a service end when its last health record is this old. `sonarpost_up` and
            `sonarpost_health_age_seconds` stay until the fleet forgets the service: they are what an alert asks.
    """

    def __init__(self, state: Callable[[], FleetState], stale_after_s: float = 30.0) -> None:
        self._state = state
        self._stale_after_s = stale_after_s

    def describe(self) -> Iterable[Metric]:
        """Return nothing: names are known when records come."""
        return ()

    def collect(self) -> Iterable[Metric]:
        """Return every metric."""
        state = self._state()
        yield GaugeMetricFamily(
            "sonarpost_exporter_router_connected",
            "1 while the exporter reaches its router",
            value=float(state.connected),
        )
        yield CounterMetricFamily(
            "sonarpost_exporter_records_rejected", "Health records that could not be used", value=state.rejected
        )
        yield self._up(state.services)
        age = GaugeMetricFamily("sonarpost_health_age_seconds", "Since the last health record came", labels=LABELS)
        for seen in state.services:
            if seen.age_s is not None:
                age.add_metric((seen.platform, seen.service), seen.age_s)
        yield age
        fresh = [s for s in state.services if s.health is not None and (s.age_s or 0.0) <= self._stale_after_s]
        yield from self._of_the_records(fresh)

    def _up(self, services: Iterable[ServiceStatus]) -> Metric:
        up = GaugeMetricFamily("sonarpost_up", "1 while the service's liveliness token is there", labels=LABELS)
        for seen in services:
            # Without a router nothing is known: no series rather than a wrong one.
            if seen.alive is not None:
                up.add_metric((seen.platform, seen.service), float(seen.alive))
        return up

    def _of_the_records(self, services: Sequence[ServiceStatus]) -> Iterable[Metric]:
        state = GaugeMetricFamily("sonarpost_state", "1 for the state the service is in", labels=(*LABELS, "state"))
        started = GaugeMetricFamily("sonarpost_started_time_seconds", "Start of the process, Unix time", labels=LABELS)
        said = GaugeMetricFamily(
            "sonarpost_health_time_seconds", "Time in the last health record, by the platform's clock", labels=LABELS
        )
        for seen in services:
            health, labels = seen.health, (seen.platform, seen.service)
            assert health is not None
            for name in STATES:
                state.add_metric((*labels, name), float(health.state == name))
            started.add_metric(labels, health.started_utc_s)
            said.add_metric(labels, health.time_utc_s)
        yield from (state, started, said)
        yield from _values(services)


def _values(services: Iterable[ServiceStatus]) -> Iterable[Metric]:
    """Return one metric a counter and a gauge; where a name is both, the counter."""
    counters: dict[str, CounterMetricFamily] = {}
    gauges: dict[str, GaugeMetricFamily] = {}
    for seen in services:
        assert seen.health is not None
        labels = (seen.platform, seen.service)
        for name, count in _usable(seen.health.counters):
            counters.setdefault(name, _counter(name)).add_metric(labels, count)
        for name, value in _usable(seen.health.gauges):
            gauges.setdefault(name, _gauge(name)).add_metric(labels, value)
    yield from counters.values()
    yield from (gauge for name, gauge in gauges.items() if name not in counters)


def _usable(values: Mapping[str, float]) -> Iterable[tuple[str, float]]:
    """Return the values whose names can be metrics."""
    good = ((n, v) for n, v in values.items() if _NAME.fullmatch(n) and not _RESERVED.search(n) and n not in _OWN)
    return sorted(good)[:MAX_VALUES]


def _counter(name: str) -> CounterMetricFamily:
    return CounterMetricFamily(f"sonarpost_{name}", "Events since the service started", labels=LABELS)


def _gauge(name: str) -> GaugeMetricFamily:
    return GaugeMetricFamily(f"sonarpost_{name}", "Value in the last health record", labels=LABELS)


def registry_of(collector: FleetCollector) -> CollectorRegistry:
    """Return a registry with this collector and nothing of the exporter's own process."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(collector)
    return registry
