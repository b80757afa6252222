"""`sonarpost catalogue`: build, compare and adapt tile catalogues, look into one, rebuild the shipped ones."""

from sonarpost.cli.catalogue.command import add_parser

__all__ = ["add_parser"]
