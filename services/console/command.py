"""Options and actions of `sonarpost console`: users, and the training console."""

from __future__ import annotations

import argparse
import getpass
import secrets
import sys
import tempfile
from contextlib import ExitStack, closing
from datetime import UTC, datetime
from pathlib import Path

from sonarpost.config import load
from sonarpost.errors import ConfigError
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.database import DATABASE_NAME, ROLES, Database
from sonarpost.services.console.store.users import FILE_NAME, Users
from sonarpost.services.console.web.server import ConsoleApp, WebServer
from sonarpost.stop_signals import stop_on_signals

TRAINING_USERS = (("watch", "observer"), ("op", "operator"), ("expert", "expert"))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options and actions of `sonarpost console`."""
    parser.add_argument("--training", type=int, metavar="N", help="serve a training console with N simulated contacts")
    parser.add_argument("--port", type=int, default=8470, help="port of the training console (default: 8470; 0: any)")
    parser.add_argument("--state", type=Path, metavar="DIR", help="folder for the training data (default: none)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the simulation (default: 1)")
    parser.add_argument("--interval", type=float, default=6.0, metavar="S", help="time between packets (default: 6)")
    parser.add_argument("--password", help="password of all training users (default: random)")
    actions = parser.add_subparsers(metavar="ACTION", required=False)
    user = actions.add_parser("user", help="manage the users of a console")
    user_actions = user.add_subparsers(metavar="ACTION", required=True)
    for name, run_action, summary in (
        ("add", _add, "add a user, or change the role of a user"),
        ("passwd", _set_password, "change a password"),
        ("rm", _remove, "remove a user"),
        ("ls", _list, "list the users"),
    ):
        action = user_actions.add_parser(name, help=summary)
        if name != "ls":
            action.add_argument("name", metavar="NAME", help="name of the user")
        if name == "add":
            action.add_argument("--role", choices=ROLES, default="observer", help="role of the user")
        if name in ("add", "passwd"):
            action.add_argument("--password-stdin", action="store_true", help="read the password from standard input")
        where = action.add_mutually_exclusive_group(required=True)
        where.add_argument("--config", type=Path, metavar="FILE", help="TOML file of the platform")
        where.add_argument("--state-dir", type=Path, metavar="DIR", help="state folder of the services")
        action.set_defaults(run_action=run_action)


def run(parsed: argparse.Namespace) -> int:
    """Run `sonarpost console`; return the exit status.

    Raises:
        ConfigError: No action is requested, or an option is invalid.
        BadInputError: The name or password of a user is invalid.
        PortError: The address cannot be bound.
    """
    if hasattr(parsed, "run_action"):
        folder: Path = parsed.state_dir or load(parsed.config, "console", ConsoleConfig, {})[0].state_dir
        with closing(Users(folder / FILE_NAME)) as users:
            parsed.run_action(parsed, users)
        return 0
    if parsed.training is None:
        raise ConfigError("console", "", "no action", "`user …` or --training N; the service: `sonarpost run console`")
    if not 1 <= parsed.training <= 100_000:
        raise ConfigError("console", "--training", parsed.training, "1 to 100000")
    return _run_training(parsed)


def _read_password(parsed: argparse.Namespace) -> str:
    if parsed.password_stdin:
        return sys.stdin.readline().rstrip("\n")
    password = getpass.getpass(f"Password of {parsed.name}: ")
    if getpass.getpass("Again: ") != password:
        raise ConfigError("console", "password", "two different ones", "the same one twice")
    return password


def _add(parsed: argparse.Namespace, users: Users) -> None:
    users.add(parsed.name, parsed.role, _read_password(parsed))
    print(f"user {parsed.name} added with the role {parsed.role}")


def _set_password(parsed: argparse.Namespace, users: Users) -> None:
    users.set_password(parsed.name, _read_password(parsed))
    print(f"password of {parsed.name} changed")


def _remove(parsed: argparse.Namespace, users: Users) -> None:
    if not users.remove(parsed.name):
        raise ConfigError("console", "name", parsed.name, "a user; `sonarpost console user ls` lists them")
    print(f"user {parsed.name} removed")


def _list(_parsed: argparse.Namespace, users: Users) -> None:
    for user in users.all():
        changed = datetime.fromtimestamp(user.changed_utc_s, UTC)
        print(f"{user.name:<24} {user.role:<10} password of {changed:%Y-%m-%d}")


def _run_training(parsed: argparse.Namespace) -> int:
    # Imported here because it loads the codecs and their compiler.
    from sonarpost.services.console.training.simulator import VESSEL, TrainingSimulator  # noqa: PLC0415

    config = ConsoleConfig(port=parsed.port, vessel_lat_deg=56.4495, vessel_lon_deg=-5.6012)
    with ExitStack() as stack:
        scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="sonarpost-training-"))
        folder: Path = parsed.state or Path(scratch)
        database = stack.enter_context(closing(Database(folder / DATABASE_NAME)))
        users = stack.enter_context(closing(Users(folder / FILE_NAME)))
        password = parsed.password or secrets.token_urlsafe(9)
        for name, role in TRAINING_USERS:
            users.add(name, role, password)
        state = ConsoleState(config, database)
        app = ConsoleApp(state, users, VESSEL, training=True)
        server = WebServer(app.asgi, config.host, config.port)
        simulator = TrainingSimulator(state, parsed.training, parsed.seed, parsed.interval)
        print(f"{server.address}  users {', '.join(name for name, _ in TRAINING_USERS)}  password {password}")
        print("All contacts are simulated. Ctrl-C ends the training.", flush=True)
        stop = stack.enter_context(stop_on_signals())
        server.start()
        for part in (server, app, simulator):
            stack.callback(part.stop)
        simulator.load_backlog(parsed.training * 2 // 3)
        simulator.start()
        while server.running and not stop.wait(0.5):
            pass
    return 0
