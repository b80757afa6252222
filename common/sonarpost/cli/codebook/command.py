"""The actions of `sonarpost codebook`."""

from __future__ import annotations

import argparse

from sonarpost.cli.codebook import adapt, build, diff, info


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its actions."""
    parser = subparsers.add_parser("codebook", help="build, compare and adapt tile codebooks")

    def show_help(_: argparse.Namespace) -> int:
        parser.print_help()
        return 0

    parser.set_defaults(run=show_help)
    actions = parser.add_subparsers(metavar="ACTION")
    for module in (build, info, diff, adapt):
        module.add_action(actions)
