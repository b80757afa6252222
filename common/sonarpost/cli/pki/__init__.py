"""`sonarpost pki`: the fleet's certificates and the routers' access control."""

from sonarpost.cli.pki.command import add_parser

__all__ = ["add_parser"]
