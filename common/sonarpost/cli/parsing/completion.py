"""`sonarpost completion SHELL`: a script that completes commands, actions and options; file names elsewhere."""

import argparse
import shlex
from collections.abc import Mapping

from sonarpost.cli import main
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import option

SHELLS = ("bash", "zsh", "fish")

_BASH = """_sonarpost() {{
    local word command=""
    for word in "${{COMP_WORDS[@]:1:COMP_CWORD-1}}"; do
        case " {commands} " in *" ${{command:+$command/}}$word "*) command="${{command:+$command/}}$word" ;; esac
    done
    local words=""
    case "$command" in
{cases}
    esac
    COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _sonarpost sonarpost
"""


def add_options(parser: CommandParser) -> None:
    """Add the options of the command."""
    option(parser, "shell SHELL", "bash, zsh or fish", choices=SHELLS)
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Print the script; return 0."""
    words = {name: completions(parser) for name, parser in main.parser().tree().items()}
    print(fish_script(words) if parsed.shell == "fish" else bash_script(words, zsh=parsed.shell == "zsh"), end="")
    return 0


def completions(parser: CommandParser) -> list[str]:
    """Return what can follow the name of a command: its actions, its options, the values of its choices."""
    words = list(parser.actions)
    for action in parser._actions:  # noqa: SLF001 argparse has no public way to list them
        if action.help != argparse.SUPPRESS:
            words += action.option_strings
            if action.choices and not isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
                words += map(str, action.choices)
    return list(dict.fromkeys(words))


def bash_script(words: Mapping[str, list[str]], *, zsh: bool) -> str:
    """Return the script for bash, or for zsh, which has an emulation of bash's completion."""
    names = " ".join(name.replace(" ", "/") for name in words if name)
    cases = "\n".join(
        f"        {shlex.quote(name.replace(' ', '/'))}) words={shlex.quote(' '.join(each))} ;;"
        for name, each in words.items()
    )
    head = "autoload -U +X compinit && compinit -i\nautoload -U +X bashcompinit && bashcompinit\n" if zsh else ""
    return head + _BASH.format(commands=names, cases=cases)


def fish_script(words: Mapping[str, list[str]]) -> str:
    """Return the script for fish: one line for each command, used where all parts of its name were typed."""
    lines = []
    for name, each in words.items():
        typed = [f"__fish_seen_subcommand_from {part}" for part in name.split()]
        below = [other.split()[-1] for other in words if other and other.rpartition(" ")[0] == name]
        if below:
            typed.append(f"not __fish_seen_subcommand_from {' '.join(below)}")
        lines.append(f"complete -c sonarpost -n {shlex.quote('; and '.join(typed))} -a {shlex.quote(' '.join(each))}")
    return "\n".join(lines) + "\n"
