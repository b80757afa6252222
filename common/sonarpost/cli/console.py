"""Manage the users of the console, and serve a training console."""

from __future__ import annotations

import importlib

from sonarpost.cli.shared import Subparsers


def add_parser(subparsers: Subparsers) -> None:
    """Add the subcommand."""
    # The import contract does not allow a static import of a service here.
    command = importlib.import_module("sonarpost.services.console.command")
    summary = "manage the users of the console; serve simulated contacts for training"
    parser = subparsers.add_parser("console", help=summary, description=__doc__)
    command.add_options(parser)
    parser.set_defaults(run=command.run)
