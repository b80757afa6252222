"""The demo command: errors in its arguments come before any work."""

import pytest

from sonarpost.cli.main import main, parser
from sonarpost.config import load
from sonarpost.extensions.simulation.demo import command
from sonarpost.services.atd_stub.config import AtdStubConfig


def test_a_foreign_output_folder_is_refused_before_the_survey_is_simulated(tmp_path, monkeypatch, capsys):
    simulated: list[object] = []
    monkeypatch.setattr(command, "_simulated_survey", simulated.append)
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
        ("--crs=EPSG:4326", "--crs: projected_crs: got 'EPSG:4326', expected a projected coordinate system"),
        *((f"--threshold={value}", "--threshold: got") for value in ("2.1", "-0.1", "nan")),
        ("--rate=9", "--rate: got 9, expected one of [0, 1, 2, 3, 4, 5, 6]"),
    ],
)
def test_an_option_out_of_range_is_refused(option, message, tmp_path, capsys):
    assert main(["demo", option, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_survey_options_are_those_of_the_vehicle(tmp_path):
    options = tmp_path / "options.toml"
    options.write_text('port_order = "nearest_first"\n')
    given = ["--options", str(options), "--crs", "EPSG:32616"]
    lines = "\n".join(line for _, line in command._detection_settings(parser("demo").parse_args(["demo", *given])))
    (tmp_path / "demo.toml").write_text(f'[platform]\nid = "uuv-1"\n[atd_stub]\n{lines}\n')
    table = load(tmp_path / "demo.toml", "atd_stub", AtdStubConfig, {})[1]
    assert (table.port_order, table.projected_crs) == ("nearest_first", "EPSG:32616")


def test_images_take_no_survey_options(tmp_path, capsys):
    (tmp_path / "a.png").touch()
    assert main(["demo", "--images", str(tmp_path), "--crs", "EPSG:32616", "--out", str(tmp_path / "out")]) == 2
    assert "expected --survey with --options, --crs or --threshold" in capsys.readouterr().err


def test_rates_are_listed(capsys):
    with pytest.raises(SystemExit):
        main(["demo", "--rate", "help"])
    printed = capsys.readouterr().out
    assert printed.startswith("0  1 x  32 B =   32 B in")
    assert "5  8 x 256 B = 2048 B in" in printed
