"""`sonarpost c2 get`: copies the files of one picture."""

from __future__ import annotations

import argparse
from pathlib import Path

from sonarpost.archive.shore_files import files_of, find_picture
from sonarpost.archive.shore_index import ShoreIndex
from sonarpost.cli.c2.options import add_out_dir
from sonarpost.errors import StoredFileError
from sonarpost.files import write_atomically


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action."""
    parser = actions.add_parser("get", help="copy the TIFF, PNG and JSON of one picture")
    parser.add_argument("picture", metavar="VEHICLE/IMAGE", help="as `ls` shows it, or the name of its files")
    parser.add_argument("--vessel", metavar="NAME", help="where two vessels have the same")
    parser.add_argument("--version", type=int, metavar="N", help="default: the newest")
    parser.add_argument("--to", type=Path, default=Path(), metavar="DIR", help="where to (default: here)")
    add_out_dir(parser)
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Copy, and print a path a line; return 0.

    Raises:
        StoredFileError: There is no such picture, or several, or a file of it cannot be read.
        OSError: A copy cannot be written.
    """
    index = ShoreIndex(parsed.out_dir, writable=False)
    try:
        row = find_picture(index.pictures(), parsed.picture, parsed.vessel, parsed.version)
    finally:
        index.close()
    copies = []
    for path in files_of(parsed.out_dir, row):
        try:
            copies.append((parsed.to / path.name, path.read_bytes()))
        except OSError as error:
            raise StoredFileError(str(path), "", error.strerror or str(error), "a file that c2 keeps") from error
    parsed.to.mkdir(parents=True, exist_ok=True)
    for path, data in copies:
        write_atomically(path, data)
        print(path)
    return 0
