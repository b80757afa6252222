"""The `sonarpost` command: one subcommand a module."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence

from sonarpost import __version__
from sonarpost.errors import SonarpostError

# Where each command is. Only the module of the command that is called is imported: all of them together take seconds.
COMMANDS = {
    "demo": "demo",
    "run": "run",
    "router": "run",
    "status": "status",
    "c2": "c2",
    "console": "console",
    "survey-panel": "survey_panel",
    "metrics": "metrics",
    "simulate": "simulate",
    "survey": "survey",
    "detect": "detect",
    "encode": "encode",
    "decode": "encode",
    "codebook": "codebook",
    "bench": "bench",
    "pki": "pki",
    "modem-emulator": "modem_emulator",
}
EXIT_ERROR = 2
EXIT_INTERRUPTED = 130


def parser(command: str = "") -> argparse.ArgumentParser:
    """Return the parser of one command, or of all of them where the name is not one."""
    whole = argparse.ArgumentParser(
        prog="sonarpost",
        description="Side-scan-sonar snippets from an underwater vehicle, by acoustic modem, to ship and shore.",
    )
    whole.add_argument("--version", action="version", version=f"sonarpost {__version__}")
    subparsers = whole.add_subparsers(metavar="COMMAND", required=False)
    modules = [COMMANDS[command]] if command in COMMANDS else dict.fromkeys(COMMANDS.values())
    for module in modules:
        importlib.import_module(f"sonarpost.cli.{module}").add_parser(subparsers)
    return whole


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status (2: wrong input, with one line that says what)."""
    given = sys.argv[1:] if arguments is None else arguments
    whole = parser(given[0] if given else "")
    parsed = whole.parse_args(given)
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
