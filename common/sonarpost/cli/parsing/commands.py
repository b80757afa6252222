"""Tables of the commands: modules, summaries, examples, extras; the commands of extensions and plug-ins."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import EntryPoint
from typing import TYPE_CHECKING, Any, Final

from sonarpost.registry import Registry

if TYPE_CHECKING:
    import argparse

log = logging.getLogger(__name__)

GROUP: Final = "sonarpost.commands"

COMMANDS: Final[Mapping[str, tuple[str, str]]] = {
    "run": ("cli.run", "run one service of the chain, or all services of a platform"),
    "router": ("cli.run", "run an embedded Zenoh router"),
    "status": ("cli.status", "show the services of all platforms, live"),
    "c2": ("cli.c2", "list, export and watch the contacts of a shore site; send commands"),
    "dataset": ("cli.dataset", "training data from the verdicts of operators"),
    "store": (
        "cli.store",
        "check the store of a stopped service, and recover a damaged one",
    ),
    "config": ("cli.deployment.config_files", "print an example configuration; check a configuration file"),
    "install-units": ("cli.deployment.install_units", "write the systemd units of a platform"),
    "console": ("cli.console", "manage the users of the console; serve the contacts of a folder"),
    "metrics": ("cli.metrics", "serve the health of all platforms to Prometheus"),
    "survey": ("cli.survey", "describe, draw, view and export recordings of side-scan sonars"),
    "detect": ("cli.detection.command", "detect contacts in survey files, or in a folder of images"),
    "encode": ("cli.encode", "encode an image or a folder of images"),
    "decode": ("cli.encode", "decode a stream or a folder of streams to TIFF and PNG"),
    "prepare": ("cli.prepare", "compile the machine code of the codecs in advance"),
    "pki": ("cli.pki", "certificates of the fleet, access control of its routers, key of its acoustic link"),
    "modem": ("cli.deployment.modem_ping", "test a modem without services"),
    "completion": ("cli.parsing.completion", "print the completion script of a shell"),
}
"""Name -> module and summary. Only the module of the given command is imported: all of them together take seconds."""


@dataclass(frozen=True, slots=True)
class AddedCommand:
    """A command of an extension or a plug-in, in a module that imports nothing else.

    The name of its entry point is that of the command, `record`, or of an action of a command of the core, `c2 cot`.

    Attributes:
        summary: One line for the list of commands.
        parser: `module:function`; the function adds the parser of the command to the group of parsers that it gets.
        examples: Arguments of an example by command, as `EXAMPLES`.
        extras: Package that the command needs -> the extra that installs it, as `EXTRAS`.
    """

    summary: str
    parser: str
    examples: Mapping[str, str]
    extras: Mapping[str, str] = field(default_factory=dict)

    def add(self, subparsers: argparse._SubParsersAction[Any]) -> None:
        """Import the command and add its parser; one that cannot be added is reported in the log."""
        try:
            EntryPoint("", self.parser, GROUP).load()(subparsers)
        except (Exception, SystemExit) as error:  # noqa: BLE001 foreign code can raise any exception, and call `sys.exit`
            log.warning("Command ignored: %s: %r", self.parser, error)


EXTRAS: Final[Mapping[str, str]] = {
    "starlette": "console",
    "uvicorn": "console",
    "matplotlib": "research",
}
"""Package -> the extra that installs it."""

EXAMPLES: Final[Mapping[str, str]] = {
    "run": "run compressor --config uuv.toml",
    "router": "router --listen tcp/127.0.0.1:7447",
    "status": "status --router tcp/127.0.0.1:7447 --once",
    "c2 ls": "c2 ls --since 24h --json",
    "c2 get": "c2 get uuv-1/0001",
    "c2 export": "c2 export --out contacts.geojson --out contacts.kmz",
    "c2 watch": "c2 watch --router tcp/127.0.0.1:7447 --count 1",
    "c2 migrate": "c2 migrate --config shore.toml --archive out",
    "c2 command": "c2 command uuv-1/0001 --vessel vessel-1 --kind refine",
    "c2 comment": "c2 comment uuv-1/0001 --vessel vessel-1 --verdict mine_like --remark 'same as last year'",
    "dataset export": "dataset export --archive demo-out/shore/images --out dataset",
    "store check": "store check state/relay.db",
    "store quarantine": "store quarantine state/c2.db --requeue",
    "store salvage": "store salvage state/relay.db --out relay-new.db",
    "config example": "config example uuv --out uuv.toml",
    "config check": "config check uuv.toml",
    "install-units": "install-units vessel --dry-run",
    "console": "console --view out",
    "console user add": "console user add anna --role operator --state-dir state",
    "console user link": "console user link anna --state-dir state",
    "console user passwd": "console user passwd anna --state-dir state",
    "console user rm": "console user rm anna --state-dir state",
    "console user ls": "console user ls --state-dir state",
    "metrics": "metrics --router tcp/127.0.0.1:7447 --port 9464",
    "survey info": "survey info line.xtf --json",
    "survey plot": "survey plot line.xtf --ground --out plots",
    "survey waterfall": "survey waterfall line.xtf --out waterfalls",
    "survey export": "survey export line.xtf --format geojson --out track.geojson",
    "detect": "detect line.xtf --threshold 0.5 --pick 73,port,720 --plot contacts.png",
    "encode": "encode contact.png --budget 64 --out streams",
    "decode": "decode streams --out images",
    "prepare": "prepare",
    "pki init": "pki init --dir fleet --fleet north",
    "pki prepare": "pki prepare uuv-8 uuv-9 --dir fleet --role uuv",
    "pki issue": "pki issue vessel-1 --dir fleet --role vessel --host 192.0.2.1",
    "pki renew": "pki renew vessel-1 --dir fleet --out vessel-1-2027",
    "pki revoke": "pki revoke vessel-1 --dir fleet --reason 'computer lost'",
    "pki list": "pki list --dir fleet",
    "pki router-config": "pki router-config --dir fleet --platform vessel-1 --out vessel-1.json5",
    "pki acoustic": "pki acoustic --dir fleet",
    "modem ping": "modem ping --port /dev/ttyUSB0 --address 3 --destination 1",
    "completion": "completion bash > ~/.local/share/bash-completion/completions/sonarpost",
}
"""Command -> arguments of its example. Every command without actions has one."""


@cache
def added_commands() -> Registry[AddedCommand]:
    """Return the commands of extensions and plug-ins."""
    expected = "a sonarpost.cli.parsing.commands.AddedCommand with a name that no command of the core has"
    return Registry(GROUP, expected, _is_command, {})


def _is_command(found: object, name: str) -> bool:
    if not isinstance(found, AddedCommand) or name in COMMANDS or name in EXAMPLES:
        return False
    types = (str, str, Mapping, Mapping)  # the help of every command uses them
    return all(map(isinstance, (found.summary, found.parser, found.examples, found.extras), types))


def add_actions(actions: argparse._SubParsersAction[Any], command: str) -> None:
    """Add the actions that extensions and plug-ins have for a command of the core."""
    for name, added in added_commands().working().items():
        if name.rpartition(" ")[0] == command:
            added.add(actions)


def example_of(command: str) -> str | None:
    """Return the arguments of the example of a command; None if it has none."""
    for name, added in added_commands().working().items():
        if command.startswith(name) and command in added.examples:
            return added.examples[command]
    return EXAMPLES.get(command)


def all_examples() -> dict[str, str]:
    """Return the examples of all commands."""
    found = dict(EXAMPLES)
    for added in added_commands().working().values():
        found |= added.examples
    return found


def all_extras() -> dict[str, str]:
    """Return the extras of all commands by package."""
    found = dict(EXTRAS)
    for added in added_commands().working().values():
        found |= added.extras
    return found
