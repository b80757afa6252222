"""`sonarpost demo`: the whole chain on one host, from a survey file to the shore."""

from sonarpost.cli.demo.command import add_parser

__all__ = ["add_parser"]
