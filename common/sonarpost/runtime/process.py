"""Main function of a service process: command line, signals, exit status."""

from __future__ import annotations

import argparse
import gc
import logging
import os
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from sonarpost import config, logs
from sonarpost.errors import ConfigError, SonarpostError
from sonarpost.files import PRIVATE_UMASK
from sonarpost.runtime.service import C, Service
from sonarpost.stop_signals import END_S, exit_with_parent, signals_to

log = logging.getLogger(__name__)

SHUTDOWN_S = 2.5
GARBAGE_THRESHOLD = 10_000
"""Number of new objects after which garbage is collected; the default of 700 is exceeded by every batch of records."""
SWITCH_INTERVAL_S = 0.0005
"""Time after which a thread that waits for the interpreter gets it; the default is 5 ms."""
EXIT_FAILURE = 1
EXIT_CONFIG = 2
EXIT_STUCK = 3


def main(service_type: type[Service[C]], config_type: type[C], arguments: Sequence[str] | None = None) -> int:
    """Run a service until SIGTERM or SIGINT; return the exit status (2: invalid configuration).

    Args:
        service_type: Class of the service.
        config_type: Type of its configuration table.
        arguments: Command line; by default that of the process.
    """
    # Stores, images and logs hold positions: only the user of the service can read what it creates.
    os.umask(PRIVATE_UMASK)
    parser = argparse.ArgumentParser(prog=f"sonarpost run {service_type.NAME}", description=service_type.__doc__)
    parser.add_argument("--config", type=Path, required=True, help="TOML file of the platform")
    path: Path = parser.parse_args(arguments).config
    try:
        platform, own = config.load(path, service_type.NAME, config_type, os.environ)
    except ConfigError as error:
        print(f"{service_type.NAME}: {error}", file=sys.stderr)
        return EXIT_CONFIG
    exit_with_parent()
    logs.configure_logging(service_type.NAME, platform.log_level, platform.log_format)
    if overridden := config.overridden_keys(service_type.NAME, os.environ):
        log.info("Configuration overridden by environment", extra=logs.kv(keys=", ".join(overridden)))
    try:
        service = service_type(platform, own)
    except SonarpostError as error:
        log.error("Service cannot start", extra=logs.kv(reason=str(error)))
        return EXIT_CONFIG
    return _run(service)


def _run(service: Service[C]) -> int:
    guard = threading.Timer(SHUTDOWN_S, _exit_at_once)
    guard.daemon = True
    is_first = threading.Lock()

    def on_signal(number: signal.Signals) -> None:
        service.stopping.set()
        end_later()
        log.info("Stopping", extra=logs.kv(signal=number.name))

    def end_later() -> None:
        # The alarm of the system ends a process that cannot run Python code, or cannot write its log.
        signal.setitimer(signal.ITIMER_REAL, END_S)
        if is_first.acquire(blocking=False):
            guard.start()

    with signals_to(on_signal):
        try:
            if service.start():
                tune_interpreter()
                service.stopping.wait()
        except (OSError, SonarpostError) as error:
            log.error("Service cannot start", extra=logs.kv(reason=str(error)))
            service.failed = True
        finally:
            end_later()
            service.stop()
            guard.cancel()
    return EXIT_FAILURE if service.failed else 0


def tune_interpreter() -> None:
    """Exclude the present objects, which stay, from garbage collection, and collect new ones less often; share time.

    Called after the start of a service. Its records are freed by their reference counts; only cycles wait longer.
    Threads take turns more often: a sender does not wait while its next records are prepared.
    """
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    gc.set_threshold(GARBAGE_THRESHOLD)


def _exit_at_once() -> None:
    """End a process whose shutdown hangs; all accepted records are on the disk."""
    log.error("Shutdown timed out; exiting")
    logging.shutdown()
    os._exit(EXIT_STUCK)
