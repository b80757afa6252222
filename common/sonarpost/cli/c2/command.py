"""The actions of `sonarpost c2`."""

from __future__ import annotations

import argparse

from sonarpost.cli.c2 import advise, export, get, ls, watch


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its actions."""
    parser = subparsers.add_parser("c2", help="see, fetch, export and answer what a shore site has accepted")

    def show_help(_: argparse.Namespace) -> int:
        parser.print_help()
        return 0

    parser.set_defaults(run=show_help)
    actions = parser.add_subparsers(metavar="ACTION")
    for module in (watch, ls, get, export, advise):
        module.add_action(actions)
