"""Options and text functions shared by the commands of a vessel or shore site."""

from __future__ import annotations

import argparse
import os
from datetime import UTC, datetime
from pathlib import Path

from sonarpost.config import PlatformConfig, TlsConfig, load
from sonarpost.errors import ConfigError
from sonarpost.keys import SHORE

DEFAULT_ROUTER = "tcp/127.0.0.1:7447"


def add_router_options(parser: argparse.ArgumentParser) -> None:
    """Add --config, --router and the three TLS options."""
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="TOML file of a platform; its router and tls keys are used"
    )
    parser.add_argument(
        "--router",
        action="append",
        metavar="ENDPOINT",
        help=f"router endpoint; several are tried in turn (default: {DEFAULT_ROUTER})",
    )
    for name, help_text in (
        ("tls-ca", "certificate of the fleet's authority, for tls/… endpoints"),
        ("tls-certificate", "certificate of this client"),
        ("tls-key", "private key of this client"),
    ):
        parser.add_argument(f"--{name}", type=Path, metavar="PEM", help=help_text)


def router_of(parsed: argparse.Namespace) -> tuple[tuple[str, ...], TlsConfig | None]:
    """Return router endpoints and TLS files. Command-line options override the file of --config.

    Raises:
        ConfigError: The file is invalid, or only some of the TLS options are given.
    """
    endpoints: tuple[str, ...] = (DEFAULT_ROUTER,)
    tls: TlsConfig | None = None
    if parsed.config is not None:
        platform, _ = load(parsed.config, "platform", PlatformConfig, os.environ)
        endpoints, tls = platform.router, platform.tls
    if parsed.router:
        endpoints = tuple(parsed.router)
    files = (parsed.tls_ca, parsed.tls_certificate, parsed.tls_key)
    if any(files):
        if not all(files):
            expected = "--tls-ca, --tls-certificate and --tls-key together"
            raise ConfigError("command line", "tls", " ".join(str(f) for f in files if f), expected)
        tls = TlsConfig(ca=files[0], certificate=files[1], key=files[2])
    return endpoints, tls


def add_site_option(parser: argparse.ArgumentParser) -> None:
    """Add --site, the name of the shore site."""
    parser.add_argument("--site", default=SHORE, metavar="NAME", help=f"name of the shore site (default: {SHORE})")


def time_text(utc_s: float | None) -> str:
    """Return a UTC time as YYYY-MM-DD HH:MM:SS; empty for None."""
    return "" if utc_s is None else datetime.fromtimestamp(utc_s, UTC).strftime("%Y-%m-%d %H:%M:%S")


def printable(text: str) -> str:
    """Replace non-printable characters of untrusted text by `?`: a terminal could interpret them."""
    return "".join(character if character.isprintable() else "?" for character in text)
