"""`sonarpost c2`: what a shore site has accepted, and what it says to its vessels."""

from sonarpost.cli.c2.command import add_parser

__all__ = ["add_parser"]
