"""The `sonarpost` command. Its help, and the report of a misspelt command, import the module of no command."""

import argparse
import logging
import os
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import EntryPoint
from typing import NoReturn

from sonarpost import __version__
from sonarpost.cli.parsing.commands import COMMANDS, GROUP, CommandSpec, all_extras, commands
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.errors import ConfigError, SonarpostError
from sonarpost.stop_signals import exit_process

log = logging.getLogger(__name__)

EXIT_ERROR = 2
EXIT_INTERRUPTED = 130
LOG_LEVEL_VARIABLE = "SONARPOST_PLATFORM__LOG_LEVEL"
"""Environment variable that overrides the configured log level of a service and of the services it starts."""
_STATUS = (
    "Exit status: 0 success; 1 done, with a result that needs attention (the help of the command says which); "
    "2 invalid input, one line on standard error; 130 interrupted by Ctrl-C."
)


def run_command() -> NoReturn:
    """Run the command of the command line and end the process with its exit status."""
    exit_process(main())


def parser(command: str | None = None) -> CommandParser:
    """Return the parser with the options of one command, or of all commands for None.

    All other commands, and every command for another name, have a summary but no options. If the core or an extension
    has the command, the modules of plug-ins with other commands are not imported, and these are not listed.

    Raises:
        ConfigError: The command is that of a plug-in that cannot be used.
    """
    whole = CommandParser(
        prog="sonarpost",
        description="Send images of sonar contacts from an underwater vehicle to a vessel and a shore site.",
        epilog=_STATUS,
    )
    whole.add_argument("--version", action="version", version=f"sonarpost {__version__}")
    first_words = {name: name.partition(" ")[0] for name in commands().names()}
    is_known = command in first_words
    for name, each in commands().working(lambda n: n in COMMANDS or not is_known or first_words[n] == command).items():
        is_wanted = command in (None, first_words[name])
        parent, _, last = name.rpartition(" ")
        above = whole.tree().get(parent)
        if above is None or last in above.actions:
            log.warning(
                "Command ignored: %s = %s: its name is taken, or it is an action of no command", name, each.options
            )
        elif is_wanted or not parent:
            action = above.add_action(
                last, each.summary, example=each.example, metavar="COMMAND" if above is whole else "ACTION"
            )
            if is_wanted:
                _add_options(action, name, each, is_required=name == command)
    return whole


def _add_options(action: CommandParser, name: str, command: CommandSpec, *, is_required: bool) -> None:
    """Import a command and add its options; one of a plug-in that cannot be used is reported in the log."""
    try:
        EntryPoint(name, command.options, GROUP).load()(action)
    except (Exception, SystemExit) as error:  # foreign code can raise any exception, and call `sys.exit`
        if name in COMMANDS:
            raise
        value, expected = f"{command.options} ({error!r})", "a function that adds options"
        failure = ConfigError(f"entry point {GROUP}:{name}", "options", value, expected)
        if is_required:
            raise failure from error
        log.warning("Command ignored: %s", failure)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status (2: invalid input, reported in one line)."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    words = [word for word in given if not word.startswith("-")]
    if words[:1] == ["help"]:
        given = [*words[1:], "--help"]
        words = words[1:]
    command = words[0] if words else ""

    def run() -> int:
        whole = parser(command)
        parsed = whole.parse_args(given)
        apply_verbosity(parsed)
        if not hasattr(parsed, "run"):
            whole.print_help()
            return 0
        status: int = parsed.run(parsed)
        return status

    return exit_status(run, needed_by=f"sonarpost {command}".strip())


def apply_verbosity(parsed: argparse.Namespace) -> None:
    """Set the log level of this process and of the services that it starts, if -v or -q was given."""
    if logging.lastResort is not None:  # prints the warnings of a command without -v
        logging.lastResort.setFormatter(logging.Formatter("%(message)s%(fields)s", defaults={"fields": ""}))
    verbosity = getattr(parsed, "verbosity", None)
    if verbosity == "verbose":
        # Imported lazily: it loads the records.
        from sonarpost.logs import configure_logging  # noqa: PLC0415

        configure_logging("sonarpost", "debug")
        os.environ[LOG_LEVEL_VARIABLE] = "debug"
    elif verbosity == "quiet":
        logging.getLogger().setLevel(logging.ERROR)
        os.environ[LOG_LEVEL_VARIABLE] = "error"


def exit_status(run: Callable[[], int], prog: str = "sonarpost", needed_by: str = "") -> int:
    """Run a command; return its exit status.

    A SonarpostError, an OSError or a missing extra is printed as one line and gives status 2, an interrupt gives
    status 130. At log level debug the traceback is logged as well.
    """
    try:
        return run()
    except SonarpostError as error:
        return _failed(prog, error)
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            # The reader has closed the output (`| head`): not an error.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        return _failed(prog, error)
    except ModuleNotFoundError as error:
        extra = all_extras().get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        return _failed(needed_by or prog, error, f"needs the extra {extra}: pip install 'sonarpost[{extra}]'")
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED


def _failed(prog: str, error: Exception, text: str = "") -> int:
    log.debug("Command failed", exc_info=error)
    print(f"{prog}: {text or error}", file=sys.stderr)
    return EXIT_ERROR


if __name__ == "__main__":
    run_command()
