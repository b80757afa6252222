"""`sonarpost prepare`: compile the machine code of the codecs in advance."""

import argparse
import logging
import sys
import time

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.codec.jit import NO_FOLDER, compilation_log
from sonarpost.codec.machine_code import prepare_machine_code


def add_options(parser: CommandParser) -> None:
    """Add the command."""
    parser.description = (
        "Compiles the machine code of the codec emb and stores it on disk, so that the first image "
        "does not wait for the compiler. Run it once for each installation."
    )
    parser.set_defaults(run=run)


def run(_: argparse.Namespace) -> int:
    """Compile what the cache on disk does not hold; return 0, or 1 if the machine code cannot be stored."""
    started_s = time.monotonic()
    logging.getLogger("sonarpost.codec.jit").setLevel(logging.ERROR)  # the steps are printed here
    with ProgressDisplay() as display:

        def show(step: str) -> None:
            display.show(step)
            display.line(f"Preparing machine code: {step}")

        prepare_machine_code(show)
    if not compilation_log.compiled:
        print("Machine code is ready: nothing to compile")
        return 0
    if not compilation_log.cache_folders:
        print(f"Machine code is not stored: {NO_FOLDER}", file=sys.stderr)
        return 1
    folders = ", ".join(sorted(str(folder) for folder in compilation_log.cache_folders))
    after_s = time.monotonic() - started_s
    print(f"Machine code is ready: compiled={compilation_log.compiled} after_s={after_s:.1f} in {folders}")
    return 0
