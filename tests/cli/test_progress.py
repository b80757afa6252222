"""Progress display on a terminal and in a log."""

import io
import logging
import threading

import pytest
from builders.common import eventually
from builders.surveys import small_survey
from builders.xtf import write_xtf
from rich.console import Console

from sonarpost.cli import progress as module
from sonarpost.cli.main import LOG_LEVEL_VARIABLE, main
from sonarpost.cli.progress import ProgressDisplay, progress_console


def test_state_has_step_amount_and_time():
    out = io.StringIO()
    now = [0.0]
    display = ProgressDisplay(Console(file=out, width=200), "reading", clock=lambda: now[0])
    now[0] = 3.0
    assert display.state() == "reading: 3 s"
    display.show("round 1", 11, 100, "110 tiles")
    assert display.state() == "round 1: 11 of 100, 110 tiles, 0 s"
    now[0] = 15.0
    display.show("round 1", 20, 100, "200 tiles")
    assert display.state() == "round 1: 20 of 100, 200 tiles, 12 s"
    display.show("round 2", 50, 100)
    assert display.state() == "round 2: 50 of 100, 0 s"
    display.line("a result")
    assert out.getvalue() == "a result\n"
    assert ProgressDisplay(Console(file=out)).state() == ""


def test_log_gets_lines_until_the_command_ends(monkeypatch):
    assert module.LINE_EVERY_S == 10.0
    monkeypatch.setattr(module, "LINE_EVERY_S", 0.01)
    out, before = io.StringIO(), threading.active_count()
    with ProgressDisplay(Console(file=out, width=200), "drawing"):
        eventually(lambda: out.getvalue().count("drawing: 0 s\n") >= 2)
    assert threading.active_count() == before


def test_short_command_prints_nothing_in_a_log():
    out = io.StringIO()
    with ProgressDisplay(Console(file=out), "drawing") as display:
        display.show("drawing", 100, 100)
    assert out.getvalue() == ""


def test_quiet_prints_no_progress(capsys):
    progress_console().print("shown")
    logging.getLogger().setLevel(logging.ERROR)
    progress_console().print("hidden")
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("", "shown\n")


def test_terminal_gets_a_bar_and_lines():
    out = io.StringIO()
    with ProgressDisplay(Console(file=out, force_terminal=True, width=100)) as display:
        display.show("round 1 of 2", 50, 100, "500 tiles")
        display._bar.refresh()
        assert "round 1 of 2" in out.getvalue()
        assert "50 of 100, 500 tiles" in out.getvalue()
        display.line("the error was 1.00")
    assert "the error was 1.00" in out.getvalue()


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    path = tmp_path_factory.mktemp("survey") / "line.xtf"
    write_xtf(small_survey(pings=60, samples=256), path)
    return path


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("survey info {line} --json", "reading {line}: "),
        ("detect {line} --json", "detecting in {line}: 0 of 1, "),
        ("survey plot {line} --out {folder}", "drawing {line}: "),
    ],
)
def test_long_commands_have_progress_and_quiet_removes_it(words, expected, line, tmp_path, capsys, monkeypatch):
    begin, show = ProgressDisplay.__enter__, ProgressDisplay.show

    def enter(display):
        display.line(display.state())
        return begin(display)

    def show_and_print(display, *arguments, **named):
        show(display, *arguments, **named)
        display.line(display.state())

    monkeypatch.setattr(ProgressDisplay, "__enter__", enter)
    monkeypatch.setattr(ProgressDisplay, "show", show_and_print)
    monkeypatch.setenv(LOG_LEVEL_VARIABLE, "info")
    arguments = [word.format(line=line, folder=tmp_path) for word in words.split()]
    assert main(arguments) == 0
    printed = capsys.readouterr()
    assert any(shown.startswith(expected.format(line=line)) for shown in printed.err.splitlines())
    if "info" in words:
        assert main([*arguments, "-q"]) == 0
        assert capsys.readouterr() == (printed.out, "")
