"""The argument parser of every command: global options, actions, usage errors with a suggestion, an example."""

import argparse
import difflib
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any, Final, Never

from typing_extensions import override

from sonarpost.errors import ConfigError

_INVALID_CHOICE = re.compile(r"invalid choice: '(?P<given>[^']*)' \(choose from (?P<choices>.*)\)")
_UNKNOWN = "unrecognized arguments: "


class CommandParser(argparse.ArgumentParser):
    """Parser with -v and -q, accepted before and after the name of a command.

    A usage error is reported by the parser of the command that it belongs to, with the most similar name.

    Parsed arguments have the attribute `verbosity`, `verbose` or `quiet`, only if the option was given.

    Attributes:
        actions: Parsers of its actions by name, of `sonarpost` itself those of all commands.
    """

    def __init__(self, **options: Any) -> None:  # noqa: ANN401 the options of ArgumentParser
        super().__init__(**{"formatter_class": _Formatter, **options})
        self.actions: dict[str, CommandParser] = {}
        self._group: argparse._SubParsersAction[CommandParser] | None = None
        if "-" in self.prefix_chars:
            group = self.add_mutually_exclusive_group()
            for flags, const, text in (
                (("-v", "--verbose"), "verbose", "log details; a service logs at level debug"),
                (("-q", "--quiet"), "quiet", "no progress; only results and errors"),
            ):
                group.add_argument(
                    *flags, dest="verbosity", action="store_const", const=const, default=argparse.SUPPRESS, help=text
                )

    def add_action(
        self,
        name: str,
        summary: str,
        run: Callable[[argparse.Namespace], int] | None = None,
        example: str = "",
        description: str = "",
        *,
        metavar: str = "ACTION",
    ) -> "CommandParser":
        """Add an action and return its parser, to which options can be added.

        Args:
            name: One word.
            summary: One line for the list of actions.
            run: Gets the parsed arguments and returns the exit status; None prints the help.
            example: Arguments of an example, the last line of the help; empty for none.
            description: Text of the help; empty for the summary.
            metavar: Stands for the actions in the usage.
        """
        if self._group is None:
            self._group = self.add_subparsers(metavar=metavar)
        parser = self._group.add_parser(
            name,
            help=summary.replace("%", "%%"),
            description=description or f"{summary[:1].upper()}{summary[1:]}.",
        )
        if example:
            parser.epilog = f"example: {parser.prog} {example}"
        self.actions[name] = parser

        def show_help(_: argparse.Namespace) -> int:
            parser.print_help()
            return 0

        parser.set_defaults(run=run or show_help)
        return parser

    def tree(self) -> "Mapping[str, CommandParser]":
        """Return the parsers of this command and of all its actions by name; that of `sonarpost` itself is empty."""
        found = {self.prog.partition(" ")[2]: self}
        for action in self.actions.values():
            found |= action.tree()
        return found

    @override
    def parse_known_args(  # type: ignore[override]  # the base class has overloads for the type of the namespace
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse the arguments; unknown ones end the program with the usage of this command and status 2.

        `OPTION help` prints the possible values of an option and ends the program with status 0.
        """
        lines = _requested_list(self._option_string_actions, sys.argv[1:] if args is None else args)
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


# Imported lazily in every function: the codecs load numpy.


def _codecs() -> list[str]:
    from sonarpost.codec.registry import default_registry  # noqa: PLC0415

    registry = default_registry()

    def summary(name: str) -> str:
        try:
            return registry.spec(name).summary
        except ConfigError as error:  # a plug-in that cannot be used
            return str(error)

    return [f"{name:16} {summary(name)}" for name in registry.names()]


def _codebooks() -> list[str]:
    from sonarpost.codec.vq.codebook import DEFAULT_TILE_PX, load_default  # noqa: PLC0415

    books = ((tile_px, load_default(tile_px).tiles) for tile_px in DEFAULT_TILE_PX)
    return [
        *(f"nominal-{tile_px:<9} {len(tiles)} tiles of {tile_px} × {tile_px} px" for tile_px, tiles in books),
        f"{'FILE':17} output of `python -m research.codebook build` or `adapt`",
    ]


def _models() -> list[str]:
    from sonarpost.codec import emb  # noqa: PLC0415

    return [f"{name}{' (default)' if name == emb.DEFAULT_MODEL else ''}" for name in emb.CODEC_IDS]


def _rates() -> list[str]:
    from sonarpost.modem.registry import modem_driver  # noqa: PLC0415

    return [
        f"{rate.number}  {rate.frames} x {rate.frame_bytes:3} B = {rate.packet_bytes:4} B in {rate.airtime_s:g} s, "
        f"{rate.modulation}"
        for rate in modem_driver().capabilities.rates.values()
    ]


_LISTS: Final[Mapping[str, Callable[[], Iterable[str]]]] = {
    "--codec": _codecs,
    "--codecs": _codecs,
    "--codebook": _codebooks,
    "--codebooks": _codebooks,
    "--core": _codebooks,
    "--model": _models,
    "--rate": _rates,
    "--rates": _rates,
}


def _requested_list(options: Mapping[str, argparse.Action], arguments: Sequence[str]) -> list[str] | None:
    """Return the lines of the list that `OPTION help` or `OPTION=help` requests; None if there is no such request.

    Args:
        options: Options of the command.
        arguments: Its arguments.
    """
    pairs = [*pairwise(arguments), *((option, value) for option, _, value in (a.partition("=") for a in arguments))]
    for option, value in pairs:
        action = options.get(option)
        if value == "help" and action is not None:
            if option in _LISTS:
                return list(_LISTS[option]())
            if action.choices is not None:
                return [str(choice) for choice in action.choices]
    return None
