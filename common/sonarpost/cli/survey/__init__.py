"""`sonarpost survey`: describe, draw, view and export recordings."""

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.survey import info, plot


def add_actions(parser: CommandParser) -> None:
    """Add the actions."""
    for module in (info, plot):
        module.add_actions(parser)
