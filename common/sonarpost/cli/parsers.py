"""Parsers of commands that consist of actions, and tables as text."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TypeAlias

Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # noqa: SLF001  argparse names it so
"""Group of the parsers of commands or actions."""


def add_command(subparsers: Subparsers, name: str, help_text: str) -> Subparsers:
    """Add a command that consists of actions; return the group of its actions. Without an action it prints its help."""
    parser = subparsers.add_parser(name, help=help_text)

    def show_help(_: argparse.Namespace) -> int:
        parser.print_help()
        return 0

    parser.set_defaults(run=show_help)
    return parser.add_subparsers(metavar="ACTION")


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the rows as lines with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
