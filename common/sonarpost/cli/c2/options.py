"""What several actions of `sonarpost c2` share: options, times, and names of pictures."""

from __future__ import annotations

import argparse
import re
import time
from datetime import UTC, datetime
from pathlib import Path

from sonarpost.errors import ConfigError
from sonarpost.keys import SHORE

_AGO = re.compile(r"(\d+(?:\.\d+)?)([smhd])")
_UNIT_S = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}


def add_out_dir(parser: argparse.ArgumentParser) -> None:
    """Add the folder that c2 keeps."""
    parser.add_argument("--out-dir", type=Path, default=Path("out"), metavar="DIR", help="c2's out_dir (default: out)")


def add_site(parser: argparse.ArgumentParser) -> None:
    """Add the name of the site."""
    parser.add_argument("--site", default=SHORE, metavar="NAME", help=f"site of the c2 (default: {SHORE})")


def since_of(text: str | None, now_utc_s: float | None = None) -> float:
    """Return the time that `--since` means, as UTC seconds: 90m, 2h, 3d ago, or a time like 2026-11-21T08:30:00.

    Raises:
        ConfigError: It is neither.
    """
    if text is None:
        return 0.0
    if ago := _AGO.fullmatch(text):
        now = time.time() if now_utc_s is None else now_utc_s
        return now - float(ago.group(1)) * _UNIT_S[ago.group(2)]
    try:
        when = datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigError("c2", "--since", text, "45s, 90m, 2h, 3d, or a time like 2026-11-21T08:30:00") from error
    return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()


def time_text(utc_s: float | None) -> str:
    """Return a time as people read it, in UTC."""
    return "" if utc_s is None else datetime.fromtimestamp(utc_s, UTC).strftime("%Y-%m-%d %H:%M:%S")


def printable(text: str) -> str:
    """Return a stranger's text without what a terminal would act on."""
    return "".join(character if character.isprintable() else "?" for character in text)
