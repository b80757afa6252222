"""`sonarpost run SERVICE --config FILE` and `sonarpost router`."""

from __future__ import annotations

import argparse
import runpy
import sys
from pathlib import Path

from sonarpost import logs
from sonarpost.bus import router
from sonarpost.cli.shared import Subparsers
from sonarpost.config import SERVICES


def add_parser(subparsers: Subparsers) -> None:
    """Add the subcommands."""
    run = subparsers.add_parser("run", help="run one service of the chain", description="Run one service.")
    run.add_argument("service", choices=SERVICES, help="name of the service")
    run.add_argument("--config", type=Path, required=True, help="TOML file of the platform")
    run.set_defaults(run=run_service)
    route = subparsers.add_parser("router", help="run an embedded Zenoh router", description=router.__doc__)
    router.add_arguments(route)
    route.set_defaults(run=run_router)


def run_service(parsed: argparse.Namespace) -> int:
    """Run the service's own module, as `python -m sonarpost.services.NAME` does."""
    sys.argv[1:] = ["--config", str(parsed.config)]
    runpy.run_module(f"sonarpost.services.{parsed.service}", run_name="__main__", alter_sys=True)
    return 0


def run_router(parsed: argparse.Namespace) -> int:
    """Run an embedded router."""
    logs.configure_logging("router")
    return router.run_parsed(parsed)
