"""`sonarpost run SERVICE --config FILE`, `sonarpost run all --config FILE` and `sonarpost router`."""

import argparse
import json
import os
import re
import runpy
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from sonarpost import logs
from sonarpost.bus import router
from sonarpost.bus.connectivity import ConnectivityState, probe_endpoint
from sonarpost.cli.deployment.config_files import EXIT_INVALID, check_file, print_problems
from sonarpost.cli.deployment.processes import STOP_S, Processes
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import add_survey_options, log_level, option, survey_options_of
from sonarpost.config import ENVIRONMENT_PREFIX, PlatformConfig, service_packages
from sonarpost.errors import ConfigError
from sonarpost.monitoring.heartbeat import VARIABLE as HEARTBEAT_VARIABLE
from sonarpost.monitoring.service_manager import SOCKET_VARIABLE
from sonarpost.stop_signals import stop_on_signals

ROUTER = "router"
FIRST_RESTART_S = 1.0
LAST_RESTART_S = 60.0
STABLE_S = 60.0
"""A process that has run for this time is restarted without a longer wait."""
ROUTER_START_S = 10.0
_POLL_S = 0.1
_LOOPBACK = re.compile(r"tcp/(127\.[0-9.]+|localhost|\[::1\]):[0-9]+")

_DESCRIPTION = """Run one service until Ctrl-C, or all services that have a table in the file: a test on a bench needs
one terminal for each platform. With all, an embedded router is started as well if `router` names an endpoint of this
host on which no router listens. Each line of the output begins with the name of its process. A process that ends is
restarted after 1, 2, 4, ... 60 s; one that ends with status 2, an invalid configuration, stops all. For operation use
systemd (`sonarpost install-units`)."""


def add_run(parser: CommandParser) -> None:
    """Add the options of `run`."""
    parser.description = _DESCRIPTION
    option(parser, "service", "name of the service, or all", choices=("all", *service_packages()))
    option(parser, "--config FILE", "TOML file of the platform", Path, required=True)
    add_survey_options(parser)
    option(
        parser,
        "--router-config FILE",
        "with all: JSON5 file of the router (default: it listens on the endpoints of `router` and connects to "
        "those of `upstream`)",
        Path,
    )
    option(
        parser,
        "--listen ENDPOINT",
        "with all: another endpoint of the router, for example tcp/0.0.0.0:7448 for the vessels of a shore site",
        default=[],
        action="append",
    )
    parser.set_defaults(run=run_service)


def add_router(parser: CommandParser) -> None:
    """Add the options of `router`."""
    parser.description = router.__doc__
    router.add_arguments(parser)
    parser.set_defaults(run=run_router)


def run_service(parsed: argparse.Namespace) -> int:
    """Run the service's own package, as `python -m PACKAGE` does, or all services.

    Raises:
        ConfigError: Invalid survey options, or options for another service than the given one.
    """
    os.environ.update(_survey_overrides(parsed))
    if parsed.service == "all":
        return _run_all(parsed)
    if parsed.router_config is not None or parsed.listen:
        raise ConfigError("command line", "--router-config or --listen", parsed.service, "the service all")
    sys.argv[1:] = ["--config", str(parsed.config)]
    runpy.run_module(service_packages()[parsed.service], run_name="__main__", alter_sys=True)
    return 0


def _survey_overrides(parsed: argparse.Namespace) -> dict[str, str]:
    """Return --options and --crs as environment variables, which override the configuration file."""
    given = parsed.options or parsed.crs
    if given is None:
        return {}
    if parsed.service not in ("atd_stub", "all"):
        raise ConfigError(f"run {parsed.service}", "--options, --crs", given, "survey options for atd_stub only")
    crs = survey_options_of(parsed).projected_crs
    values = {"SURVEY_OPTIONS": parsed.options, "PROJECTED_CRS": crs}
    return {
        f"{ENVIRONMENT_PREFIX}ATD_STUB__{name}": json.dumps(str(v), ensure_ascii=False)
        for name, v in values.items()
        if v is not None
    }


def run_router(parsed: argparse.Namespace) -> int:
    """Run an embedded router."""
    logs.configure_logging("router", log_level(parsed))
    return router.run_parsed(parsed)


def _run_all(parsed: argparse.Namespace) -> int:
    """Run all services with a table in the file until Ctrl-C.

    Returns:
        0 after Ctrl-C or SIGTERM; 2 if the configuration is invalid, or a process has refused to start (status 2).
    """
    checked = check_file(parsed.config, os.environ)
    print_problems(checked)
    if checked.errors:
        return EXIT_INVALID
    assert checked.platform is not None
    packages = service_packages()
    modules = {name: [packages[name], "--config", str(parsed.config)] for name in checked.services}
    module_of_router = router_module(checked.platform, parsed.router_config, parsed.listen)
    with stop_on_signals(exit_after_s=2 * STOP_S) as stop:
        supervisor = Supervisor(stop, width=max(map(len, (ROUTER, *modules))))
        try:
            if module_of_router is not None:
                supervisor.start(ROUTER, module_of_router)
                supervisor.wait_for_router(checked.platform)
            else:
                endpoints = ", ".join(checked.platform.router)
                supervisor.print_line(ROUTER, f"not started: {endpoints} has a router already, or is on another host")
            for name, module in modules.items():
                supervisor.start(name, module)
            return supervisor.supervise()
        finally:
            supervisor.stop()


def router_module(platform: PlatformConfig, config: Path | None, listen: Sequence[str]) -> list[str] | None:
    """Return module and arguments of the router; None if one is running or another host has it.

    Args:
        platform: The `[platform]` table.
        config: JSON5 file of the router.
        listen: Endpoints in addition to `router` of the table.

    Raises:
        ConfigError: The router needs certificates, so it needs a file.
    """
    local = [endpoint for endpoint in platform.router if _LOOPBACK.fullmatch(endpoint)]
    if not local and config is None:
        return None
    if probe_endpoint((local or platform.router)[0], platform.tls).state is ConnectivityState.REACHED:
        return None
    if config is not None:
        endpoints = ["--listen", *platform.router, *listen] if listen else []
        return ["sonarpost.bus.router", "--config", str(config), *endpoints]
    if any(endpoint.startswith("tls/") for endpoint in (*platform.upstream, *listen)):
        expected = "--router-config FILE for a router with certificates (sonarpost pki router-config writes it)"
        raise ConfigError("command line", "--router-config", "nothing", expected)
    connect = ["--connect", *platform.upstream] if platform.upstream else []
    return ["sonarpost.bus.router", "--listen", *local, *listen, *connect]


class Supervisor:
    """Starts processes, prints their output with their names, and restarts those that end.

    Args:
        stop: Ends the supervision.
        width: Width of the names in the output.
    """

    def __init__(self, stop: threading.Event, width: int) -> None:
        self._stop = stop
        self._width = width
        self._processes = Processes()
        self._modules: dict[str, Sequence[str]] = {}
        self._started_s: dict[str, float] = {}
        self._wait_s: dict[str, float] = {}
        self._restart_at_s: dict[str, float] = {}
        self._readers: list[threading.Thread] = []
        # A heartbeat file and the messages to systemd belong to one process.
        shared = (HEARTBEAT_VARIABLE, SOCKET_VARIABLE)
        self._environment = {name: value for name, value in os.environ.items() if name not in shared}

    def start(self, name: str, module: Sequence[str]) -> None:
        """Start a process.

        Args:
            name: Name of the service, or of the router.
            module: Its module and arguments.
        """
        self._modules[name] = module
        self._started_s[name] = time.monotonic()
        process = self._processes.spawn(name, [sys.executable, "-m", *module], subprocess.PIPE, self._environment)
        assert process.stdout is not None
        reader = threading.Thread(target=self._copy_lines, args=(name, process.stdout), daemon=True)
        self._readers.append(reader)
        reader.start()

    def wait_for_router(self, platform: PlatformConfig) -> None:
        """Wait until the router listens: without it, every service would log a warning."""
        deadline_s = time.monotonic() + ROUTER_START_S
        while time.monotonic() < deadline_s and not self._stop.is_set() and self._processes.status(ROUTER) is None:
            if probe_endpoint(platform.router[0], platform.tls).state is ConnectivityState.REACHED:
                return
            self._stop.wait(_POLL_S)

    def supervise(self) -> int:
        """Restart processes that end, until `stop` is set; return 2 once a process has ended with status 2."""
        while not self._stop.wait(_POLL_S):
            now_s = time.monotonic()
            for name in self._processes.names:
                status = self._processes.status(name)
                if status == EXIT_INVALID:
                    self.print_line(
                        name, "ended with status 2: its configuration or its store is invalid; stopping all"
                    )
                    return EXIT_INVALID
                if status is None:
                    continue
                if name not in self._restart_at_s:
                    self._schedule_restart(name, status, now_s)
                elif now_s >= self._restart_at_s[name]:
                    del self._restart_at_s[name]
                    self.start(name, self._modules[name])
        return 0

    def stop(self) -> None:
        """Stop all services, then the router, and print the rest of their output."""
        self._processes.stop_in_order(last=(ROUTER,))
        for reader in self._readers:
            reader.join(timeout=1.0)

    def _schedule_restart(self, name: str, status: int, now_s: float) -> None:
        is_stable = now_s - self._started_s[name] >= STABLE_S
        wait_s = FIRST_RESTART_S if is_stable else self._wait_s.get(name, FIRST_RESTART_S)
        self._wait_s[name] = min(2 * wait_s, LAST_RESTART_S)
        self._restart_at_s[name] = now_s + wait_s
        self.print_line(name, f"ended with status {status}; restarting in {wait_s:.0f} s")

    def _copy_lines(self, name: str, output: IO[bytes]) -> None:
        with output:
            for line in output:
                self.print_line(name, line.decode(errors="replace").rstrip("\r\n"))

    def print_line(self, name: str, line: str) -> None:
        """Print a line of a process."""
        try:
            # One write: the lines of several processes do not mix.
            sys.stdout.write(f"{name:{self._width}} | {line}\n")
            sys.stdout.flush()
        except BrokenPipeError:
            self._stop.set()
