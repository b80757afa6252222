"""`sonarpost pki issue|renew|revoke|list`: the platforms' certificates."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from sonarpost.cli.pki import common
from sonarpost.security.fleet import CERTIFICATE_DAYS, Bundle
from sonarpost.security.index import ROLES, Issued

WARN_DAYS = 30.0
EXIT_ENDING = 1


def add_actions(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the actions."""
    issue = actions.add_parser("issue", allow_abbrev=False, help="issue a platform's certificate")
    issue.add_argument("platform", help="name of the platform, `id` in its [platform] table")
    issue.add_argument("--role", choices=ROLES, required=True, help="what it is, and so what routers let it do")
    _add_making(issue)
    issue.set_defaults(run=run_issue)

    renew = actions.add_parser(
        "renew", allow_abbrev=False, help="issue a new key and certificate under the platform's present name"
    )
    renew.add_argument("platform", help="name of the platform")
    _add_making(renew)
    renew.set_defaults(run=run_renew)

    revoke = actions.add_parser(
        "revoke", allow_abbrev=False, help="take a platform's name off the routers' lists for good"
    )
    revoke.add_argument("platform", help="name of the platform")
    revoke.add_argument("--reason", default="", help="for the list")
    common.add_folder(revoke)
    revoke.set_defaults(run=run_revoke)

    listing = actions.add_parser(
        "list", allow_abbrev=False, help="show every certificate; exit status 1 when one in use ends soon"
    )
    common.add_folder(listing)
    listing.add_argument("--json", action="store_true", help="one JSON object a line")
    listing.add_argument("--warn-days", type=float, default=WARN_DAYS, metavar="DAYS", help="what is soon (30)")
    listing.set_defaults(run=run_list)


def _add_making(parser: argparse.ArgumentParser) -> None:
    common.add_folder(parser)
    parser.add_argument(
        "--host",
        action="append",
        dest="hosts",
        metavar="NAME_OR_ADDRESS",
        help="DNS name or IP address that others reach its router under; may be repeated",
    )
    parser.add_argument("--days", type=float, default=CERTIFICATE_DAYS, help=f"validity in days ({CERTIFICATE_DAYS:g})")
    parser.add_argument("--out", type=Path, metavar="DIR", help="new folder for its files (DIR/issued/NAME)")
    common.add_passphrase(parser)


def run_issue(args: argparse.Namespace) -> int:
    """Issue a certificate; return 0.

    Raises:
        BadInputError: The platform has one already, or something given is wrong.
    """
    bundle = common.fleet_of(args).issue(args.platform, args.role, args.hosts or (), args.days, args.out)
    _show(bundle)
    print("Write the routers' configurations anew (`sonarpost pki router-config`) and restart them: they know it then.")
    return 0


def run_renew(args: argparse.Namespace) -> int:
    """Renew a certificate; return 0.

    Raises:
        BadInputError: The platform has none, or something given is wrong.
    """
    _show(common.fleet_of(args).renew(args.platform, args.hosts, args.days, args.out))
    print("Routers need no new configuration. The old certificate stays good until it ends.")
    return 0


def run_revoke(args: argparse.Namespace) -> int:
    """Revoke a platform's name; return 0.

    Raises:
        PkiError: The platform has no certificate that is not revoked.
    """
    entry = common.fleet_of(args).revoke(args.platform, args.reason)
    print(f"revoked    {entry.common_name}")
    print("Not in force yet: write the routers' configurations anew (`sonarpost pki router-config`) and restart them.")
    return 0


def _show(bundle: Bundle) -> None:
    entry = bundle.entry
    print(f"name       {entry.common_name} ({entry.role})")
    print(f"valid to   {entry.not_after:%Y-%m-%d %H:%M} UTC")
    print(f"files      {bundle.folder}")


def run_list(args: argparse.Namespace) -> int:
    """Print every certificate; return 1 when one that is in use ends within the days asked for, else 0.

    Raises:
        PkiError: There is no authority, or its index is damaged.
    """
    fleet = common.fleet_of(args)
    index = fleet.index()
    now_utc_s = time.time()
    in_use = {e.serial for platform in {e.platform for e in index.certificates} if (e := index.current(platform))}
    rows = [
        (entry, state(entry, args.warn_days, now_utc_s, in_use=entry.serial in in_use)) for entry in index.certificates
    ]
    if args.json:
        for entry, word in rows:
            print(json.dumps({**entry.model_dump(mode="json"), "state": word}))
    else:
        print_table(rows)
    authority_days = fleet.authority_days_left()
    ending = [
        f"{entry.common_name} {entry.not_after:%Y-%m-%d}" for entry, word in rows if word in ("ending", "expired")
    ]
    if authority_days <= args.warn_days:
        ending.append(f"the authority itself, in {authority_days:.1f} days")
    for text in ending:
        print(f"sonarpost: ends soon or has ended: {text}", file=sys.stderr)
    return EXIT_ENDING if ending else 0


def state(entry: Issued, warn_days: float, now_utc_s: float, *, in_use: bool) -> str:
    """Return the state of a certificate in a word: revoked, replaced, expired, ending or valid."""
    if entry.revoked_utc_s is not None:
        return "revoked"
    if not in_use:
        return "replaced"
    days = entry.days_left(now_utc_s)
    if days <= 0:
        return "expired"
    return "ending" if days <= warn_days else "valid"


def print_table(rows: Sequence[tuple[Issued, str]]) -> None:
    """Print certificates as a table."""
    head = ("name", "role", "state", "valid to", "serial", "hosts")
    lines = [head] + [
        (e.common_name, e.role, word, f"{e.not_after:%Y-%m-%d}", e.serial[:16], " ".join(e.hosts)) for e, word in rows
    ]
    widths = [max(len(line[column]) for line in lines) for column in range(len(head))]
    for line in lines:
        print("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())
