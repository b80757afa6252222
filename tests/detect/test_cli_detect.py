from __future__ import annotations

import argparse
import json

import numpy as np
import pytest
from PIL import Image

from sonarpost.cli import detect as command
from sonarpost.detect.plot import annotated_waterfall
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.sonar.survey import Side
from sonarpost.sonar.xtf_writer import write_xtf


def run(*arguments):
    parser = argparse.ArgumentParser()
    command.add_parser(parser.add_subparsers())
    parsed = parser.parse_args(["detect", *map(str, arguments)])
    return parsed.run(parsed)


@pytest.fixture(scope="module")
def file(make_survey, tmp_path_factory):
    path = tmp_path_factory.mktemp("survey") / "line7.xtf"
    write_xtf(make_survey({"side": Side.STARBOARD, "ping": 120}), path)
    return path


def test_the_table_names_each_contact(file, capsys):
    assert run(file) == 0
    head, columns, line = capsys.readouterr().out.splitlines()
    assert head == f"{file}: 200 pings, 1 contacts"
    assert len(columns.split()) - 1 == len(line.split()) - 2  # the position is two numbers
    assert line.split()[2:4] == ["mine-like", "starboard"]


def test_json_gives_one_object_a_line(file, capsys):
    assert run(file, file, "--json") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    contact = json.loads(lines[0])
    assert contact == json.loads(lines[1])
    assert contact["file"] == str(file)
    assert contact["channel"] == "starboard"
    assert contact["ping_number"] == pytest.approx(1120, abs=3)
    assert 1.0 <= contact["atd_confidence"] <= 2.0
    assert contact["lat_deg"] == pytest.approx(60.0, abs=0.01)


def test_the_plot_frames_the_contact_on_its_side(file, tmp_path):
    assert run(file, "--plot", tmp_path / "out.png") == 0
    with Image.open(tmp_path / "out.png") as picture:
        pixels = np.asarray(picture).astype(int)
    assert pixels.shape == (200, 1024, 3)
    rows, columns = np.nonzero((pixels[..., 0] == 255) & (pixels[..., 1] == 80) & (pixels[..., 2] == 60))
    assert columns.min() > 512 + 230
    assert abs(rows.min() - 110) < 5


def test_several_files_get_a_plot_each(file, tmp_path):
    assert run(file, file, "--plot", tmp_path / "out.png") == 0
    assert [p.name for p in tmp_path.iterdir()] == ["out-line7.png"]


def test_the_options_limit_the_list(file, capsys):
    assert run(file, "--threshold", "1.99") == 0
    assert capsys.readouterr().out.splitlines() == [f"{file}: 200 pings, 0 contacts"]
    assert run(file, "--threshold", "0.3", "--max-contacts", "3", "--json") == 0
    assert len(capsys.readouterr().out.splitlines()) == 3


@pytest.mark.parametrize("options", [("--threshold", "3"), ("--threshold", "nan"), ("--max-contacts", "0")])
def test_an_option_out_of_range_is_named(file, options):
    with pytest.raises(ConfigError, match=r"threshold|max_contacts"):
        run(file, *options)


def test_a_bad_file_and_a_folder_that_is_not_there_are_errors_that_main_tells(file, tmp_path):
    (tmp_path / "bad.xtf").write_bytes(b"not a survey")
    with pytest.raises(SurveyFileError):
        run(tmp_path / "bad.xtf")
    with pytest.raises(FileNotFoundError):
        run(file, "--plot", tmp_path / "absent" / "out.png")


def test_one_side_alone_and_no_side_can_be_drawn(make_survey):
    assert annotated_waterfall(make_survey(sides=(Side.STARBOARD,)), ()).size == (512, 200)
    assert annotated_waterfall(make_survey(sides=()), ()).size == (1, 1)
