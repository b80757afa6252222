"""`sonarpost console`: who may log in to the operator's page, and a page to learn on."""

from __future__ import annotations

import argparse
import importlib


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    # Commands know services by name only: the service brings its own options.
    command = importlib.import_module("sonarpost.services.console.command")
    summary = "the operator's page: users, and simulated contacts to learn on"
    parser = subparsers.add_parser("console", help=summary, description=__doc__)
    command.add_options(parser)
    parser.set_defaults(run=command.run)
