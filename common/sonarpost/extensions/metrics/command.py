"""`sonarpost metrics`: a Prometheus exporter of the health of all platforms at a router."""

import argparse
import logging
import threading

from prometheus_client import MetricsHandler

from sonarpost import logs
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import add_router_options, log_level, option, router_of
from sonarpost.errors import PortError
from sonarpost.extensions.metrics.collector import FleetCollector, registry_of
from sonarpost.monitoring.fleet import FleetTracker, FleetWatcher
from sonarpost.network.connections import ConnectionLimits, LimitedHandler, LimitedServer
from sonarpost.stop_signals import stop_on_signals

log = logging.getLogger(__name__)

DEFAULT_PORT = 9464


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
