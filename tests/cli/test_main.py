"""The `sonarpost` command as a whole."""

import logging
import os
import shlex
import subprocess
import sys
from importlib.metadata import EntryPoint

import pytest

from sonarpost import registry
from sonarpost.cli.main import LOG_LEVEL_VARIABLE, exit_status, main, parser
from sonarpost.cli.parsing.commands import COMMANDS, GROUP, CommandSpec, all_extras, commands
from sonarpost.codec.registry import BUILTINS, ENTRY_POINT_GROUP, CodecRegistry, codec_plug_ins

LIGHT = "numpy scipy rich pydantic numba zenoh PIL cryptography"


@pytest.fixture(scope="module")
def whole():
    return parser()


@pytest.fixture(scope="module")
def examples(whole):
    """Returns the example of each command, by its name."""
    found = {name: each.epilog for name, each in whole.tree().items() if (each.epilog or "").startswith("example: ")}
    return {name: text.removeprefix("example: sonarpost ") for name, text in found.items()}


@pytest.fixture
def verbosity(monkeypatch):
    """Restore what -v and -q change."""
    monkeypatch.setenv(LOG_LEVEL_VARIABLE, "info")


def test_one_command_has_its_options_and_the_others_have_none():
    for command in COMMANDS:
        actions = parser(command).actions
        assert set(actions) == {*COMMANDS}
        assert {name for name, each in actions.items() if len(each._actions) > 3} <= {command}
        assert len(actions[command]._actions) > 2 or command == "prepare"


@pytest.mark.parametrize("arguments", [[], ["--help"], ["help"]])
def test_help_lists_every_command(arguments, capsys):
    with pytest.raises(SystemExit, match="0"):
        sys.exit(main(arguments))
    listed = capsys.readouterr().out
    found = {line.split()[0] for line in listed.splitlines() if line.startswith("    ") and line[4] != " "}
    assert found >= {name for name in commands().names() if " " not in name}


def test_help_of_a_command(capsys, examples):
    with pytest.raises(SystemExit, match="0"):
        main(["help", "store", "salvage"])
    printed = capsys.readouterr().out
    assert printed.startswith("usage: sonarpost store salvage")
    assert printed.endswith(f"\nexample: sonarpost {examples['store salvage']}\n")


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


@pytest.fixture
def plug_ins(monkeypatch):
    """Replaces the commands of extensions and plug-ins by those of this module, by name."""

    def replace(**found):
        points = []
        for number, (name, command) in enumerate(found.items()):
            monkeypatch.setattr(sys.modules[__name__], f"PLUG_IN_{number}", command, raising=False)
            points.append(EntryPoint(name.replace("_", " "), f"{__name__}:PLUG_IN_{number}", GROUP))
        monkeypatch.setattr(registry, "installed_points", lambda group: points if group == GROUP else [])
        commands.cache_clear()

    yield replace
    commands.cache_clear()


def print_and_fail(_parser):
    print("printed")
    raise KeyError("no option")


def test_broken_command_of_a_plug_in_stops_no_other(plug_ins, capsys, caplog):
    absent = CommandSpec("of a plug-in", "plug_in_that_is_absent:add_options")
    fails = CommandSpec("of a plug-in", f"{__name__}:print_and_fail")
    plug_ins(boom=absent, survey_boom=absent, run=absent, c2_ls=absent, no_parent=absent, fails=fails)
    assert {*parser().tree()} >= {"run", "survey info", "c2 ls", "encode"}
    for command in ("survey info", "run", "c2 ls"):
        with pytest.raises(SystemExit, match="0"):
            main([*command.split(), "--help"])
    assert [main([command, "--help"]) for command in ("boom", "fails")] == [2, 2]
    printed = capsys.readouterr()
    assert "entry point sonarpost.commands:boom: options: got 'plug_in_that_is_absent:" in printed.err
    assert "entry point sonarpost.commands:fails: options: got " in printed.err
    for name in ("survey boom", "run", "c2 ls", "no parent"):
        assert f"{name}" in caplog.text
    caplog.clear()
    assert main(["encode", "absent.png"]) == 2
    assert caplog.text == "", "other plug-ins are not imported"


def test_help_has_no_command_with_invalid_fields_and_any_summary(plug_ins, capsys, caplog):
    plug_ins(
        whole=CommandSpec("100 % of it", "absent:add_options"),
        without=CommandSpec("without extras", "absent:add", "", None),
    )
    main([])
    printed = capsys.readouterr().out
    assert "100 % of it" in printed
    assert "without extras" not in printed
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


def test_every_command_has_an_example_that_parses(whole, examples):
    parsers = whole.tree()
    assert {name for name, each in parsers.items() if not each.actions} <= {*examples, "prepare"}
    for name, example in examples.items():
        words = shlex.split(example.partition(" > ")[0])
        assert words[: len(name.split())] == name.split()
        assert not hasattr(whole.parse_args(words), "verbosity")
        assert whole.parse_args(["-v", *words]).verbosity == "verbose"
        assert whole.parse_args([*words, "--quiet"]).verbosity == "quiet"
        assert parsers[name].format_help().endswith(f"\nexample: sonarpost {example}\n")
    assert all("--verbose" in each.format_help() for each in parsers.values())


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
        ("encode --codec help", "emb", "vector quantisation with a shared tile codebook (the paper's codec)"),
        ("encode --codec=help", "emb", "vector quantisation"),
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
