"""The `sonarpost` command: one subcommand a module."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from sonarpost import __version__
from sonarpost.cli import bench, catalogue, demo, detect, encode, modem_emulator, run, simulate
from sonarpost.errors import SonarpostError

COMMANDS = (demo, run, simulate, detect, encode, catalogue, bench, modem_emulator)
EXIT_ERROR = 2
EXIT_INTERRUPTED = 130


def parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command."""
    whole = argparse.ArgumentParser(
        prog="sonarpost",
        description="Side-scan-sonar snippets from an underwater vehicle, by acoustic modem, to ship and shore.",
    )
    whole.add_argument("--version", action="version", version=f"sonarpost {__version__}")
    subparsers = whole.add_subparsers(metavar="COMMAND", required=False)
    for module in COMMANDS:
        module.add_parser(subparsers)
    return whole


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status (2: wrong input, with one line that says what)."""
    whole = parser()
    parsed = whole.parse_args(arguments)
    if not hasattr(parsed, "run"):
        whole.print_help()
        return 0
    try:
        status: int = parsed.run(parsed)
    except SonarpostError as error:
        print(f"sonarpost: {error}", file=sys.stderr)
        return EXIT_ERROR
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            # The reader of our output has left (`| head`): not an error, and nothing more can be said to it.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        print(f"sonarpost: {error}", file=sys.stderr)
        return EXIT_ERROR
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return status


if __name__ == "__main__":
    sys.exit(main())
