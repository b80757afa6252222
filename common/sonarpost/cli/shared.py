"""Parsers, options and text functions that several commands share."""

import argparse
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sonarpost.errors import ConfigError
from sonarpost.keys import SHORE

if TYPE_CHECKING:
    from sonarpost.config import TlsConfig
    from sonarpost.sonar.options import SurveyOptions
    from sonarpost.sonar.source import SurveyInfo

DEFAULT_ROUTER = "tcp/127.0.0.1:7447"


def option(
    container: argparse._ActionsContainer,
    name: str,
    text: str,
    kind: Callable[[str], object] = str,
    default: object = None,
    **others: Any,  # noqa: ANN401 those of `add_argument`
) -> None:
    """Add an option or a positional argument.

    Args:
        container: Parser, or group of options.
        name: `--out FILE`: the option, and what stands for its value in the help; without the latter, its choices.
        text: Its help; the default is appended unless the text has it.
        kind: Converts the value.
        default: Value without the option.
        others: See `argparse.ArgumentParser.add_argument`.
    """
    word, *metavars = name.split(" ")
    if metavars:
        others["metavar"] = metavars[0] if len(metavars) == 1 else tuple(metavars)
    if default not in (None, "", []) and "(default" not in text:
        text += f" (default: {default:g})" if isinstance(default, float) else " (default: %(default)s)"
    if kind is not str:
        others["type"] = kind
    container.add_argument(word, help=text, default=default, **others)


def flag(container: argparse._ActionsContainer, name: str, text: str) -> None:
    """Add an option without a value, False unless it is given."""
    container.add_argument(name, help=text, action="store_true")


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the rows as lines with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Print the rows with aligned columns; non-printable characters are replaced by `?`."""
    for line in aligned(rows):
        print(printable(line))


def print_rejected(problems: Iterable[object]) -> bool:
    """Print what was rejected on standard error; return whether there is anything."""
    lines = [f"rejected: {printable(str(problem))}" for problem in problems]
    for line in lines:
        print(line, file=sys.stderr)
    return bool(lines)


def in_new_folder(path: Path) -> Path:
    """Return the path of an output file after creating its folder, as `make_output_folder` does."""
    make_output_folder(path.parent)
    return path


def add_router_options(parser: argparse.ArgumentParser) -> None:
    """Add --config, --router and the three TLS options."""
    option(parser, "--config FILE", "TOML file of a platform; its router and tls keys are used", Path)
    option(
        parser,
        "--router ENDPOINT",
        f"router endpoint; several are tried in turn (default: {DEFAULT_ROUTER})",
        action="append",
    )
    option(parser, "--tls-ca PEM", "certificate of the fleet's authority, for tls/… endpoints", Path)
    option(parser, "--tls-certificate PEM", "certificate of this client", Path)
    option(parser, "--tls-key PEM", "private key of this client", Path)


def router_of(parsed: argparse.Namespace) -> "tuple[tuple[str, ...], TlsConfig | None]":
    """Return router endpoints and TLS files. Command-line options override the file of --config.

    Raises:
        ConfigError: The file is invalid, or only some of the TLS options are given.
    """
    # Imported lazily: the help of a command does not need it, and it loads the records.
    from sonarpost.config import PlatformConfig, TlsConfig, load  # noqa: PLC0415

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


def log_level(parsed: argparse.Namespace) -> str:
    """Return the log level of a server: info unless -v or -q was given."""
    return {"verbose": "debug", "quiet": "error"}.get(getattr(parsed, "verbosity", ""), "info")


def add_site_option(parser: argparse.ArgumentParser) -> None:
    """Add --site, the name of the shore site."""
    option(parser, "--site NAME", "name of the shore site", default=SHORE)


def add_survey_options(parser: argparse.ArgumentParser) -> None:
    """Add --options, --crs and --frequency: what survey files do not contain, and the choice of their channels."""
    option(parser, "--options FILE.toml", "survey options: projection, mounting of the sonar, errors", Path)
    option(parser, "--crs EPSG:N", "coordinate system of projected positions; replaces the one in --options")
    option(parser, "--frequency KHZ", "frequency of a sonar with several, the nearest one (default: the highest)")


def survey_options_of(parsed: argparse.Namespace) -> "SurveyOptions":
    """Return the survey options of the command line.

    Raises:
        ConfigError: The options file is invalid, --crs is not a projected coordinate system, or --frequency is not one.
    """
    from sonarpost.sonar.options import SurveyOptions, checked_options, load_options  # noqa: PLC0415  as in `router_of`

    options = load_options(parsed.options) if parsed.options is not None else SurveyOptions()
    if (crs := projected_crs_of(parsed)) is not None:
        options = options.model_copy(update={"projected_crs": crs})
    if parsed.frequency is not None:
        try:
            frequency_hz = float(parsed.frequency) * 1000
        except ValueError:
            raise ConfigError("command line", "--frequency", parsed.frequency, "a number of kHz") from None
        checked = checked_options({"frequency_hz": frequency_hz}, "--frequency")
        options = options.model_copy(update={"frequency_hz": checked.frequency_hz})
    return options


def projected_crs_of(parsed: argparse.Namespace) -> str | None:
    """Return --crs, or None if it is not given.

    Raises:
        ConfigError: Not a projected coordinate system.
    """
    from sonarpost.sonar.options import checked_options  # noqa: PLC0415  as in `router_of`

    return checked_options({"projected_crs": parsed.crs}, "--crs").projected_crs


def print_notes(info: "SurveyInfo") -> None:
    """Print the irregularities of a survey file on standard error."""
    for warning in info.warnings:
        print(f"note: {info.path.name}: {warning}", file=sys.stderr)


def make_output_folder(folder: Path) -> None:
    """Create a folder for output, and check before the work that files can be created in it.

    Raises:
        ConfigError: It cannot be created or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigError("command line", "output folder", str(folder), f"a folder to write into ({reason})") from error


def utc_text(time_utc_s: float) -> str:
    """Return a time as ISO 8601 to the millisecond."""
    when = datetime.fromtimestamp(round(time_utc_s, 3), tz=UTC)
    return when.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def add_fit_option(parser: argparse.ArgumentParser) -> None:
    """Add --fit, for images of a size that codecs do not accept."""
    option(
        parser,
        "--fit",
        "images outside 16 to 512 px a side: cut the centre (crop), change the resolution (resize), or report an error",
        default="refuse",
        choices=("refuse", "crop", "resize"),
    )


def time_text(utc_s: float | None) -> str:
    """Return a UTC time as YYYY-MM-DD HH:MM:SS; empty for None."""
    return "" if utc_s is None else datetime.fromtimestamp(utc_s, UTC).strftime("%Y-%m-%d %H:%M:%S")


def printable(text: str) -> str:
    """Replace non-printable characters of untrusted text by `?`: a terminal could interpret them."""
    return "".join(character if character.isprintable() else "?" for character in text)
