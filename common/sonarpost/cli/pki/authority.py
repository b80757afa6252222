"""`sonarpost pki init`: make the fleet's authority."""

from __future__ import annotations

import argparse
import getpass
import sys

from sonarpost.cli.pki import common
from sonarpost.security.fleet import AUTHORITY_DAYS, CA_CERTIFICATE, Fleet
from sonarpost.security.index import PkiError


def add_actions(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action.

    No option may be shortened: `--passphrase SECRET` would be taken for a file, and the secret would stand in `ps`.
    """
    parser = actions.add_parser("init", allow_abbrev=False, help="make the fleet's authority in a new folder")
    common.add_folder(parser)
    parser.add_argument("--fleet", default="sonarpost", metavar="NAME", help="name of the fleet, for people")
    parser.add_argument("--days", type=int, default=AUTHORITY_DAYS, help=f"validity in days ({AUTHORITY_DAYS})")
    common.add_passphrase(parser)
    parser.add_argument("--ask-passphrase", action="store_true", help="ask the terminal for one")
    parser.set_defaults(run=init)


def init(args: argparse.Namespace) -> int:
    """Make the authority; return 0.

    Raises:
        PkiError: The folder is there already, or the passphrase is of no use.
    """
    secret = None
    if args.passphrase_file is not None:
        secret = common.passphrase_from(args.passphrase_file)
    elif args.ask_passphrase:
        secret = _asked_twice()
    if not 0 < args.days <= 36500:
        raise PkiError("pki", "days", args.days, "1 to 36500")
    fleet = Fleet.init(args.folder, args.fleet, secret, args.days)
    protection = "protected by the passphrase" if secret else "in the clear: keep this folder off the vessels"
    print(f"authority  {fleet.folder / CA_CERTIFICATE}")
    print(f"key        {protection}")
    return 0


def _asked_twice() -> bytes:
    if not sys.stdin.isatty():
        raise PkiError("pki", "passphrase", "no terminal to ask", "--passphrase-file FILE")
    first = getpass.getpass("Passphrase for the authority's key: ")
    if first != getpass.getpass("The same again: "):
        raise PkiError("pki", "passphrase", "two different ones", "the same twice")
    return first.encode()
