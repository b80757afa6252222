"""`sonarpost metrics`: a Prometheus exporter of the health of all platforms at a router.

One exporter reads the health records of all platforms that a router reaches. Services need no listening port, vehicles
no Prometheus, and the radio link carries no additional data. `docs/explanation/operations.md` lists the names.
"""

import argparse
import logging
import re
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final

from prometheus_client import CollectorRegistry, MetricsHandler
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from typing_extensions import override

from sonarpost import logs
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import add_router_options, log_level, option, router_of
from sonarpost.errors import PortError
from sonarpost.messages import Health
from sonarpost.monitoring.fleet import FleetState, FleetTracker, FleetWatcher, ServiceStatus
from sonarpost.network.connections import ConnectionLimits, LimitedHandler, LimitedServer
from sonarpost.stop_signals import stop_on_signals

log = logging.getLogger(__name__)

DEFAULT_PORT = 9464
LABELS: Final = ("platform", "service")
STATES: Final = ("starting", "ok", "degraded", "stopping")
MAX_VALUES: Final = 200
"""Limit of the counters, and of the gauges, of one service."""
_NAME: Final = re.compile(r"[a-z_][a-z0-9_]{0,79}")
# Suffixes with a special meaning in exposition formats.
_RESERVED: Final = re.compile(r"_(total|created|bucket|count|sum|info)$")
_OWN: Final = frozenset({"up", "state", "started_time_seconds", "health_time_seconds", "health_age_seconds"})


def add_options(parser: CommandParser) -> None:
    """Add the subcommand."""
    parser.description = (
        "Serve http://ADDRESS:PORT/metrics with the health of all services of all platforms at a router."
    )
    add_router_options(parser)
    option(parser, "--address", "address to listen on", default="127.0.0.1")
    option(parser, "--port", "port to listen on", int, DEFAULT_PORT)
    option(parser, "--stale-after S", "age of a health record at which its values are removed", float, 30.0)
    option(parser, "--forget-after S", "time after which all metrics of a stopped service are removed", float, 3600.0)
    option(parser, "--log-format", "format of log lines", default="text", choices=("text", "json"))
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Serve until SIGTERM or SIGINT."""
    endpoints, tls = router_of(parsed)
    logs.configure_logging("metrics", log_level(parsed), log_format=parsed.log_format)
    with stop_on_signals() as stop:
        watcher = FleetWatcher(endpoints, tls, FleetTracker(parsed.forget_after))
        registry = registry_of(FleetCollector(watcher.state, parsed.stale_after))
        try:
            handler = type("Handler", (LimitedHandler, MetricsHandler.factory(registry)), {})
            server = LimitedServer((parsed.address, parsed.port), handler, ConnectionLimits())
        except (OSError, OverflowError) as error:
            raise PortError(f"{parsed.address}:{parsed.port}: {error}") from error
        thread = threading.Thread(target=server.serve_forever, args=(0.2,), name="metrics", daemon=True)
        thread.start()
        try:
            with watcher:
                fields = logs.kv(address=parsed.address, port=server.server_port, router=", ".join(endpoints))
                log.info("Metrics server started", extra=fields)
                stop.wait()
        finally:
            server.shutdown()
            server.server_close()
            thread.join(timeout=5.0)
    return 0


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

    @override
    def collect(self) -> Iterable[Metric]:
        state = self._state()
        connected = float(state.connected)
        yield GaugeMetricFamily(
            "sonarpost_exporter_router_connected", "1 while the exporter reaches its router", value=connected
        )
        yield CounterMetricFamily("sonarpost_exporter_records_rejected", "Invalid health records", value=state.rejected)
        # Unknown without a router: no series rather than a wrong one.
        alive = ((_labels(s), float(s.alive)) for s in state.services if s.alive is not None)
        yield _gauge("up", "1 while the service's liveliness token exists", alive)
        ages = ((_labels(s), s.age_s) for s in state.services if s.age_s is not None)
        yield _gauge("health_age_seconds", "Time since the arrival of the last health record", ages)
        fresh = {_labels(s): s.health for s in state.services if s.health and (s.age_s or 0.0) <= self._stale_after_s}
        states = [((*key, name), float(health.state == name)) for key, health in fresh.items() for name in STATES]
        yield _gauge("state", "1 for the present state of the service", states, (*LABELS, "state"))
        started = ((key, health.started_utc_s) for key, health in fresh.items())
        yield _gauge("started_time_seconds", "Start of the process, Unix time", started)
        sent = ((key, health.time_utc_s) for key, health in fresh.items())
        yield _gauge("health_time_seconds", "Time in the last health record, by the platform's clock", sent)
        yield from _values(fresh)


def _labels(status: ServiceStatus) -> tuple[str, str]:
    return status.platform, status.service


def _gauge(
    name: str, text: str, values: Iterable[tuple[Sequence[str], float]] = (), labels: Sequence[str] = LABELS
) -> GaugeMetricFamily:
    gauge = GaugeMetricFamily(f"sonarpost_{name}", text, labels=labels)
    for label_values, value in values:
        gauge.add_metric(label_values, value)
    return gauge


def _values(services: Mapping[tuple[str, str], Health]) -> Iterable[Metric]:
    """Return one metric for each counter and gauge; the counter if a name is both."""
    counters: dict[str, CounterMetricFamily] = {}
    gauges: dict[str, GaugeMetricFamily] = {}
    for labels, health in services.items():
        for name, count in _usable(health.counters):
            if name not in counters:
                text = "Events since the service started"
                counters[name] = CounterMetricFamily(f"sonarpost_{name}", text, labels=LABELS)
            counters[name].add_metric(labels, count)
        for name, value in _usable(health.gauges):
            gauges.setdefault(name, _gauge(name, "Value in the last health record")).add_metric(labels, value)
    yield from counters.values()
    yield from (gauge for name, gauge in gauges.items() if name not in counters)


def _usable(values: Mapping[str, float]) -> Iterable[tuple[str, float]]:
    """Return the values with valid metric names."""
    usable = ((n, v) for n, v in values.items() if _NAME.fullmatch(n) and not _RESERVED.search(n) and n not in _OWN)
    return sorted(usable)[:MAX_VALUES]


def registry_of(collector: FleetCollector) -> CollectorRegistry:
    """Return a registry with this collector only, without metrics of the exporter process."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(collector)
    return registry
