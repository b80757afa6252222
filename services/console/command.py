"""What `sonarpost console` does: users, and a console to learn on."""

from __future__ import annotations

import argparse
import getpass
import secrets
import signal
import sys
import tempfile
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from sonarpost.config import load
from sonarpost.errors import ConfigError
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.state import Board
from sonarpost.services.console.store.database import Database
from sonarpost.services.console.store.users import FILE_NAME, ROLES, Users
from sonarpost.services.console.web.server import ConsoleApp, WebServer

if TYPE_CHECKING:
    from sonarpost.services.console.training.simulator import Training

DATABASE_NAME = "console-review.db"
TRAINING_USERS = (("watch", "observer"), ("op", "operator"), ("expert", "expert"))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options and actions of `sonarpost console`."""
    parser.add_argument("--training", type=int, metavar="N", help="serve a page with N simulated contacts to learn on")
    parser.add_argument("--port", type=int, default=8470, help="of the training page (default: 8470; 0: any)")
    parser.add_argument("--state", type=Path, metavar="DIR", help="where training is kept (default: nowhere)")
    parser.add_argument("--seed", type=int, default=1, help="of the simulation (default: 1)")
    parser.add_argument("--interval", type=float, default=6.0, metavar="S", help="between packets (default: 6)")
    parser.add_argument("--password", help="of all training users (default: drawn by lot)")
    actions = parser.add_subparsers(metavar="ACTION", required=False)
    user = actions.add_parser("user", help="who may log in")
    what = user.add_subparsers(metavar="ACTION", required=True)
    for name, summary in (
        ("add", "add a user, or change one's role"),
        ("passwd", "change a password"),
        ("rm", "remove"),
    ):
        action = what.add_parser(name, help=summary)
        action.add_argument("name", metavar="NAME", help="name of the user")
        if name == "add":
            action.add_argument("--role", choices=ROLES, default="observer", help="what the user may do")
        if name != "rm":
            action.add_argument("--password-stdin", action="store_true", help="read the password from standard input")
        _add_state(action)
        action.set_defaults(act={"add": _add, "passwd": _passwd, "rm": _remove}[name])
    shown = what.add_parser("ls", help="show who may log in")
    _add_state(shown)
    shown.set_defaults(act=_ls)


def _add_state(parser: argparse.ArgumentParser) -> None:
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--config", type=Path, metavar="FILE", help="TOML file of the platform")
    where.add_argument("--state-dir", type=Path, metavar="DIR", help="folder of the services' stores")


def run(parsed: argparse.Namespace) -> int:
    """Run `sonarpost console`; return the exit status.

    Raises:
        ConfigError: Nothing is asked for.
        BadInputError: A user's name or password is not allowed.
        PortError: The address cannot be listened on.
    """
    if hasattr(parsed, "act"):
        status: int = parsed.act(parsed)
        return status
    if parsed.training is None:
        raise ConfigError("console", "", "nothing", "`user …` or --training N; the service: `sonarpost run console`")
    if not 1 <= parsed.training <= 100_000:
        raise ConfigError("console", "--training", parsed.training, "1 to 100000")
    return _train(parsed)


def _users(parsed: argparse.Namespace) -> Users:
    folder: Path = parsed.state_dir or load(parsed.config, "console", ConsoleConfig, {})[0].state_dir
    return Users(folder / FILE_NAME)


def _password(parsed: argparse.Namespace) -> str:
    if parsed.password_stdin:
        return sys.stdin.readline().rstrip("\n")
    first = getpass.getpass(f"Password of {parsed.name}: ")
    if getpass.getpass("Again: ") != first:
        raise ConfigError("console", "password", "two different ones", "the same one twice")
    return first


def _add(parsed: argparse.Namespace) -> int:
    users = _users(parsed)
    try:
        users.add(parsed.name, parsed.role, _password(parsed))
    finally:
        users.close()
    print(f"{parsed.name} may log in as {parsed.role}")
    return 0


def _passwd(parsed: argparse.Namespace) -> int:
    users = _users(parsed)
    try:
        users.set_password(parsed.name, _password(parsed))
    finally:
        users.close()
    print(f"password of {parsed.name} changed")
    return 0


def _remove(parsed: argparse.Namespace) -> int:
    users = _users(parsed)
    try:
        if not users.remove(parsed.name):
            raise ConfigError("console", "name", parsed.name, "a user; `sonarpost console user ls` shows them")
    finally:
        users.close()
    print(f"{parsed.name} may not log in any more")
    return 0


def _ls(parsed: argparse.Namespace) -> int:
    users = _users(parsed)
    try:
        for user in users.all():
            changed = datetime.fromtimestamp(user.changed_utc_s, UTC)
            print(f"{user.name:<24} {user.role:<10} password of {changed:%Y-%m-%d}")
    finally:
        users.close()
    return 0


def _train(parsed: argparse.Namespace) -> int:
    from sonarpost.services.console.training.simulator import VESSEL, Training  # noqa: PLC0415  it brings codecs and their compiler

    with tempfile.TemporaryDirectory(prefix="sonarpost-training-") as scratch:
        folder: Path = parsed.state or Path(scratch)
        config = ConsoleConfig(port=parsed.port, vessel_lat_deg=56.4495, vessel_lon_deg=-5.6012)
        database, users = Database(folder / DATABASE_NAME), Users(folder / FILE_NAME)
        try:
            password = parsed.password or secrets.token_urlsafe(9)
            for name, role in TRAINING_USERS:
                users.add(name, role, password)
            board = Board(config, database)
            app = ConsoleApp(board, users, VESSEL, training=True)
            server = WebServer(app.asgi, config.host, config.port)
            training = Training(board, parsed.training, parsed.seed, parsed.interval)
            print(f"{server.address}  users {', '.join(name for name, _ in TRAINING_USERS)}  password {password}")
            print("Contacts are simulated. Ctrl-C ends it.", flush=True)
            _serve(app, server, training, parsed.training * 2 // 3)
        finally:
            users.close()
            database.close()
    return 0


def _serve(app: ConsoleApp, server: WebServer, training: Training, before: int) -> None:
    ended = threading.Event()
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: ended.set())
    server.start()
    try:
        training.backlog(before)
        training.start()
        while server.running and not ended.wait(0.5):
            pass
    finally:
        training.stop()
        app.end()
        server.stop()
