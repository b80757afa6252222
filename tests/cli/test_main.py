"""The `sonarpost` command as a whole."""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys

import pytest

from sonarpost.cli.main import COMMANDS, RENAMED_COMMANDS, main, parser


def commands_of(whole: argparse.ArgumentParser) -> set[str]:
    return {name for action in whole._subparsers._group_actions for name in action.choices}  # type: ignore[union-attr]


def test_every_command_is_where_the_table_says() -> None:
    for command in COMMANDS:
        assert command in commands_of(parser(command))


def test_the_table_has_every_command() -> None:
    assert commands_of(parser()) == set(COMMANDS)


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    listed = capsys.readouterr().out
    assert {line.split()[0] for line in listed.splitlines() if line.startswith("    ") and line[4] != " "} >= set(
        COMMANDS
    )


def test_an_unknown_command_is_refused_with_all_names(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["sned"])
    assert caught.value.code == 2
    message = capsys.readouterr().err
    assert "sned" in message
    assert "modem-emulator" in message


def test_a_command_does_not_load_the_others() -> None:
    code = (
        "import sys; from sonarpost.cli.main import parser; parser('pki'); "
        "assert not {'scipy', 'numba', 'sonarpost.cli.demo'} & sys.modules.keys(), 'loaded what pki does not need'"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("command", RENAMED_COMMANDS)
def test_a_renamed_command_names_its_new_name(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*command.split(), "--json"]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    [line] = printed.err.splitlines()
    assert line.endswith(RENAMED_COMMANDS[command])


@pytest.mark.parametrize(
    "command",
    [new.split()[2] for new in RENAMED_COMMANDS.values() if new.startswith("python -m ")],
)
def test_the_new_name_of_a_renamed_command_exists(command: str) -> None:
    assert importlib.util.find_spec(command) is not None
