"""The `sonarpost` command: one subcommand a module."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Callable, Sequence

from sonarpost import __version__
from sonarpost.errors import SonarpostError

# Module of each command. Only the module of the given command is imported: all of them together take seconds.
COMMANDS = {
    "demo": "demo",
    "run": "run",
    "router": "run",
    "status": "status",
    "c2": "c2",
    "store": "store",
    "console": "console",
    "metrics": "metrics",
    "simulate": "simulate",
    "survey": "survey",
    "detect": "detect",
    "encode": "encode",
    "decode": "encode",
    "codebook": "codebook",
    "prepare": "prepare",
    "pki": "pki",
    "modem-emulator": "modem_emulator",
}
# Commands of version 0.1 that have another name now.
RENAMED_COMMANDS = {
    "catalogue": "sonarpost codebook",
    "survey-panel": "python -m research.user_study",
    "codebook nominal": "python -m research.default_codebooks",
    "bench": "python -m research.codecs (research/README.md lists the others)",
    "bench codecs": "python -m research.codecs",
    "bench link": "python -m research.link",
    "bench detect": "python -m research.detection",
    "bench recognition": "python -m research.recognition",
    "bench paper": "python -m research.paper",
    "bench sea-trial": "python -m research.sea_trial",
    "bench mission": "python -m research.mission",
    "bench busy": "python -m research.utilisation",
}
EXIT_ERROR = 2
EXIT_INTERRUPTED = 130


def parser(command: str = "") -> argparse.ArgumentParser:
    """Return the parser of one command, or of all commands for any other name."""
    whole = argparse.ArgumentParser(
        prog="sonarpost",
        description="Send images of sonar contacts from an underwater vehicle to a vessel and a shore site.",
    )
    whole.add_argument("--version", action="version", version=f"sonarpost {__version__}")
    subparsers = whole.add_subparsers(metavar="COMMAND", required=False)
    modules = [COMMANDS[command]] if command in COMMANDS else dict.fromkeys(COMMANDS.values())
    for module in modules:
        importlib.import_module(f"sonarpost.cli.{module}").add_parser(subparsers)
    return whole


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status (2: invalid input, reported in one line)."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    new_name = RENAMED_COMMANDS.get(" ".join(given[:2])) or RENAMED_COMMANDS.get(" ".join(given[:1]))
    if new_name is not None:
        print(f"sonarpost: {' '.join(given[:2])}: this command is now: {new_name}", file=sys.stderr)
        return EXIT_ERROR
    whole = parser(given[0] if given else "")
    parsed = whole.parse_args(given)
    if not hasattr(parsed, "run"):
        whole.print_help()
        return 0
    return exit_status(lambda: parsed.run(parsed))


def exit_status(run: Callable[[], int], prog: str = "sonarpost") -> int:
    """Run a command; return its exit status.

    A SonarpostError or OSError is printed as one line and gives status 2, an interrupt gives status 130.
    """
    try:
        return run()
    except SonarpostError as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return EXIT_ERROR
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            # The reader has closed the output (`| head`): not an error.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        print(f"{prog}: {error}", file=sys.stderr)
        return EXIT_ERROR
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
