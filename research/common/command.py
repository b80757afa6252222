"""Argument parsing, error handling and progress output of the research commands."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence

from sonarpost.cli.main import exit_status


def command_parser(name: str, description: str) -> argparse.ArgumentParser:
    """Return the parser of `python -m research.NAME`."""
    return argparse.ArgumentParser(prog=f"python -m research.{name}", description=description)


def run_command(
    parser: argparse.ArgumentParser,
    run: Callable[[argparse.Namespace], int],
    arguments: Sequence[str] | None = None,
) -> int:
    """Parse the arguments (default: those of the process) and run the command; return its exit status.

    An error of the package or of the operating system is printed as one line and gives status 2.
    """
    parsed = parser.parse_args(arguments)
    return exit_status(lambda: run(parsed), parser.prog)


def say(line: str) -> None:
    """Print progress to standard error, apart from the results."""
    print(line, file=sys.stderr, flush=True)
