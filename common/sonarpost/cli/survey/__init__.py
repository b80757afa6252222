"""`sonarpost survey`: describe, draw and export recordings."""

from __future__ import annotations

import argparse

from sonarpost.cli.survey import export, info, plot


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its actions."""
    parser = subparsers.add_parser("survey", help="describe, draw and export recordings of side-scan sonars")

    def show_help(_: argparse.Namespace) -> int:
        parser.print_help()
        return 0

    parser.set_defaults(run=show_help)
    actions = parser.add_subparsers(metavar="ACTION")
    for module in (info, plot, export):
        module.add_action(actions)
