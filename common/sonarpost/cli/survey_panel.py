"""`sonarpost survey-panel`: how well people recognise decoded pictures, by a blind forced choice."""

from __future__ import annotations

import argparse
import importlib


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    # Commands know services by name only: the console brings its own options.
    command = importlib.import_module("sonarpost.services.console.panel_command")
    summary = "how well people recognise decoded pictures: a blind forced choice"
    parser = subparsers.add_parser("survey-panel", help=summary, description=__doc__)
    command.add_options(parser)
    parser.set_defaults(run=command.run)
