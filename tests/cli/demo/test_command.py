"""The demo command: errors in its arguments come before any work."""

from __future__ import annotations

from pathlib import Path

import pytest

from sonarpost.cli.demo import command
from sonarpost.cli.main import main


def test_a_foreign_output_folder_is_refused_before_the_survey_is_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    simulated: list[object] = []
    monkeypatch.setattr(command, "simulate_survey", simulated.append)
    (tmp_path / "notes.txt").write_text("not of a demo")
    assert main(["demo", "--out", str(tmp_path)]) == 2
    assert "expected a folder that is new, empty or of an earlier demo" in capsys.readouterr().err
    assert simulated == []
    assert (tmp_path / "notes.txt").exists()
