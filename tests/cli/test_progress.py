"""Progress display on a terminal and in a log."""

from __future__ import annotations

import io

from rich.console import Console

from sonarpost.cli.progress import ProgressDisplay
from sonarpost.codec.vq.builder import BuildProgress, RefinementProgress


def progress(done: int, total: int = 100, round_number: int = 0) -> BuildProgress:
    return BuildProgress(round_number, 2, done, done, total, 10 * done)


def test_log_gets_a_line_every_ten_seconds() -> None:
    out = io.StringIO()
    now = [0.0]
    with ProgressDisplay(Console(file=out, width=200), clock=lambda: now[0]) as display:
        for done in range(1, 101):
            display.build(progress(done))
            now[0] += 1.0
        display.build(progress(1, round_number=1))
        display.build(RefinementProgress(1, 3, 50, 100, float("nan")))
        display.build(RefinementProgress(1, 3, 100, 100, 12.345))
    lines = out.getvalue().splitlines()
    assert lines[:2] == ["round 1 of 2: 1 of 100, 10 tiles", "round 1 of 2: 11 of 100, 110 tiles"]
    assert lines[10:] == [
        "round 1 of 2: 100 of 100, 1000 tiles",
        "round 2 of 2: 1 of 100, 10 tiles",
        "refining 1 of 3: 50 of 100",
        "refining 1 of 3: the error was 12.35 grey levels RMS before",
    ]


def test_terminal_gets_a_bar_and_lines() -> None:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=100)
    with ProgressDisplay(console) as display:
        display.build(progress(50))
        display._bar.refresh()
        assert "50/100" in out.getvalue()
        assert "round 1 of 2 500 tiles" in out.getvalue()
        display.build(RefinementProgress(1, 1, 100, 100, 1.0))
    assert "the error was 1.00" in out.getvalue()
    assert "\n50 of 100" not in out.getvalue()
