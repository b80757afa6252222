"""Health of a fleet as Prometheus metrics. `docs/explanation/operations.md` lists the names.

One exporter reads the health records of all platforms that a router reaches. Services need no listening port, vehicles
no Prometheus, and the radio link carries no additional data.
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
"""Limit of the counters, and of the gauges, of one service."""
_NAME: Final = re.compile(r"[a-z_][a-z0-9_]{0,79}")
# Suffixes with a special meaning in exposition formats.
_RESERVED: Final = re.compile(r"_(total|created|bucket|count|sum|info)$")
_OWN: Final = frozenset({"up", "state", "started_time_seconds", "health_time_seconds", "health_age_seconds"})


class FleetCollector(Collector):
    """Collector that creates the metrics of a fleet at each scrape.

    Args:
        state: Returns the present state.
        stale_after_s: Age of the last health record after which counters and gauges of a service are omitted.
            `sonarpost_up` and `sonarpost_health_age_seconds`, which alerts use, remain until the service expires.
    """

    def __init__(self, state: Callable[[], FleetState], stale_after_s: float = 30.0) -> None:
        self._state = state
        self._stale_after_s = stale_after_s

    def describe(self) -> Iterable[Metric]:
        """Return nothing: the names are known after the first records."""
        return ()

    def collect(self) -> Iterable[Metric]:
        """Return all metrics."""
        state = self._state()
        yield GaugeMetricFamily(
            "sonarpost_exporter_router_connected",
            "1 while the exporter reaches its router",
            value=float(state.connected),
        )
        yield CounterMetricFamily("sonarpost_exporter_records_rejected", "Invalid health records", value=state.rejected)
        yield self._up(state.services)
        age = GaugeMetricFamily(
            "sonarpost_health_age_seconds", "Time since the arrival of the last health record", labels=LABELS
        )
        for status in state.services:
            if status.age_s is not None:
                age.add_metric((status.platform, status.service), status.age_s)
        yield age
        fresh = [s for s in state.services if s.health is not None and (s.age_s or 0.0) <= self._stale_after_s]
        yield from self._record_metrics(fresh)

    def _up(self, services: Iterable[ServiceStatus]) -> Metric:
        up = GaugeMetricFamily("sonarpost_up", "1 while the service's liveliness token exists", labels=LABELS)
        for status in services:
            # Unknown without a router: no series rather than a wrong one.
            if status.alive is not None:
                up.add_metric((status.platform, status.service), float(status.alive))
        return up

    def _record_metrics(self, services: Sequence[ServiceStatus]) -> Iterable[Metric]:
        state = GaugeMetricFamily(
            "sonarpost_state", "1 for the present state of the service", labels=(*LABELS, "state")
        )
        started = GaugeMetricFamily("sonarpost_started_time_seconds", "Start of the process, Unix time", labels=LABELS)
        sent = GaugeMetricFamily(
            "sonarpost_health_time_seconds", "Time in the last health record, by the platform's clock", labels=LABELS
        )
        for status in services:
            health, labels = status.health, (status.platform, status.service)
            assert health is not None
            for name in STATES:
                state.add_metric((*labels, name), float(health.state == name))
            started.add_metric(labels, health.started_utc_s)
            sent.add_metric(labels, health.time_utc_s)
        yield from (state, started, sent)
        yield from _values(services)


def _values(services: Iterable[ServiceStatus]) -> Iterable[Metric]:
    """Return one metric for each counter and gauge; the counter if a name is both."""
    counters: dict[str, CounterMetricFamily] = {}
    gauges: dict[str, GaugeMetricFamily] = {}
    for status in services:
        assert status.health is not None
        labels = (status.platform, status.service)
        for name, count in _usable(status.health.counters):
            counters.setdefault(name, _counter(name)).add_metric(labels, count)
        for name, value in _usable(status.health.gauges):
            gauges.setdefault(name, _gauge(name)).add_metric(labels, value)
    yield from counters.values()
    yield from (gauge for name, gauge in gauges.items() if name not in counters)


def _usable(values: Mapping[str, float]) -> Iterable[tuple[str, float]]:
    """Return the values with valid metric names."""
    usable = ((n, v) for n, v in values.items() if _NAME.fullmatch(n) and not _RESERVED.search(n) and n not in _OWN)
    return sorted(usable)[:MAX_VALUES]


def _counter(name: str) -> CounterMetricFamily:
    return CounterMetricFamily(f"sonarpost_{name}", "Events since the service started", labels=LABELS)


def _gauge(name: str) -> GaugeMetricFamily:
    return GaugeMetricFamily(f"sonarpost_{name}", "Value in the last health record", labels=LABELS)


def registry_of(collector: FleetCollector) -> CollectorRegistry:
    """Return a registry with this collector only, without metrics of the exporter process."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(collector)
    return registry
