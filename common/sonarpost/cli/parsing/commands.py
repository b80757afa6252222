"""Table of the commands: summaries, modules, examples, extras; the commands of extensions and plug-ins."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final

from sonarpost.registry import Registry

GROUP: Final = "sonarpost.commands"


@dataclass(frozen=True, slots=True)
class CommandSpec:
    """A command. An extension or a plug-in has it in a module that imports nothing else.

    The name of its entry point is that of the command, `record`, or of an action of another command, `c2 cot`.

    Attributes:
        summary: One line for the list of commands.
        options: `module:function`; the function adds options or actions to the `CommandParser` of the command, and sets
            its default `run`, which gets the parsed arguments and returns the exit status.
        example: Arguments of an example; empty for a command with actions.
        extras: Package that the command needs -> the extra that installs it.
    """

    summary: str
    options: str
    example: str = ""
    extras: Mapping[str, str] = field(default_factory=dict)


_WEB: Final = {"starlette": "console", "uvicorn": "console"}

COMMANDS: Final[Mapping[str, CommandSpec]] = {
    "run": CommandSpec(
        "run one service of the chain, or all services of a platform",
        "sonarpost.cli.run:add_run",
        "compressor --config uuv.toml",
        _WEB,
    ),
    "router": CommandSpec(
        "run an embedded Zenoh router", "sonarpost.cli.run:add_router", "--listen tcp/127.0.0.1:7447"
    ),
    "status": CommandSpec(
        "show the services of all platforms, live",
        "sonarpost.cli.status:add_options",
        "--router tcp/127.0.0.1:7447 --once",
    ),
    "c2": CommandSpec(
        "list, export and watch the contacts of a shore site; send commands", "sonarpost.cli.c2:add_actions"
    ),
    "store": CommandSpec(
        "check the store of a stopped service, and recover a damaged one", "sonarpost.cli.store:add_actions"
    ),
    "config": CommandSpec(
        "print an example configuration; check a configuration file",
        "sonarpost.cli.deployment.config_files:add_actions",
    ),
    "install-units": CommandSpec(
        "write the systemd units of a platform",
        "sonarpost.cli.deployment.install_units:add_options",
        "vessel --dry-run",
    ),
    "console": CommandSpec(
        "manage the users of the console; serve the contacts of a folder",
        "sonarpost.cli.console:add_options",
        "--view out",
        _WEB,
    ),
    "survey": CommandSpec(
        "describe, draw, view and export recordings of side-scan sonars", "sonarpost.cli.survey:add_actions"
    ),
    "detect": CommandSpec(
        "detect contacts in survey files, or in a folder of images",
        "sonarpost.cli.detection.command:add_options",
        "line.xtf --threshold 0.5 --pick 73,port,720 --plot contacts.png",
    ),
    "encode": CommandSpec(
        "encode an image or a folder of images",
        "sonarpost.cli.encode:add_encode",
        "contact.png --budget 64 --out streams",
    ),
    "decode": CommandSpec(
        "decode a stream or a folder of streams to TIFF and PNG",
        "sonarpost.cli.encode:add_decode",
        "streams --out images",
    ),
    "prepare": CommandSpec("compile the machine code of the codecs in advance", "sonarpost.cli.prepare:add_options"),
    "pki": CommandSpec(
        "certificates of the fleet, access control of its routers, key of its acoustic link",
        "sonarpost.cli.pki:add_actions",
    ),
    "modem": CommandSpec("test a modem without services", "sonarpost.cli.deployment.modem_ping:add_actions"),
    "completion": CommandSpec(
        "print the completion script of a shell",
        "sonarpost.cli.parsing.completion:add_options",
        "bash > ~/.local/share/bash-completion/completions/sonarpost",
    ),
}
"""Only the module of the given command is imported: all of them together take seconds."""

_EXTRAS: Final[Mapping[str, str]] = {"matplotlib": "research"}
"""Package -> extra of the research commands."""


@cache
def commands() -> Registry[CommandSpec]:
    """Return the commands of the core, of extensions and of plug-ins."""
    return Registry(GROUP, "a sonarpost.cli.parsing.commands.CommandSpec", _is_command, COMMANDS)


def _is_command(found: object, _name: str) -> bool:
    if not isinstance(found, CommandSpec):
        return False
    fields: tuple[Any, ...] = (found.summary, found.options, found.example, found.extras)
    return all(map(isinstance, fields, (str, str, str, Mapping)))  # the help of every command uses them


def all_extras() -> dict[str, str]:
    """Return the extras of all commands by package."""
    found = dict(_EXTRAS)
    for command in commands().working().values():
        found |= command.extras
    return found
