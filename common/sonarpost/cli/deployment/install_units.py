"""`sonarpost install-units`: write the systemd units of a platform."""

import argparse
import hashlib
import os
import re
import shlex
import sys
import sysconfig
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

from sonarpost.cli.deployment.config_files import PLATFORMS, example_files
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import flag, option
from sonarpost.config import ConfigFile
from sonarpost.errors import ConfigError
from sonarpost.files import PUBLIC_FILE, write_atomically

_DESCRIPTION = """Write the systemd units of a platform: one for each service of its configuration, the Zenoh router, a
target that starts all of them, and the user of the services. Nothing is started; the next commands are printed. A file
that was edited is not replaced without --force: use drop-ins (`systemctl edit`) for changes."""
UNIT_FOLDER = Path("etc/systemd/system")
CONFIG_FOLDER = Path("/etc/sonarpost")
HIDDEN_FOLDERS = ("home", "root", "run")
"""Folders of the root that ProtectHome=yes hides from services."""
_CHECKSUM = "# written by sonarpost install-units, SHA-256 of the lines above: "
_DROP_INS = {"uuv_modem": "modem", "op_modem": "modem", "compressor": "codec", "decompressor": "codec"}


def add_options(parser: CommandParser) -> None:
    """Add the command."""
    parser.description = _DESCRIPTION
    option(parser, "platform", "kind of the platform", choices=PLATFORMS)
    option(parser, "--config FILE", f"TOML file of the platform (default: {CONFIG_FOLDER}/PLATFORM.toml)", Path)
    option(
        parser,
        "--router-config FILE",
        f"JSON5 file of the router (default: {CONFIG_FOLDER}/router-PLATFORM.json5)",
        Path,
    )
    option(parser, "--user NAME", "user of the services", default="sonarpost")
    option(parser, "--executable PATH", "the sonarpost command (default: the one that is running)", Path)
    option(parser, "--root DIR", "root of the file system to write to", Path, Path("/"))
    flag(parser, "--force", "replace edited files")
    flag(parser, "--dry-run", "print the files instead of writing them")
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Write the units and print the next commands.

    Raises:
        ConfigError: An edited file, units of another platform, a path that services cannot read, an invalid user name.
    """
    platform: str = parsed.platform
    config = (parsed.config or CONFIG_FOLDER / f"{platform}.toml").absolute()
    router_config = (parsed.router_config or CONFIG_FOLDER / f"router-{platform}.json5").absolute()
    if not re.fullmatch(r"[a-z_][a-z0-9_-]{0,30}", parsed.user):
        raise ConfigError("command line", "--user", parsed.user, "the name of a user: a-z, 0-9, _ and -")
    for name, path in (("--config", config), ("--router-config", router_config)):
        _require_visible(name, path)
    root: Path = parsed.root.absolute()
    executable = _executable(parsed.executable, root)
    paths = {"SONARPOST": _quoted(executable), "CONFIG": _quoted(config), "ROUTER_CONFIG": _quoted(router_config)}
    services = _services(platform, root / config.relative_to("/"))
    units = _unit_files(platform, services, {**paths, "USER": parsed.user})
    if parsed.dry_run:
        for name, text in units.items():
            print(f"==> {root / name}\n{text}")
        return 0
    if not parsed.force:
        _require_unedited(root, units)
        _require_one_platform(root, platform)
    changed = {name for name, text in units.items() if not (root / name).exists() or _text(root / name) != text}
    for name in changed:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        write_atomically(root / name, units[name].encode(), PUBLIC_FILE)
    for name in units:
        print(f"{root / name}: {'written' if name in changed else 'unchanged'}")
    _print_next_commands(root, platform, executable, config, router_config, parsed.user)
    return 0


def _unit_files(platform: str, services: tuple[str, ...], values: Mapping[str, str]) -> Mapping[str, str]:
    """Return the text of each file, by its path relative to the root of the file system."""
    target = f"sonarpost-{platform}.target"
    units = " ".join(("sonarpost-router.service", *(f"sonarpost@{service}.service" for service in services)))
    values = {**values, "PLATFORM": platform, "TARGET": target, "UNITS": units}
    sources = {
        "etc/sysusers.d/sonarpost.conf": "sysusers.conf",
        f"{UNIT_FOLDER}/sonarpost-router.service": "sonarpost-router.service",
        f"{UNIT_FOLDER}/sonarpost@.service": "sonarpost@.service",
    }
    for service in services:
        if service in _DROP_INS:
            name = f"{_DROP_INS[service]}.conf"
            # 10-: before the drop-ins of `systemctl edit`, which is override.conf.
            sources[f"{UNIT_FOLDER}/sonarpost@{service}.service.d/10-{name}"] = name
    sources[f"{UNIT_FOLDER}/{target}"] = "platform.target"
    return {name: _filled(source, values) for name, source in sources.items()}


def _filled(source: str, values: Mapping[str, str]) -> str:
    text = files("sonarpost.cli.deployment").joinpath("units", source).read_text(encoding="utf-8")
    text = re.sub(r"@([A-Z_]+)@", lambda match: values[match[1]], text)
    return f"{text}{_CHECKSUM}{hashlib.sha256(text.encode()).hexdigest()}\n"


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")


def _is_edited(text: str) -> bool:
    lines, _, checksum = text.rpartition(_CHECKSUM)
    return hashlib.sha256(lines.encode()).hexdigest() != checksum.strip()


def _services(platform: str, config: Path) -> tuple[str, ...]:
    """Return the services with a table in the configuration, or in the example if the file does not exist yet."""
    if config.exists():
        return ConfigFile(config, {}).services
    return ConfigFile(example_files()[platform], {}).services


def _executable(given: Path | None, root: Path) -> Path:
    """Return the path of the sonarpost command.

    Raises:
        ConfigError: The command does not exist, or services cannot execute it.
    """
    if given is None:
        running = Path(sys.argv[0])
        path = (running if running.name == "sonarpost" else Path(sysconfig.get_path("scripts"), "sonarpost")).absolute()
        found = path
        # The command can be a link, and its interpreter can be in another folder than the environment.
        seen = [path, path.resolve(), Path(sys.executable).resolve()]
    else:
        path = given.absolute()
        found, seen = root / path.relative_to("/"), [path]
    for part in seen:
        _require_visible("--executable", part)
    if not os.access(found, os.X_OK):
        raise ConfigError("command line", "--executable", str(found), "the path of the sonarpost command")
    return path


def _require_visible(name: str, path: Path) -> None:
    if path.parts[1] in HIDDEN_FOLDERS:
        expected = (
            "a path that services can read, for example in /opt or /etc: the units hide /home, /root and /run/user"
        )
        raise ConfigError("command line", name, str(path), expected)


def _quoted(path: Path) -> str:
    """Return a path as one word of a unit file."""
    text = str(path).replace("%", "%%").replace("$", "$$")
    return text if re.fullmatch(r"[\w@%$+=:,./-]+", text) else '"' + re.sub(r'(["\\])', r"\\\1", text) + '"'


def _require_unedited(root: Path, units: Mapping[str, str]) -> None:
    paths = [root / name for name in units]
    edited = [str(path) for path in paths if path.exists() and _is_edited(_text(path))]
    if edited:
        expected = "an unchanged one; move the changes to a drop-in (systemctl edit), or use --force to discard them"
        raise ConfigError(", ".join(edited), "", "an edited file", expected)


def _require_one_platform(root: Path, platform: str) -> None:
    for other in PLATFORMS:
        path = root / UNIT_FOLDER / f"sonarpost-{other}.target"
        if other != platform and path.exists():
            expected = (
                f"units of one platform on a host; disable it and remove this file, or use --force for {platform}"
            )
            raise ConfigError(str(path), "", f"units of the platform {other}", expected)


def _print_next_commands(
    root: Path, platform: str, executable: Path, config: Path, router_config: Path, user: str
) -> None:
    """Print the commands between the installed units and the running services."""
    sonarpost, config_file = shlex.quote(str(executable)), shlex.quote(str(config))
    commands = ["systemd-sysusers"]
    for name, path in ((platform, config), (f"router-{platform}", router_config)):
        if not (root / path.relative_to("/")).exists():
            commands.append(f"{sonarpost} config example {name} --out {shlex.quote(str(path))}    # then edit it")
    if platform != "shore":
        folder = "/var/lib/sonarpost/acoustic"
        commands += [
            f"install -d -m 0700 -o {user} /var/lib/sonarpost {folder}",
            f"install -m 0600 -o {user} acoustic.key {folder}/    # from `sonarpost pki acoustic`",
        ]
    commands += [
        f"runuser -u {user} -- {sonarpost} config check {config_file}",
        "systemctl daemon-reload",
        f"systemctl enable --now sonarpost-{platform}.target",
        "systemctl status 'sonarpost*'",
    ]
    print("\nNext, as root:\n" + "\n".join(f"  {command}" for command in commands))
