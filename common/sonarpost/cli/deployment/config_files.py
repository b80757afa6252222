"""`sonarpost config example` and `sonarpost config check`, and the check that other commands use."""

import argparse
import os
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import flag, option
from sonarpost.config import SERVICE_GROUP, ConfigFile, PlatformConfig, ServiceConfig, service_packages
from sonarpost.errors import BadInputError, ConfigError
from sonarpost.files import PUBLIC_FILE, write_atomically
from sonarpost.registry import EXTENSIONS, load
from sonarpost.security.tls_files import check_tls_files

EXIT_INVALID = 2
PLATFORMS = ("uuv", "vessel", "shore")
"""Platforms with an example configuration and systemd units."""

_EXAMPLE = """Print an example configuration: of a platform (uuv, vessel, shore), of the channel emulator (sim), or of a
Zenoh router (router-uuv, …). The containers use the same files."""
_CHECK = """Check a configuration file as the services do, and print every error with file, line and key: all tables,
overrides in the environment, and the files that the tables name. Run it as the user of the services: `sudo -u sonarpost
sonarpost config check FILE`. Exit status: 0 if all services accept the file, 2 if not. A warning, for example of an
absent serial device, does not change the status."""


def add_actions(parser: CommandParser) -> None:
    """Add the command and its actions."""
    example = parser.add_action(
        "example", "print an example configuration", run_example, "uuv --out uuv.toml", _EXAMPLE
    )
    option(example, "name", "name of the example", choices=sorted(example_files()))
    option(example, "--out FILE", "write it to a file instead", Path)
    flag(example, "--force", "replace an existing file")
    check = parser.add_action(
        "check", "check a configuration file, and print all errors", run_check, "uuv.toml", _CHECK
    )
    option(check, "config FILE", "TOML file of a platform", Path)


def example_files() -> Mapping[str, Path]:
    """Return the example configurations of the core and of extensions, by their names on the command line."""
    found = [path for folder in (Path(__file__).parent, *EXTENSIONS.iterdir()) for path in folder.glob("examples/*")]
    return {path.name.partition(".")[0]: path for path in found if path.suffix in (".toml", ".json5")}


def run_example(parsed: argparse.Namespace) -> int:
    """Print an example configuration, or write it to a file.

    Raises:
        ConfigError: The file exists, without --force.
    """
    text = example_files()[parsed.name].read_text(encoding="utf-8")
    if parsed.out is None:
        print(text, end="")
        return 0
    if parsed.out.exists() and not parsed.force:
        raise ConfigError(str(parsed.out), "", "an existing file", "a new file, or --force to replace it")
    parsed.out.parent.mkdir(parents=True, exist_ok=True)
    # Services run as another user than the one who installs.
    write_atomically(parsed.out, text.encode(), PUBLIC_FILE)
    print(f"{parsed.out}: written, example configuration {parsed.name}")
    return 0


@dataclass(frozen=True)
class CheckedConfig:
    """Result of `check_file`.

    Attributes:
        platform: The `[platform]` table; None if it is invalid.
        services: Table of each service in the file, in the order of `service_packages`; None if it is invalid.
        errors: Why services would not start.
        warnings: What may be intended, for example an absent serial device.
    """

    platform: PlatformConfig | None
    services: Mapping[str, ServiceConfig | None]
    errors: tuple[BadInputError, ...]
    warnings: tuple[BadInputError, ...]


def check_file(path: Path, environment: Mapping[str, str]) -> CheckedConfig:
    """Check a configuration file for all of its services.

    Args:
        path: The TOML file.
        environment: Environment variables with overrides.

    Raises:
        ConfigError: The file is unreadable or not TOML, or it has a service that cannot be imported.
    """
    file = ConfigFile(path, environment)
    platform = file.platform()
    services = {name: file.table(name, configuration_type(name)) for name in file.services}
    errors: list[BadInputError] = list(file.errors)
    warnings: list[BadInputError] = []
    if not file.services:
        errors.append(file.error((), "no table of a service", "[atd_stub], [op_modem], [c2] or others"))
    if platform is not None:
        errors += (_located(file, "platform", platform, error) for error in _platform_errors(platform))
    for name, table in services.items():
        if table is None:
            continue
        if platform is not None:
            try:
                table.check_with(platform)
            except BadInputError as error:
                errors.append(_located(file, name, platform, error))
        port = getattr(table, "port", None)
        if isinstance(port, str) and port.startswith("/") and not Path(port).exists():
            warnings.append(file.error((name, "port"), port, "a device; this one is absent now"))
    # Each once: two services can name the same key file.
    distinct = {str(error): error for error in errors}.values()
    return CheckedConfig(platform, services, tuple(sorted(distinct, key=_line_number)), tuple(warnings))


def _line_number(error: BadInputError) -> int:
    """Return the line that an error names; 0 without one."""
    number = error.where.rpartition(":")[2]
    return int(number) if number.isdecimal() else 0


def configuration_type(service: str) -> type[ServiceConfig]:
    """Return the type of the configuration table of a service.

    Raises:
        ConfigError: It is a service of a plug-in that cannot be imported.
    """
    name = "".join(part.capitalize() for part in service.split("_")) + "Config"
    point = EntryPoint(service, f"{service_packages()[service]}.config:{name}", SERVICE_GROUP)
    found: type[ServiceConfig] = load(point)
    return found


def _platform_errors(platform: PlatformConfig) -> Iterator[BadInputError]:
    uses_tls = any(endpoint.startswith("tls/") for endpoint in (*platform.router, *platform.upstream))
    if platform.tls is None and uses_tls:
        yield ConfigError("[platform]", "tls", "nothing", "the certificate of this host, for tls/… endpoints")
    if platform.tls is not None:
        try:
            check_tls_files(platform.tls, time.time())
        except ConfigError as error:
            yield error


# Where errors about the object that a key selects come from, and the key.
_SELECTED_BY = {"codec registry": "codec", "modem port": "port"}


def _located(file: ConfigFile, table: str, platform: PlatformConfig, error: BadInputError) -> BadInputError:
    """Return an error of a table or of what it names, with the file and line of the key."""
    detail = ""
    if error.where in ("[platform]", "[modem]", f"[{table}]"):
        names = [name for name in (error.where.strip("[]"), error.field) if name]
    elif error.where in _SELECTED_BY:
        names = [table, _SELECTED_BY[error.where]]
    elif error.where.startswith("platform.tls"):
        names, detail = error.where.split("."), f": {error.field}"
    elif error.where == str(platform.acoustic_key_file):
        names, detail = ["platform", "acoustic_key_file"], f": {error.where}"
    else:
        return error
    located = file.error(names, error.value, error.expected)
    return ConfigError(located.where, located.field + detail, error.value, error.expected)


def run_check(parsed: argparse.Namespace) -> int:
    """Check a file; print all errors, or one line for each service."""
    checked = check_file(parsed.config, os.environ)
    print_problems(checked)
    if checked.errors:
        count = len(checked.errors)
        print(f"{parsed.config}: {count} error{'s' if count > 1 else ''}", file=sys.stderr)
        return EXIT_INVALID
    assert checked.platform is not None
    print(f"{parsed.config}: valid, platform {checked.platform.id}, router {', '.join(checked.platform.router)}")
    for name, table in checked.services.items():
        assert table is not None
        own = sorted(table.model_fields_set)
        print(f"[{name}]: valid, {len(own)} keys set, {len(type(table).model_fields) - len(own)} defaults")
    return 0


def print_problems(checked: CheckedConfig) -> None:
    """Print errors and warnings on standard error, one line each."""
    for error in checked.errors:
        print(error, file=sys.stderr)
    for warning in checked.warnings:
        print(f"{warning} (warning)", file=sys.stderr)
