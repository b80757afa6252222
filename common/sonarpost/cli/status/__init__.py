"""`sonarpost status`: every service of every platform, live."""

from sonarpost.cli.status.command import add_parser

__all__ = ["add_parser"]
