"""The options of commands that watch a fleet: which router, and with which certificate."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from sonarpost.config import PlatformConfig, TlsConfig, load
from sonarpost.errors import ConfigError

DEFAULT_ROUTER = "tcp/127.0.0.1:7447"


def add_router_options(parser: argparse.ArgumentParser) -> None:
    """Add --config, --router and the three files of TLS."""
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="TOML file of a platform: its router and tls keys are used"
    )
    parser.add_argument(
        "--router", action="append", metavar="ENDPOINT", help=f"router, tried in turn (default: {DEFAULT_ROUTER})"
    )
    for name, help_text in (
        ("tls-ca", "certificate of the fleet's authority, for tls/… endpoints"),
        ("tls-certificate", "our certificate"),
        ("tls-key", "its private key"),
    ):
        parser.add_argument(f"--{name}", type=Path, metavar="PEM", help=help_text)


def router_of(parsed: argparse.Namespace) -> tuple[tuple[str, ...], TlsConfig | None]:
    """Return endpoints and certificate; what is given on the command line goes before the file.

    Raises:
        ConfigError: The file is wrong, or only some of the files of TLS are given.
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
