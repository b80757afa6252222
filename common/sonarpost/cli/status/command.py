"""The `sonarpost status` command."""

from __future__ import annotations

import argparse
import logging
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from types import FrameType

from rich.console import Console
from rich.live import Live

from sonarpost.cli.fleet_options import add_router_options, router_of
from sonarpost.cli.status import show
from sonarpost.cli.status.rows import is_well, rows_of
from sonarpost.errors import ConfigError
from sonarpost.monitoring.fleet import FleetState, FleetWatcher

EXIT_NOT_WELL = 1
_LOOK_S = 0.05


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "status",
        help="every service of every platform, live",
        description="Show every service of every platform on a router: state, queues, link, disk. Ctrl-C ends it.",
    )
    add_router_options(parser)
    parser.add_argument(
        "--once", action="store_true", help="print once and exit: 0 when everything is well, 1 when it is not"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object a line instead of the table")
    parser.add_argument("--interval", type=float, default=1.0, metavar="S", help="between two looks (default: 1)")
    parser.add_argument(
        "--wait",
        type=float,
        default=6.0,
        metavar="S",
        help="with --once: wait so long for everybody's health (default: 6; services tell it every 5 s)",
    )
    parser.add_argument(
        "--stale-after", type=float, default=15.0, metavar="S", help="age at which health is stale (default: 15)"
    )
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace, console: Console | None = None) -> int:
    """Show the fleet; return 0, or with --once 1 when something is not well.

    Args:
        parsed: The command line.
        console: Where to write; by default standard output.

    Raises:
        ConfigError: The router's options, or a time, are wrong.
    """
    for name in ("interval", "wait", "stale_after"):
        if not 0 < getattr(parsed, name) <= 86400:
            raise ConfigError("status", f"--{name.replace('_', '-')}", getattr(parsed, name), "above 0, to 86400")
    endpoints, tls = router_of(parsed)
    console = console or Console(highlight=False)
    with (
        _quiet(),
        _stopped_by_signals() as stop,
        FleetWatcher(endpoints, tls, poll_s=min(1.0, parsed.interval)) as watcher,
    ):
        screen = _Screen(console, parsed, ", ".join(endpoints))
        if parsed.once:
            state = _when_told(watcher, stop, parsed.wait)
            screen.print(state)
            return 0 if is_well(rows_of(state, parsed.stale_after), state) else EXIT_NOT_WELL
        if parsed.json or not console.is_terminal:
            while True:
                if stop.wait(parsed.interval):
                    return 0
                screen.print(watcher.state())
        with Live(console=console, auto_refresh=False, screen=True) as live:
            while True:
                state = watcher.state()
                live.update(show.table(state, rows_of(state, parsed.stale_after), screen.router), refresh=True)
                if stop.wait(parsed.interval):
                    return 0


class _Screen:
    """Prints a state in the form that was asked for."""

    def __init__(self, console: Console, parsed: argparse.Namespace, router: str) -> None:
        self._console = console
        self._parsed = parsed
        self.router = router

    def print(self, state: FleetState) -> None:
        rows = rows_of(state, self._parsed.stale_after)
        if self._parsed.json:
            now = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
            self._plain(show.as_json(state, rows, now))
        elif self._console.is_terminal:
            self._console.print(show.table(state, rows, self.router))
        else:
            self._plain(show.plain(state, rows, self.router))

    def _plain(self, text: str) -> None:
        # Not `print`: what is meant for other programs is neither wrapped nor coloured.
        self._console.file.write(f"{text}\n")
        self._console.file.flush()


def _when_told(watcher: FleetWatcher, stop: threading.Event, wait_s: float) -> FleetState:
    """Return the state when everybody alive has told its health, or after `wait_s`."""
    deadline_s = time.monotonic() + wait_s
    while True:
        state = watcher.state()
        told = state.connected and state.services and all(s.health or not s.alive for s in state.services)
        if told or time.monotonic() > deadline_s or stop.wait(_LOOK_S):
            return state


@contextmanager
def _quiet() -> Iterator[None]:
    """Hold back log lines, which would tear the table; it says itself what is wrong."""
    logger = logging.getLogger("sonarpost")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


@contextmanager
def _stopped_by_signals() -> Iterator[threading.Event]:
    """Give an event that SIGINT and SIGTERM set, so that the terminal is put right before the process ends."""
    stop = threading.Event()

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    before = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
