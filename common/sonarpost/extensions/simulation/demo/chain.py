"""Starts, kills, restarts and stops the processes of a chain on one host."""

import sys
from pathlib import Path
from typing import IO

from sonarpost.cli.deployment.processes import Processes
from sonarpost.config import service_packages
from sonarpost.errors import SonarpostError
from sonarpost.extensions.simulation.demo.settings import PLATFORM_OF, ChainSettings, write_config

ROUTERS = ("router-uuv", "router-vessel", "router-shore")


class ChainError(SonarpostError):
    """A process of the chain has ended unexpectedly."""


class Chain(Processes):
    """The three routers and all services, each a process; a context manager that stops all of them at its end."""

    def __init__(self, settings: ChainSettings) -> None:
        super().__init__()
        self.settings = settings
        self._logs: list[IO[bytes]] = []

    def __enter__(self) -> "Chain":
        write_config(self.settings)
        for folder in (self.settings.folder / "logs", self.settings.incoming, self.settings.channel_log.parent):
            folder.mkdir(parents=True, exist_ok=True)
        try:
            for name in (*ROUTERS, *PLATFORM_OF, *(("console",) if self.settings.console_port is not None else ())):
                self.start(name)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self, name: str) -> None:
        """Start a router or a service; its output goes to logs/NAME.log."""
        log = self._log(name).open("ab")
        self._logs.append(log)
        self.spawn(name, self.command(name), log)

    def command(self, name: str) -> list[str]:
        """Return the command of a process."""
        return [sys.executable, "-m", *self.module(name)]

    def module(self, name: str) -> tuple[str, ...]:
        """Return the module of a process and its arguments."""
        if name not in ROUTERS:
            return (service_packages()[name], "--config", str(self.settings.config_file(name)))
        ports = self.settings.router_ports
        listen: tuple[str, ...] = ("--listen", f"tcp/127.0.0.1:{ports[ROUTERS.index(name)]}")
        if name == "router-vessel":
            listen += ("--connect", f"tcp/127.0.0.1:{self.settings.shore_port_for_vessel or ports[2]}")
        return ("sonarpost.bus.router", *listen)

    def check(self) -> None:
        """Check that all processes run.

        Raises:
            ChainError: One has ended.
        """
        for name in self.names:
            if (status := self.status(name)) is not None:
                raise ChainError(f"{name} ended with status {status}; its log: {self.log_tail(name)}")

    def log_tail(self, name: str, lines: int = 5) -> str:
        """Return the last lines of the log of a process."""
        text = self._log(name).read_text(encoding="utf-8", errors="replace")
        return "\n".join(text.splitlines()[-lines:])

    def _log(self, name: str) -> Path:
        return self.settings.folder / "logs" / f"{name}.log"

    def stop(self) -> None:
        """Stop all processes: services first, then routers; one that does not stop within 5 s is killed."""
        self.stop_in_order(last=ROUTERS)
        while self._logs:
            self._logs.pop().close()
