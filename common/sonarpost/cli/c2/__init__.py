"""`sonarpost c2`: lists, copies, exports and watches the contacts of a shore site, and sends commands and comments."""

from __future__ import annotations

from sonarpost.cli.c2 import migrate, stored, tasking, watch
from sonarpost.cli.parsing.commands import add_actions
from sonarpost.cli.shared import Subparsers, add_command

__all__ = ["add_parser"]


def add_parser(subparsers: Subparsers) -> None:
    """Add the command and its actions."""
    actions = add_command(subparsers, "c2", "list, export and watch the contacts of a shore site; send commands")
    for module in (watch, stored, tasking, migrate):
        module.add_actions(actions)
    add_actions(actions, "c2")
