"""`sonarpost console`: users, and the view of a folder of c2."""

import argparse
import getpass
import secrets
import sys
import tempfile
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from sonarpost.archive.image_files import stored_image
from sonarpost.archive.reader import ArchivePlace, as_folder, place_of
from sonarpost.archive.rows import FILE_NAME as ARCHIVE_FILE_NAME
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import flag, option, print_rejected
from sonarpost.config import load
from sonarpost.errors import BadInputError, ConfigError, PortError
from sonarpost.export.contacts import MAX_FILE_BYTES, read_stored_records
from sonarpost.files import read_regular
from sonarpost.keys import SHORE
from sonarpost.messages import Decision, ReconstructedImage
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.store.database import DATABASE_NAME, ROLES, Database
from sonarpost.services.console.store.users import FILE_NAME, LINK_S, Users, login_link
from sonarpost.sonar.image_files import read_image
from sonarpost.stop_signals import stop_on_signals

if TYPE_CHECKING:
    from sonarpost.services.console.state import ConsoleState
    from sonarpost.services.console.web.server import ConsoleApp, WebServer


def add_options(parser: CommandParser) -> None:
    """Add the options and actions."""
    option(parser, "--view DIR", "serve the contacts in a folder or database of c2, read only")
    add_page_options(parser)
    parser.set_defaults(run=run)
    user = parser.add_action("user", "manage the users of a console")
    for name, run_action, text, example in (
        ("add", _add, "add a user, or change the role of a user", "anna --role operator"),
        ("passwd", _set_password, "change a password", "anna"),
        ("link", _link, "print a link that logs a user in once, within 10 minutes", "anna"),
        ("rm", _remove, "remove a user", "anna"),
        ("ls", _list, "list the users", ""),
    ):
        action = user.add_action(name, text, run, f"{example} --state-dir state".lstrip())
        if name != "ls":
            option(action, "name NAME", "name of the user")
        if name == "add":
            option(action, "--role", "role of the user", default="observer", choices=ROLES)
        if name in ("add", "passwd"):
            flag(action, "--password-stdin", "read the password from standard input")
        where = action.add_mutually_exclusive_group(required=True)
        option(where, "--config FILE", "TOML file of the platform", Path)
        option(where, "--state-dir DIR", "state folder of the services", Path)
        action.set_defaults(run_action=run_action)


def add_page_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `serve_page`."""
    option(parser, "--port", "port of the page (default: 8470, or any if it is in use; 0: any)", int)
    flag(parser, "--open", "open the log-in link in the default browser")
    option(parser, "--password", "password of the users of the page (default: random)")


def run(parsed: argparse.Namespace) -> int:
    """Run `sonarpost console`; return the exit status.

    Raises:
        ConfigError: No action is requested, or an option is invalid.
        BadInputError: The name or password of a user is invalid.
        PortError: The address cannot be bound.
    """
    if hasattr(parsed, "run_action"):
        folder, config = parsed.state_dir, ConsoleConfig()
        if parsed.config is not None:
            platform, config = load(parsed.config, "console", ConsoleConfig, {})
            folder = platform.state_dir
        with closing(Users(folder / FILE_NAME)) as users:
            parsed.run_action(parsed, users, config)
        return 0
    if parsed.view is None:
        raise ConfigError("console", "", "no action", "an action or --view DIR; the service: `sonarpost run console`")
    return _run_view(parsed)


def _read_password(parsed: argparse.Namespace) -> str:
    if parsed.password_stdin:
        return sys.stdin.readline().rstrip("\n")
    if not sys.stdin.isatty():
        raise ConfigError("console", "password", "no terminal to ask", "--password-stdin")
    password = getpass.getpass(f"Password of {parsed.name}: ")
    if getpass.getpass("Again: ") != password:
        raise ConfigError("console", "password", "two different ones", "the same one twice")
    return password


def _add(parsed: argparse.Namespace, users: Users, _config: ConsoleConfig) -> None:
    users.add(parsed.name, parsed.role, _read_password(parsed))
    print(f"user {parsed.name} added with the role {parsed.role}")


def _set_password(parsed: argparse.Namespace, users: Users, _config: ConsoleConfig) -> None:
    users.set_password(parsed.name, _read_password(parsed))
    print(f"password of {parsed.name} changed")


def _remove(parsed: argparse.Namespace, users: Users, _config: ConsoleConfig) -> None:
    if not users.remove(parsed.name):
        raise ConfigError("console", "name", parsed.name, "a user; `sonarpost console user ls` lists them")
    print(f"user {parsed.name} removed")


def _link(parsed: argparse.Namespace, users: Users, config: ConsoleConfig) -> None:
    host = f"[{config.host}]" if ":" in config.host else config.host
    address = f"{'https' if config.tls else 'http'}://{host}:{config.port}/"
    print(login_link(address, users.make_login_link(parsed.name)))


def _list(_parsed: argparse.Namespace, users: Users, _config: ConsoleConfig) -> None:
    for user in users.all():
        changed = datetime.fromtimestamp(user.changed_utc_s, UTC)
        print(f"{user.name:<24} {user.role:<10} password of {changed:%Y-%m-%d}")


def _run_view(parsed: argparse.Namespace) -> int:
    from sonarpost.services.console.state import ConsoleState  # noqa: PLC0415

    place = place_of(parsed.view, "console --view")
    if isinstance(place, Path) and not (place / ARCHIVE_FILE_NAME).is_file():
        raise ConfigError("console", "--view", parsed.view, "a folder of c2, with its index, or its database")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sonarpost-view-")))
        state = ConsoleState(
            ConsoleConfig(role="shore"), stack.enter_context(closing(Database(folder / DATABASE_NAME)))
        )
        records = list(stored_records(place))
        state.store_images([record for record in records if isinstance(record, ReconstructedImage)])
        for record in records:
            if isinstance(record, Decision):
                state.store_decision(record)
        note = f"{state.counts().total} contacts in {place}, read only. Ctrl-C ends the page."
        # An observer: a comment could not be sent.
        serve_page(parsed, state, folder, (("watch", "observer"),), SHORE, note)
    return 0


def stored_records(place: ArchivePlace) -> Iterator[ReconstructedImage | Decision]:
    """Yield the images and decisions in the archive of c2, images first. Invalid files are printed.

    Raises:
        StoredFileError: There is no archive of this version.
    """
    with as_folder(place, (".json", ".tiff")) as folder:
        stored = read_stored_records(folder)
        problems: list[Exception] = [*stored.problems]
        for _, path in stored.images:
            try:
                yield stored_image(read_regular(path, MAX_FILE_BYTES), read_image(path.with_suffix(".tiff")), str(path))
            except (BadInputError, OSError) as error:
                problems.append(error)
        yield from stored.decisions
    print_rejected(problems)


def serve_page(
    parsed: argparse.Namespace,
    state: "ConsoleState",
    folder: Path,
    accounts: Sequence[tuple[str, str]],
    platform_id: str,
    note: str,
    start: Callable[[], None] = lambda: None,
    *,
    training: bool = False,
) -> None:
    """Print address, users and password, and serve the page until a signal.

    Args:
        parsed: Options of `add_page_options`.
        state: State of the page.
        folder: Folder for the database of the users.
        accounts: Names and roles of the users.
        platform_id: Platform that the page shows.
        note: Line that is printed.
        start: Called when the page is served.
        training: Whether all contacts are simulated.

    Raises:
        PortError: The port of `--port` is in use.
    """
    from sonarpost.services.console.web.server import ConsoleApp  # noqa: PLC0415

    with ExitStack() as stack:
        users = stack.enter_context(closing(Users(folder / FILE_NAME)))
        password = parsed.password or secrets.token_urlsafe(9)
        for name, role in accounts:
            users.add(name, role, password)
        app = ConsoleApp(state, users, platform_id, training=training)
        server = _server(app, state.config, parsed.port)
        name = next((name for name, role in accounts if role == "operator"), accounts[0][0])
        link = login_link(server.address, users.make_login_link(name))
        print(f"{server.address}  user: {' or '.join(name for name, _ in accounts)}  password: {password}")
        print(f"log-in link of {name}, valid once, for {LINK_S / 60:.0f} minutes: {link}")
        print(note, flush=True)
        server.start()
        stack.callback(server.stop)
        stack.callback(app.stop)
        start()  # may compile a codec for seconds, which Ctrl-C interrupts as in any command
        stop = stack.enter_context(stop_on_signals())
        if parsed.open:
            webbrowser.open(link)
        while server.running and not stop.wait(0.5):
            pass


def _server(app: "ConsoleApp", config: ConsoleConfig, port: int | None) -> "WebServer":
    from sonarpost.services.console.web.server import WebServer  # noqa: PLC0415

    if port is not None:
        return WebServer(app.asgi, config.host, port)
    try:
        return WebServer(app.asgi, config.host, config.port)
    except PortError:
        return WebServer(app.asgi, config.host, 0)
