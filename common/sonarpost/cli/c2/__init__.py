"""`sonarpost c2`: lists, copies, exports and watches the contacts of a shore site, and sends commands and comments."""

from sonarpost.cli.c2 import migrate, stored, tasking, watch
from sonarpost.cli.parsing.parser import CommandParser


def add_actions(parser: CommandParser) -> None:
    """Add the actions."""
    for module in (watch, stored, tasking, migrate):
        module.add_actions(parser)
