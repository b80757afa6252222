"""An embedded Zenoh router as a process, for hosts without a `zenohd`: the demo, tests, small deployments."""

from __future__ import annotations

import argparse
import logging
import signal
import sys
import threading
from collections.abc import Sequence
from types import FrameType

import zenoh

from sonarpost.runtime import logs
from sonarpost.runtime.process import exit_with_parent
from sonarpost.runtime.session import router_config

log = logging.getLogger(__name__)

EXIT_NO_LISTENER = 2


def run(listen: Sequence[str], connect: Sequence[str]) -> int:
    """Route until SIGTERM or SIGINT; return the exit status (2: cannot listen)."""
    stop = threading.Event()

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, on_signal)
    try:
        session = zenoh.open(router_config(listen, connect))
    except zenoh.ZError as error:
        log.error("Router cannot start", extra=logs.kv(listen=", ".join(listen), error=str(error)))
        return EXIT_NO_LISTENER
    log.info("Router started", extra=logs.kv(listen=", ".join(listen), connect=", ".join(connect)))
    stop.wait()
    session.close()
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run with `python -m sonarpost.runtime.router --listen ENDPOINT… [--connect ENDPOINT…]`."""
    parser = argparse.ArgumentParser(prog="python -m sonarpost.runtime.router", description=__doc__)
    add_arguments(parser)
    parsed = parser.parse_args(arguments)
    exit_with_parent()
    logs.set_up("router")
    return run(parsed.listen, parsed.connect)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the router's options to a parser."""
    parser.add_argument("--listen", nargs="+", default=["tcp/127.0.0.1:7447"], metavar="ENDPOINT")
    parser.add_argument("--connect", nargs="*", default=[], metavar="ENDPOINT", help="routers to link to")


if __name__ == "__main__":
    sys.exit(main())
