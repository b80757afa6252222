"""The parser of `sonarpost bench` and its actions."""

from __future__ import annotations

import argparse

from sonarpost.cli.bench.codecs import add_action as add_codecs
from sonarpost.cli.bench.detect import add_action as add_detect
from sonarpost.cli.bench.link import add_action as add_link
from sonarpost.cli.bench.link_busy import add_action as add_busy
from sonarpost.cli.bench.mission import add_action as add_mission
from sonarpost.cli.bench.paper import add_action as add_paper
from sonarpost.cli.bench.recognition import add_action as add_recognition
from sonarpost.cli.bench.sea_trial import add_action as add_sea_trial


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "bench",
        help="measure codecs on pictures, against the paper, and by what can be recognised",
        description="Measure codecs on pictures, against the paper's figures, and by what can be recognised in them.",
    )

    def show_help(_: argparse.Namespace) -> int:
        parser.print_help()
        return 0

    parser.set_defaults(run=show_help)
    actions = parser.add_subparsers(metavar="ACTION")
    add_codecs(actions)
    add_paper(actions)
    add_recognition(actions)
    add_link(actions)
    add_sea_trial(actions)
    add_mission(actions)
    add_detect(actions)
    add_busy(actions)
