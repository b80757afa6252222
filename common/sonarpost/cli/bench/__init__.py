"""`sonarpost bench`: codecs against one another, against the paper's figures, and before a judge of targets."""

from sonarpost.cli.bench.command import add_parser

__all__ = ["add_parser"]
