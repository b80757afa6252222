"""The argument parser of every command: global options, usage errors with a suggestion, an example in the help."""

from __future__ import annotations

import argparse
import difflib
import re
import sys
from collections.abc import Mapping, Sequence
from typing import Any, Never

from typing_extensions import override

from sonarpost.cli.parsing.commands import example_of
from sonarpost.cli.parsing.lists import requested_list

_INVALID_CHOICE = re.compile(r"invalid choice: '(?P<given>[^']*)' \(choose from (?P<choices>.*)\)")
_UNKNOWN = "unrecognized arguments: "


class CommandParser(argparse.ArgumentParser):
    """Parser with -v and -q, accepted before and after the name of a command.

    A usage error is reported by the parser of the command that it belongs to, with the most similar name. The help of
    a command that has an example ends with it.

    Parsed arguments have the attribute `verbosity`, `verbose` or `quiet`, only if the option was given.
    """

    def __init__(self, **options: Any) -> None:  # noqa: ANN401 the options of ArgumentParser
        super().__init__(**{"formatter_class": _Formatter, **options})
        example = example_of(self.prog.partition(" ")[2])
        if example is not None:
            self.epilog = f"example: sonarpost {example}"
        if "-" in self.prefix_chars:
            group = self.add_mutually_exclusive_group()
            for flags, const, text in (
                (("-v", "--verbose"), "verbose", "log details; a service logs at level debug"),
                (("-q", "--quiet"), "quiet", "no progress; only results and errors"),
            ):
                group.add_argument(
                    *flags, dest="verbosity", action="store_const", const=const, default=argparse.SUPPRESS, help=text
                )

    @override
    def parse_known_args(  # type: ignore[override]  # the base class has overloads for the type of the namespace
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse the arguments; unknown ones end the program with the usage of this command and status 2.

        `OPTION help` prints the possible values of an option and ends the program with status 0.
        """
        lines = requested_list(self._option_string_actions, sys.argv[1:] if args is None else args)
        if lines is not None:
            print("\n".join(lines))
            self.exit()
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(_UNKNOWN + " ".join(unknown))
        return parsed, unknown

    @override
    def error(self, message: str) -> Never:
        """Print the usage and the message, with the most similar name for a misspelt one; exit with status 2."""
        given, choices = "", list[str]()
        if found := _INVALID_CHOICE.search(message):
            given, choices = found["given"], re.findall(r"[\w.-]+", found["choices"])
        elif message.startswith(_UNKNOWN):
            given = message.removeprefix(_UNKNOWN).split("=")[0].split()[0]
            choices = list(self._option_string_actions)
        similar = difflib.get_close_matches(given, choices, n=1)
        super().error(f"{message}; did you mean {similar[0]}?" if similar else message)


class _Formatter(argparse.HelpFormatter):
    """Leaves an example in one line."""

    @override
    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return f"{indent}{text}" if text.startswith("example: ") else super()._fill_text(text, width, indent)


def all_parsers(parser: argparse.ArgumentParser) -> Mapping[str, argparse.ArgumentParser]:
    """Return the parsers of a command and of all its actions by name; the name of `sonarpost` itself is empty."""
    found = {parser.prog.partition(" ")[2]: parser}
    for action in actions_of(parser).values():
        found |= all_parsers(action)
    return found


def actions_of(parser: argparse.ArgumentParser) -> Mapping[str, argparse.ArgumentParser]:
    """Return the parsers of a command's actions by name."""
    for group in parser._actions:  # noqa: SLF001 argparse has no public way to list them
        if isinstance(group, argparse._SubParsersAction):  # noqa: SLF001
            return dict(group.choices)
    return {}
