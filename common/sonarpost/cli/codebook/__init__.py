"""`sonarpost codebook`: build, compare and adapt tile codebooks, look into one, rebuild the shipped ones."""

from sonarpost.cli.codebook.command import add_parser

__all__ = ["add_parser"]
