"""`sonarpost pki`: certificates of a fleet and the access control of its routers.

Options cannot be abbreviated: `--passphrase SECRET` would be read as `--passphrase-file` and appear in `ps`.
"""

import argparse
import getpass
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import flag, in_new_folder, option, print_table
from sonarpost.config import read_passphrase
from sonarpost.files import PUBLIC_FILE, write_atomically, write_new
from sonarpost.keys import SHORE
from sonarpost.security.acoustic_key import KEY_NAME, create_key
from sonarpost.security.fleet import (
    AUTHORITY_DAYS,
    CA_CERTIFICATE,
    CERTIFICATE_DAYS,
    ROLES,
    Bundle,
    CertificateEntry,
    Fleet,
    PkiError,
)
from sonarpost.security.router_config import TLS_FOLDER, RouterOptions, router_json5

DEFAULT_FOLDER = Path("pki")
WARN_DAYS = 30.0
EXIT_ENDING = 1
UPDATE_ROUTERS = "write the routers' configurations again (`sonarpost pki router-config`) and restart them"


def add_actions(parser: CommandParser) -> None:
    """Add the actions."""
    init = _add_action(
        parser, "init", "create the fleet's authority in a new folder", run_init, "--dir fleet --fleet north"
    )
    option(init, "--fleet NAME", "name of the fleet", default="sonarpost")
    option(init, "--days", "validity in days", int, AUTHORITY_DAYS)
    _add_passphrase_file(init)
    flag(init, "--ask-passphrase", "ask for a passphrase at the terminal")

    issue = _add_action(
        parser,
        "issue",
        "issue a platform's certificate",
        run_issue,
        "vessel-1 --dir fleet --role vessel --host 192.0.2.1",
    )
    option(issue, "platform", "name of the platform, `id` in its [platform] table")
    option(issue, "--role", "role, which determines the rights at routers", choices=ROLES, required=True)
    _add_certificate_options(issue)

    prepare = _add_action(
        parser,
        "prepare",
        "let routers admit platforms that get certificates later",
        run_prepare,
        "uuv-8 uuv-9 --dir fleet --role uuv",
    )
    option(prepare, "platforms PLATFORM", "names of the platforms", nargs="+")
    option(prepare, "--role", "role that their certificates will have", choices=ROLES, required=True)

    renew = _add_action(
        parser,
        "renew",
        "issue a new key and certificate under the present name",
        run_renew,
        "vessel-1 --dir fleet --out vessel-1-2027",
    )
    option(renew, "platform", "name of the platform")
    _add_certificate_options(renew)

    revoke = _add_action(
        parser,
        "revoke",
        "remove a platform's name from access control permanently",
        run_revoke,
        "vessel-1 --dir fleet --reason 'computer lost'",
    )
    option(revoke, "platform", "name of the platform")
    option(revoke, "--reason", "reason of the revocation, for `list`", default="")

    listing = _add_action(
        parser, "list", "list all certificates; exit status 1 if one in use ends soon", run_list, "--dir fleet"
    )
    flag(listing, "--json", "print one JSON object for each certificate")
    option(listing, "--warn-days DAYS", "a certificate ends soon within DAYS", float, WARN_DAYS)

    router = _add_action(
        parser,
        "router-config",
        "write a router's configuration (JSON5)",
        run_router_config,
        "--dir fleet --platform vessel-1 --out vessel-1.json5",
    )
    _add_router_options(router)

    acoustic = _add_action(parser, "acoustic", "create the key of the acoustic link", run_acoustic, "--dir fleet")
    option(acoustic, "--out FILE", f"key file (default: DIR/{KEY_NAME})", Path)
    flag(acoustic, "--replace", "overwrite an existing key, which every vehicle and vessel must replace")


def _add_action(
    parser: CommandParser, name: str, text: str, run: Callable[[argparse.Namespace], int], example: str
) -> CommandParser:
    action = parser.add_action(name, text, run, example)
    action.allow_abbrev = False
    option(action, "--dir DIR", "authority's folder", Path, DEFAULT_FOLDER, dest="folder")
    return action


def _add_certificate_options(parser: argparse.ArgumentParser) -> None:
    option(
        parser,
        "--host NAME_OR_ADDRESS",
        "DNS name or IP address of its router; can be repeated",
        action="append",
        dest="hosts",
    )
    option(parser, "--days", "days of validity", float, CERTIFICATE_DAYS)
    option(parser, "--out DIR", "new folder for its files (default: DIR/issued/NAME)", Path)
    _add_passphrase_file(parser)


def _add_passphrase_file(parser: argparse.ArgumentParser) -> None:
    option(parser, "--passphrase-file FILE", "file with the passphrase of the key in its first line", Path)


def _add_router_options(parser: argparse.ArgumentParser) -> None:
    default = RouterOptions("")
    option(parser, "--platform", "platform of the router", required=True)
    option(parser, "--listen ENDPOINT", "endpoint for other platforms: tls/ADDRESS:PORT", default=[], nargs="*")
    option(
        parser,
        "--local ENDPOINT",
        f"endpoint of the platform's own services, no certificates (default: {', '.join(default.local)})",
        default=list(default.local),
        nargs="*",
    )
    flag(
        parser,
        "--open-local",
        "accept other addresses than loopback in --local, for a network that no other program can reach",
    )
    option(parser, "--connect ENDPOINT", "routers to link to: tls/HOST:PORT", default=[], nargs="*")
    option(
        parser,
        "--files DIR",
        "folder of ca.pem, certificate.pem and key.pem on the router's host",
        PurePosixPath,
        TLS_FOLDER,
    )
    option(parser, "--site NAME", f"name of the shore site in keys ({SHORE})", action="append", dest="sites")
    option(
        parser,
        "--other-vessel NAME",
        "vessel whose acoustic frames this lead vessel merges; can be repeated",
        action="append",
        dest="other_vessels",
    )
    option(parser, "--lead-vessel NAME", "lead vessel that merges the acoustic frames", default="")
    flag(
        parser,
        "--thin-link",
        "for a link of a few kB/s, at both routers: compress it; a vessel's router also sends other platforms "
        "only every second health report of a service, one in 10 s with the default health_interval_s of 5 s. "
        "Console and `sonarpost status` show a service as silent or stale after 15 s without one. Images, decisions "
        "and commands are all sent",
    )
    option(parser, "--out FILE", "file to write (default: standard output)", Path)
    flag(parser, "--replace", "overwrite an existing file")


def run_init(args: argparse.Namespace) -> int:
    """Create the authority; return 0."""
    secret = None
    if args.passphrase_file is not None:
        secret = read_passphrase(args.passphrase_file)
    elif args.ask_passphrase:
        secret = _ask("Passphrase for the authority's key: ")
        if secret != _ask("Repeat: "):
            raise PkiError("pki", "passphrase", "two different ones", "the same twice")
    if not 0 < args.days <= 36500:
        raise PkiError("pki", "days", args.days, "1 to 36500")
    fleet = Fleet.init(args.folder, args.fleet, secret, args.days)
    print(f"authority  {fleet.folder / CA_CERTIFICATE}")
    print("key        " + ("encrypted" if secret else "not encrypted: keep this folder off the vessels"))
    return 0


def run_issue(args: argparse.Namespace) -> int:
    """Issue a certificate; return 0."""
    fleet = _fleet(args)
    bundle = fleet.issue(args.platform, args.role, args.hosts or (), args.days, args.out)
    _show(bundle)
    if bundle.entry.common_name in {name.common_name for name in fleet.index().prepared}:
        print("Routers that were configured after `sonarpost pki prepare` admit it.")
    else:
        print(f"To admit it, {UPDATE_ROUTERS}.")
    return 0


def run_prepare(args: argparse.Namespace) -> int:
    """Add names that routers admit before their certificates are issued; return 0."""
    _fleet(args).prepare(args.platforms, args.role)
    print(f"prepared   {', '.join(args.platforms)}")
    print(f"Once, {UPDATE_ROUTERS}. `sonarpost pki issue` of these names then needs neither.")
    return 0


def run_renew(args: argparse.Namespace) -> int:
    """Renew a certificate; return 0."""
    _show(_fleet(args).renew(args.platform, args.hosts, args.days, args.out))
    print("Routers need no new configuration. The old certificate remains valid until its end.")
    return 0


def run_revoke(args: argparse.Namespace) -> int:
    """Revoke a platform's name; return 0."""
    entry = _fleet(args).revoke(args.platform, args.reason)
    print(f"revoked    {entry.common_name}")
    print(f"Not in force yet: {UPDATE_ROUTERS}.")
    return 0


def run_list(args: argparse.Namespace) -> int:
    """Print all certificates; return 1 if one that is in use ends within `--warn-days`, else 0."""
    fleet = _fleet(args)
    index = fleet.index()
    now_utc_s = time.time()
    in_use = {e.serial for platform in {e.platform for e in index.certificates} if (e := index.find(platform))}
    rows = [
        (entry, _state(entry, args.warn_days, now_utc_s, in_use=entry.serial in in_use)) for entry in index.certificates
    ]
    if args.json:
        for entry, state in rows:
            print(json.dumps({**entry.model_dump(mode="json"), "state": state}))
    else:
        _print_table(rows)
    ending = [f"{e.common_name} {e.not_after:%Y-%m-%d}" for e, state in rows if state in ("ending", "expired")]
    authority_days = fleet.authority_days_left()
    if authority_days <= args.warn_days:
        ending.append(f"the authority itself, in {authority_days:.1f} days")
    for text in ending:
        print(f"sonarpost: ends soon or has ended: {text}", file=sys.stderr)
    return EXIT_ENDING if ending else 0


def run_router_config(args: argparse.Namespace) -> int:
    """Write a router's configuration with TLS and the present access control; return 0."""
    options = RouterOptions(
        platform=args.platform,
        listen=args.listen,
        local=args.local,
        connect=args.connect,
        files=args.files,
        sites=tuple(args.sites or (SHORE,)),
        open_local=args.open_local,
        other_vessels=tuple(args.other_vessels or ()),
        lead_vessel=args.lead_vessel,
        thin_link=args.thin_link,
    )
    text = router_json5(_fleet(args).index(), options, time.time())
    if args.out is None:
        sys.stdout.write(text)
    elif args.replace:
        write_atomically(in_new_folder(args.out), text.encode())
    else:
        try:
            write_new(in_new_folder(args.out), text.encode(), PUBLIC_FILE)
        except FileExistsError as error:
            raise PkiError(str(args.out), "", "an existing file", "a new file, or --replace") from error
    return 0


def run_acoustic(args: argparse.Namespace) -> int:
    """Create the key that vehicles and vessels share; return 0."""
    path = args.folder / KEY_NAME if args.out is None else args.out
    if not path.parent.is_dir():
        raise PkiError(str(path.parent), "", "no folder", "a fleet of `sonarpost pki init`, or --out FILE")
    try:
        key = create_key(path, replace=args.replace)
    except FileExistsError as error:
        raise PkiError(str(path), "", "an existing key", "a new file, or --replace") from error
    print(f"key          {path}")
    print(f"fingerprint  {key.fingerprint}")
    print("Copy it to every vehicle and vessel, mode 0600, and name it as acoustic_key_file in [platform].")
    return 0


def _state(entry: CertificateEntry, warn_days: float, now_utc_s: float, *, in_use: bool) -> str:
    if entry.revoked_utc_s is not None:
        return "revoked"
    if not in_use:
        return "replaced"
    days = entry.days_left(now_utc_s)
    if days <= 0:
        return "expired"
    return "ending" if days <= warn_days else "valid"


def _print_table(rows: Sequence[tuple[CertificateEntry, str]]) -> None:
    lines = [
        (e.common_name, e.role, state, f"{e.not_after:%Y-%m-%d}", e.serial[:16], " ".join(e.hosts)) for e, state in rows
    ]
    print_table([("name", "role", "state", "valid to", "serial", "hosts"), *lines])


def _show(bundle: Bundle) -> None:
    entry = bundle.entry
    print(f"name       {entry.common_name} ({entry.role})")
    print(f"valid to   {entry.not_after:%Y-%m-%d %H:%M} UTC")
    print(f"files      {bundle.folder}")


def _fleet(args: argparse.Namespace) -> Fleet:
    def passphrase() -> bytes:
        file = getattr(args, "passphrase_file", None)
        return _ask("Passphrase of the authority's key: ") if file is None else read_passphrase(file)

    return Fleet(args.folder, passphrase)


def _ask(prompt: str) -> bytes:
    if not sys.stdin.isatty():
        raise PkiError("pki", "passphrase", "no terminal to ask", "--passphrase-file FILE")
    return getpass.getpass(prompt).encode()
