"""`sonarpost c2`: lists, copies, exports and watches the contacts of a shore site, and sends commands and comments."""

from __future__ import annotations

import argparse

from sonarpost.cli.c2 import stored, tasking, watch

__all__ = ["add_parser"]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its actions."""
    parser = subparsers.add_parser("c2", help="list, export and watch the contacts of a shore site; send commands")

    def show_help(_: argparse.Namespace) -> int:
        parser.print_help()
        return 0

    parser.set_defaults(run=show_help)
    actions = parser.add_subparsers(metavar="ACTION")
    for module in (watch, stored, tasking):
        module.add_actions(actions)
