"""What the actions share: the authority's folder and its passphrase, which never comes by the command line."""

from __future__ import annotations

import argparse
import getpass
import stat
import sys
from pathlib import Path

from sonarpost.security.fleet import Fleet
from sonarpost.security.index import PkiError

DEFAULT_FOLDER = Path("pki")


def add_folder(parser: argparse.ArgumentParser) -> None:
    """Add the option for the authority's folder."""
    parser.add_argument(
        "--dir", type=Path, default=DEFAULT_FOLDER, dest="folder", metavar="DIR", help="the authority's folder (pki)"
    )


def add_passphrase(parser: argparse.ArgumentParser) -> None:
    """Add the option for the file with the passphrase."""
    parser.add_argument(
        "--passphrase-file",
        type=Path,
        metavar="FILE",
        help="file with the passphrase of the authority's key, its first line",
    )


def fleet_of(args: argparse.Namespace) -> Fleet:
    """Return the authority that the command line names."""
    return Fleet(args.folder, lambda: passphrase(getattr(args, "passphrase_file", None)))


def passphrase(file: Path | None) -> bytes:
    """Return the passphrase from a file, or ask the terminal for it.

    Raises:
        PkiError: The file cannot be read or others can, or there is no terminal to ask.
    """
    if file is not None:
        return passphrase_from(file)
    if not sys.stdin.isatty():
        raise PkiError("pki", "passphrase", "no terminal to ask", "--passphrase-file FILE")
    return getpass.getpass("Passphrase of the authority's key: ").encode()


def passphrase_from(file: Path) -> bytes:
    """Return the first line of a file that only its owner can read.

    Raises:
        PkiError: It cannot be read, others can read it, or it is empty.
    """
    try:
        mode = stat.S_IMODE(file.stat().st_mode)
        lines = file.read_bytes().splitlines()
    except OSError as error:
        raise PkiError(str(file), "passphrase", str(error), "a readable file") from error
    if mode & 0o077:
        raise PkiError(str(file), "mode", f"{mode:04o}", "0600: nobody else may read a passphrase")
    if not lines or not lines[0]:
        raise PkiError(str(file), "passphrase", "an empty first line", "the passphrase")
    return lines[0]
