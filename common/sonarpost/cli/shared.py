"""Parsers, options and text functions that several commands share."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeAlias

from sonarpost.config import PlatformConfig, TlsConfig, load
from sonarpost.errors import ConfigError
from sonarpost.keys import SHORE

Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # noqa: SLF001  argparse names it so
"""Group of the parsers of commands or actions."""

DEFAULT_ROUTER = "tcp/127.0.0.1:7447"


def add_command(subparsers: Subparsers, name: str, help_text: str) -> Subparsers:
    """Add a command that consists of actions; return the group of its actions. Without an action it prints its help."""
    parser = subparsers.add_parser(name, help=help_text)

    def show_help(_: argparse.Namespace) -> int:
        parser.print_help()
        return 0

    parser.set_defaults(run=show_help)
    return parser.add_subparsers(metavar="ACTION")


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the rows as lines with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


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
