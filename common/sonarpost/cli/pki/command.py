"""The actions of `sonarpost pki`."""

from __future__ import annotations

import argparse

from sonarpost.cli.pki import authority, certificates, router


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its actions."""
    parser = subparsers.add_parser("pki", help="the fleet's certificates, and who may say what to its routers")

    def show_help(_: argparse.Namespace) -> int:
        parser.print_help()
        return 0

    parser.set_defaults(run=show_help)
    actions = parser.add_subparsers(metavar="ACTION")
    for module in (authority, certificates, router):
        module.add_actions(actions)
