"""Argument parsing, error handling and progress output of the research commands."""

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Final

from research.codecs.baselines import comparison_registry
from research.common.measurement import SHIPPED_CODEBOOKS, CodecUnderTest, create_codecs
from sonarpost.cli.main import apply_verbosity, exit_status
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.codec import emb
from sonarpost.errors import ConfigError

DEFAULT_BUDGETS: Final = "22,44,64,88,128,192,256,384,512"
MAX_BUDGET_BYTES: Final = 1 << 20


def command_parser(name: str, description: str) -> argparse.ArgumentParser:
    """Return the parser of `python -m research.NAME`."""
    return CommandParser(prog=f"python -m research.{name}", description=description)


def run_command(
    parser: argparse.ArgumentParser,
    run: Callable[[argparse.Namespace], int],
    arguments: Sequence[str] | None = None,
) -> int:
    """Parse the arguments (default: those of the process) and run the command; return its exit status.

    An error of the package or of the operating system is printed as one line and gives status 2.
    """
    parsed = parser.parse_args(arguments)
    apply_verbosity(parsed)
    with ProgressDisplay(step=parser.prog.removeprefix("python -m ")) as display:
        _displays.append(display)
        try:
            return exit_status(lambda: run(parsed), parser.prog)
        finally:
            _displays.remove(display)


_displays: list[ProgressDisplay] = []
"""The display of the command that runs."""


def warn(line: str) -> None:
    """Print a line about the input or the result to standard error, with --quiet as well."""
    print(line, file=sys.stderr, flush=True)


def report_progress(step: str) -> None:
    """Print the step that begins, or ended, to standard error; until the next one its time is shown."""
    for display in _displays:
        display.show(step)
        display.line(step)


def add_codec_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options for codecs and budgets."""
    parser.add_argument(
        "--budgets", default=DEFAULT_BUDGETS, metavar="B,B,…", help="maximum bytes of a stream (default: %(default)s)"
    )
    parser.add_argument("--codecs", metavar="NAME,…", help="default: all that are available")


def add_strength_argument(parser: argparse.ArgumentParser) -> None:
    """Add the option for the strength of despeckling."""
    parser.add_argument(
        "--strength",
        type=float,
        metavar="S",
        default=emb.DEFAULT_STRENGTH,
        help="emb: strength of despeckling, 0 (code the image as it is) to 1 (default: %(default)g)",
    )


def selected_codecs(
    args: argparse.Namespace,
    *,
    all_packings: bool = True,
    cut: bool = False,
    codebooks: Sequence[str] = SHIPPED_CODEBOOKS,
) -> list[CodecUnderTest]:
    """Return the codecs of the options; print unavailable ones to standard error.

    The strength of despeckling is the default one if the command does not have that option.

    Raises:
        ConfigError: A requested codec is unknown or not available, or the strength is out of range.
        CodebookError: A codebook cannot be read.
    """
    strength: float | None = getattr(args, "strength", None)
    names = None if args.codecs is None else [name.strip() for name in args.codecs.split(",")]
    found, unavailable = create_codecs(
        comparison_registry(), names, all_packings=all_packings, cut=cut, codebooks=codebooks, strength=strength
    )
    for line in unavailable:
        warn(f"left out: {line}")
    return found


def parse_budgets(text: str) -> tuple[int, ...]:
    """Parse `22,44,…`; return the budgets in rising order without duplicates.

    Raises:
        ConfigError: A part is not an integer from 1 to 1,048,576.
    """
    parts = [part.strip() for part in text.split(",")]
    for part in parts:
        if not (part.isascii() and part.isdigit() and len(part) < 9 and 1 <= int(part) <= MAX_BUDGET_BYTES):
            raise ConfigError("research", "--budgets", part, f"integers 1..{MAX_BUDGET_BYTES}, separated by commas")
    return tuple(sorted({int(part) for part in parts}))
