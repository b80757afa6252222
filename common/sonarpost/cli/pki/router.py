"""`sonarpost pki router-config`: a router's configuration with TLS and the access control of the fleet as it is now."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path, PurePosixPath

from sonarpost.cli.pki import common
from sonarpost.files import write_atomically
from sonarpost.keys import SHORE
from sonarpost.security import private_files
from sonarpost.security.index import PkiError
from sonarpost.security.router_config import ON_HOST, Wanted, router_json5


def add_actions(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action."""
    parser = actions.add_parser(
        "router-config", allow_abbrev=False, help="write the configuration of a platform's router (JSON5)"
    )
    common.add_folder(parser)
    parser.add_argument("--platform", required=True, help="whose router it is")
    parser.add_argument(
        "--listen", nargs="*", default=[], metavar="ENDPOINT", help="for other platforms: tls/ADDRESS:PORT"
    )
    parser.add_argument(
        "--local",
        nargs="*",
        default=["tcp/127.0.0.1:7447"],
        metavar="ENDPOINT",
        help="for the platform's own services, without certificates (tcp/127.0.0.1:7447)",
    )
    parser.add_argument(
        "--open-local",
        action="store_true",
        help="allow other than loopback addresses there: nobody else is in that network",
    )
    parser.add_argument(
        "--connect", nargs="*", default=[], metavar="ENDPOINT", help="routers to link to: tls/HOST:PORT"
    )
    parser.add_argument(
        "--files",
        type=PurePosixPath,
        default=ON_HOST,
        metavar="DIR",
        help=f"folder of ca.pem, certificate.pem and key.pem on the router's host ({ON_HOST})",
    )
    parser.add_argument(
        "--site", action="append", dest="sites", metavar="NAME", help=f"word the shore answers to in keys ({SHORE})"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="file to write; without it the output")
    parser.add_argument("--replace", action="store_true", help="write over the file that is there")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write the configuration; return 0.

    Raises:
        BadInputError: The platform has no certificate or no router, or an endpoint is wrong.
    """
    wanted = Wanted(
        platform=args.platform,
        listen=args.listen,
        local=args.local,
        connect=args.connect,
        files=args.files,
        sites=tuple(args.sites or (SHORE,)),
        open_local=args.open_local,
    )
    text = router_json5(common.fleet_of(args).index(), wanted, time.time())
    if args.out is None:
        sys.stdout.write(text)
    elif args.replace:
        write_atomically(args.out, text.encode())
    else:
        try:
            private_files.write_new(args.out, text.encode(), private_files.PUBLIC_FILE)
        except FileExistsError as error:
            raise PkiError(str(args.out), "", "a file there already", "none, or --replace") from error
    return 0
