"""`sonarpost survey`: describe, draw and export recordings."""

from __future__ import annotations

from sonarpost.cli.shared import Subparsers, add_command
from sonarpost.cli.survey import export, info, plot


def add_parser(subparsers: Subparsers) -> None:
    """Add the command and its actions."""
    actions = add_command(subparsers, "survey", "describe, draw and export recordings of side-scan sonars")
    for module in (info, plot, export):
        module.add_action(actions)
