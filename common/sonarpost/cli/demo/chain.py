"""Starts, kills, restarts and stops the processes of a chain on one host."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from typing import IO

from sonarpost.cli.demo.settings import PLATFORM_OF, ChainSettings, write_config
from sonarpost.errors import SonarpostError
from sonarpost.stop_signals import EXIT_WITH_PARENT

STOP_S = 5.0
ROUTERS = ("router-uuv", "router-vessel", "router-shore")


class ChainError(SonarpostError):
    """A process of the chain has ended unexpectedly."""


class Chain:
    """The three routers and all services, each a process; a context manager that stops all of them at its end."""

    def __init__(self, settings: ChainSettings) -> None:
        self.settings = settings
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._logs: list[IO[bytes]] = []

    def __enter__(self) -> Chain:
        write_config(self.settings)
        for folder in (self.settings.folder / "logs", self.settings.incoming, self.settings.channel_log.parent):
            folder.mkdir(parents=True, exist_ok=True)
        try:
            page = () if self.settings.console_port is None else ("console",)
            for name in (*ROUTERS, *PLATFORM_OF, *page):
                self.start(name)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all processes that were started."""
        return tuple(self._processes)

    def pid(self, name: str) -> int:
        """Process identifier of a process."""
        return self._processes[name].pid

    def start(self, name: str) -> None:
        """Start a router or a service; its output goes to logs/NAME.log."""
        log = (self.settings.folder / "logs" / f"{name}.log").open("ab")
        self._logs.append(log)
        # If this process is killed, the child processes end too.
        environment = {**os.environ, EXIT_WITH_PARENT: str(os.getpid())}
        self._processes[name] = subprocess.Popen(  # noqa: S603 our own interpreter and modules
            self.command(name),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=environment,
            # Ctrl-C reaches this process only, which stops the services in order.
            process_group=0,
        )

    def command(self, name: str) -> list[str]:
        """Return the command of a process."""
        return [sys.executable, "-m", *self.module(name)]

    def kill(self, name: str) -> None:
        """End a process at once (SIGKILL), as a power cut would."""
        self._processes[name].kill()
        self._processes[name].wait()

    def terminate(self, name: str) -> float:
        """Stop a process (SIGTERM); return the seconds it took."""
        started = time.monotonic()
        self._processes[name].send_signal(signal.SIGTERM)
        self._processes[name].wait(timeout=STOP_S)
        return time.monotonic() - started

    def status(self, name: str) -> int | None:
        """Return the exit status of a process, None while it runs."""
        return self._processes[name].poll()

    def check(self) -> None:
        """Check that all processes run.

        Raises:
            ChainError: One has ended.
        """
        for name, process in self._processes.items():
            if process.poll() is not None:
                raise ChainError(f"{name} ended with status {process.returncode}; its log: {self.log_tail(name)}")

    def log_tail(self, name: str, lines: int = 5) -> str:
        """Return the last lines of the log of a process."""
        path = self.settings.folder / "logs" / f"{name}.log"
        text = path.read_text(encoding="utf-8", errors="replace")
        return "\n".join(text.splitlines()[-lines:])

    def stop(self) -> None:
        """Stop all processes: services first, then routers; one that does not stop within 5 s is killed."""
        for group in (tuple(n for n in self._processes if n not in ROUTERS), ROUTERS):
            running = [self._processes[n] for n in group if n in self._processes and self._processes[n].poll() is None]
            for process in running:
                process.terminate()
            deadline = time.monotonic() + STOP_S
            for process in running:
                try:
                    process.wait(timeout=max(0.0, deadline - time.monotonic()))
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
        for log in self._logs:
            log.close()
        self._logs.clear()

    def module(self, name: str) -> tuple[str, ...]:
        """Return the module of a process and its arguments."""
        if name not in ROUTERS:
            return (f"sonarpost.services.{name}", "--config", str(self.settings.config_file(name)))
        uuv, vessel, shore = (f"tcp/127.0.0.1:{port}" for port in self.settings.router_ports)
        listen = {"router-uuv": uuv, "router-vessel": vessel, "router-shore": shore}[name]
        link: tuple[str, ...] = ()
        if name == "router-vessel":
            port = self.settings.shore_port_for_vessel or self.settings.router_ports[2]
            link = ("--connect", f"tcp/127.0.0.1:{port}")
        return ("sonarpost.bus.router", "--listen", listen, *link)
