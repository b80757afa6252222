"""The `sonarpost` command as a whole."""

from __future__ import annotations

import logging
import os
import shlex
import subprocess
import sys
from importlib.metadata import EntryPoint

import pytest

from sonarpost import registry
from sonarpost.cli.main import COMMANDS, LOG_LEVEL_VARIABLE, exit_status, main, parser
from sonarpost.cli.parsing.commands import GROUP, AddedCommand, added_commands, all_examples, all_extras
from sonarpost.cli.parsing.parser import actions_of, all_parsers
from sonarpost.codec.registry import BUILTINS, ENTRY_POINT_GROUP, CodecRegistry, codec_plug_ins

EXAMPLES = all_examples()
ADDED = {name: each.summary for name, each in added_commands().working().items() if " " not in name}
LIGHT = "numpy scipy rich pydantic numba zenoh PIL cryptography"


def summaries_of(whole):
    [group] = whole._subparsers._group_actions
    return {each.dest: each.help for each in group._choices_actions}


@pytest.fixture(scope="module")
def whole():
    return parser()


@pytest.fixture
def verbosity(monkeypatch):
    """Restore what -v and -q change."""
    monkeypatch.setenv(LOG_LEVEL_VARIABLE, "info")


def test_every_command_is_where_the_table_says():
    for command in COMMANDS:
        assert len(actions_of(parser(command))[command]._actions) > 2 or command == "prepare"


def test_the_table_has_the_summary_of_every_command(whole):
    assert summaries_of(whole) == {name: summary for name, (_, summary) in COMMANDS.items()} | ADDED


@pytest.mark.parametrize("arguments", [[], ["--help"], ["help"]])
def test_help_lists_every_command(arguments, capsys):
    with pytest.raises(SystemExit, match="0"):
        sys.exit(main(arguments))
    listed = capsys.readouterr().out
    assert {line.split()[0] for line in listed.splitlines() if line.startswith("    ") and line[4] != " "} >= set(
        {*COMMANDS, *ADDED}
    )


def test_help_of_a_command(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["help", "store", "salvage"])
    printed = capsys.readouterr().out
    assert printed.startswith("usage: sonarpost store salvage")
    assert printed.endswith(f"\nexample: sonarpost {EXAMPLES['store salvage']}\n")


@pytest.mark.parametrize(
    ("arguments", "usage", "expected"),
    [
        (["sned"], "sonarpost", "invalid choice: 'sned'"),
        (["pkii"], "sonarpost", "did you mean pki?"),
        (["--verison"], "sonarpost", "did you mean --version?"),
        (
            ["pki", "prepare", "uuv-8", "--role", "uuv", "--di", "x"],
            "sonarpost pki prepare",
            "unrecognized arguments: --di x; did you mean --dir?",
        ),
        (["store", "chekc", "x"], "sonarpost store", "did you mean check?"),
        (["store", "check", "x", "y"], "sonarpost store check", "unrecognized arguments: y"),
        (["pki", "prepare", "uuv-8", "--role", "vesel"], "sonarpost pki prepare", "did you mean vessel?"),
    ],
)
def test_a_usage_error_has_the_usage_of_the_command_and_a_suggestion(arguments, usage, expected, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    message = capsys.readouterr().err
    assert message.startswith(f"usage: {usage} [-h]")
    assert message.splitlines()[-1].startswith(f"{usage}: error: ")
    assert expected in message


def test_no_library_is_loaded_without_a_command_and_none_of_the_other_commands():
    code = (
        "import sys\nfrom sonarpost.cli.main import main, parser\n"
        "from sonarpost.cli.parsing.commands import all_extras\n"
        "for arguments in (['--help'], ['--version'], ['help'], ['sned'], []):\n"
        "    try: main(arguments)\n    except SystemExit: pass\n"
        f"loaded = set('{LIGHT}'.split()) & sys.modules.keys()\n"
        "assert not loaded, loaded\n"
        "parser('pki')\n"
        "assert not {'scipy', 'numba', 'sonarpost.cli.encode'} & sys.modules.keys(), 'loaded what pki does not need'\n"
        "parser()\nassert not all_extras().keys() & sys.modules.keys(), 'loaded what few commands need'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_broken_command_of_a_plug_in_stops_no_other(monkeypatch, capsys, caplog):
    added = AddedCommand("of a plug-in", "plug_in_that_is_absent:add_parser", {})
    monkeypatch.setattr(sys.modules[__name__], "ABSENT", added, raising=False)
    names = ("boom", "survey boom", "run", "c2 ls")
    points = [EntryPoint(name, f"{__name__}:ABSENT", GROUP) for name in names]
    monkeypatch.setattr(registry, "installed_points", lambda group: points if group == GROUP else [])
    added_commands.cache_clear()
    try:
        assert set(all_parsers(parser())) >= {"run", "survey info", "c2 ls", "encode"}
        for command in ("survey info", "run", "c2 ls", "boom"):
            with pytest.raises(SystemExit) as caught:
                main([*command.split(), "--help"])
            assert caught.value.code == (2 if command == "boom" else 0)
    finally:
        added_commands.cache_clear()
    assert "invalid choice: 'boom'" in capsys.readouterr().err
    assert "Command ignored: plug_in_that_is_absent:add_parser: ModuleNotFoundError" in caplog.text
    assert "sonarpost.commands:run" in caplog.text


def test_help_has_no_command_without_examples_and_any_summary(monkeypatch, capsys, caplog):
    module = sys.modules[__name__]
    monkeypatch.setattr(module, "WHOLE", AddedCommand("100 % of it", "absent:add_parser", {}), raising=False)
    monkeypatch.setattr(module, "WITHOUT", AddedCommand("without examples", "absent:add_parser", None), raising=False)
    points = [EntryPoint(name, f"{__name__}:{name.upper()}", GROUP) for name in ("whole", "without")]
    monkeypatch.setattr(registry, "installed_points", lambda group: points if group == GROUP else [])
    added_commands.cache_clear()
    try:
        main([])
    finally:
        added_commands.cache_clear()
    printed = capsys.readouterr().out
    assert "100 % of it" in printed
    assert "without examples" not in printed
    assert "sonarpost.commands:without" in caplog.text


def test_list_of_codecs_has_the_error_of_a_broken_plug_in(monkeypatch, capsys):
    broken = codec_plug_ins([EntryPoint("boom", "plug_in_that_is_absent:SPEC", ENTRY_POINT_GROUP)])
    monkeypatch.setattr("sonarpost.codec.registry.default_registry", lambda: CodecRegistry(BUILTINS, broken))
    with pytest.raises(SystemExit) as caught:
        main(["encode", "--codec", "help"])
    assert caught.value.code == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == sorted(["boom", *(spec.name for spec in BUILTINS)])
    assert "entry point sonarpost.codecs:boom: value: got" in "".join(lines)


def test_every_command_has_an_example_that_parses(whole):
    parsers = all_parsers(whole)
    assert {name for name, each in parsers.items() if not actions_of(each)} <= set(EXAMPLES)
    for name in EXAMPLES:
        words = shlex.split(EXAMPLES[name].partition(" > ")[0])
        assert words[: len(name.split())] == name.split()
        assert hasattr(whole.parse_args(words), "run")
        assert parsers[name].format_help().endswith(f"\nexample: sonarpost {EXAMPLES[name]}\n")


def test_every_command_accepts_verbose_and_quiet_before_and_after_it(whole):
    for name in EXAMPLES:
        words = shlex.split(EXAMPLES[name].partition(" > ")[0])
        assert not hasattr(whole.parse_args(words), "verbosity")
        assert whole.parse_args(["-v", *words]).verbosity == "verbose"
        assert whole.parse_args([*words, "--quiet"]).verbosity == "quiet"
    assert all("--verbose" in each.format_help() for each in all_parsers(whole).values())


@pytest.mark.usefixtures("verbosity")
def test_verbose_logs_the_traceback_of_an_error(capsys):
    assert main(["store", "check", "absent.db"]) == 2
    assert "Traceback" not in capsys.readouterr().err
    assert main(["-v", "store", "check", "absent.db"]) == 2
    printed = capsys.readouterr().err
    assert "DEBUG sonarpost: Command failed" in printed
    assert "Traceback" in printed
    assert os.environ[LOG_LEVEL_VARIABLE] == "debug"


@pytest.mark.usefixtures("verbosity")
def test_quiet_leaves_the_error_line(capsys):
    assert main(["store", "check", "absent.db", "-q"]) == 2
    assert capsys.readouterr().err.startswith("sonarpost: absent.db")
    assert not logging.getLogger().isEnabledFor(logging.WARNING)
    assert os.environ[LOG_LEVEL_VARIABLE] == "error"


def test_a_missing_extra_is_named(capsys):
    for package, extra in all_extras().items():

        def run(package=package):
            raise ModuleNotFoundError(f"No module named '{package}'", name=f"{package}.part")

        assert exit_status(run, needed_by="sonarpost console") == 2
        expected = f"sonarpost console: needs the extra {extra}: pip install 'sonarpost[{extra}]'\n"
        assert capsys.readouterr().err == expected


def test_another_missing_module_is_a_defect():
    def run():
        raise ModuleNotFoundError("No module named 'numpy'", name="numpy")

    with pytest.raises(ModuleNotFoundError):
        exit_status(run)


@pytest.mark.parametrize(
    ("arguments", "first", "another"),
    [
        ("encode --codec help", "avif", "vector quantisation with a shared tile codebook (the paper's codec)"),
        ("encode --codec=help", "avif", "vector quantisation"),
        ("decode --codebook help", "nominal-10", "FILE"),
        ("encode --model help", "standard (default)", "structure"),
        ("encode --packing help", "14bit", "ascii5"),
        ("pki issue --role help", "uuv", "vessel"),
    ],
)
def test_help_as_a_value_lists_the_values(arguments, first, another, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments.split())
    assert caught.value.code == 0
    printed = capsys.readouterr()
    assert printed.out.startswith(first)
    assert another in printed.out
    assert printed.err == ""


def test_help_is_a_value_where_there_is_no_list(whole):
    assert whole.parse_args(["pki", "revoke", "help", "--reason", "help"]).reason == "help"
