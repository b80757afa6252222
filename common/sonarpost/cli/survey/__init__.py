"""`sonarpost survey`: what a recording holds, its picture and track, and the track as a table or GeoJSON."""

from sonarpost.cli.survey.command import add_parser

__all__ = ["add_parser"]
