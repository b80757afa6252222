"""The demo command: errors in its arguments come before any work."""

from __future__ import annotations

import pytest

from sonarpost.cli.demo import command
from sonarpost.cli.main import main


def test_a_foreign_output_folder_is_refused_before_the_survey_is_simulated(tmp_path, monkeypatch, capsys):
    simulated: list[object] = []
    monkeypatch.setattr(command, "simulate_survey", simulated.append)
    (tmp_path / "notes.txt").write_text("not of a demo")
    assert main(["demo", "--out", str(tmp_path)]) == 2
    assert "expected a folder that is new, empty or of an earlier demo" in capsys.readouterr().err
    assert simulated == []
    assert (tmp_path / "notes.txt").exists()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("line.abc", "line.abc: suffix: got '.abc', expected one of .dat, .jsf, .sdf, .sl2, .sl3, .svlog"),
        ("line.sdf", "line.sdf: page at byte 0, marker: got '74686973', expected ffffffff"),
        ("line.jsf", "line.jsf: message at byte 0, marker: got '7468', expected 0116"),
        ("line.DAT", "line.DAT: first byte: got '0x74', expected 0xc1 or 0xc3"),
        ("line.xtf", "line.xtf: FileFormat: got '0x74', expected 0x7b"),
        ("absent.xtf", "absent.xtf: got 'no such file or folder'"),
    ],
)
def test_a_file_that_cannot_be_read_is_refused_before_anything_is_started(name, message, tmp_path, capsys):
    if name != "absent.xtf":
        (tmp_path / name).write_bytes(b"this is no survey\n" * 200)
    assert main(["demo", "--survey", str(tmp_path / name), "--out", str(tmp_path / "out")]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert message in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("option", "message"),
    [
        *((f"--threshold={value}", "--threshold: got") for value in ("2.1", "-0.1", "nan")),
        ("--rate=9", "--rate: got 9, expected one of [0, 1, 2, 3, 4, 5, 6]"),
    ],
)
def test_an_option_out_of_range_is_refused(option, message, tmp_path, capsys):
    assert main(["demo", option, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
