"""`sonarpost detect`."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sonarpost.cli import detect as command
from sonarpost.cli.detect import annotated_waterfall
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.messages import Contact
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


def test_table_lists_each_contact(file, capsys):
    assert run(file) == 0
    title, columns, line = capsys.readouterr().out.splitlines()
    assert title == f"{file}: 200 pings, 1 contacts"
    assert len(columns.split()) == len(line.split()) - 1  # the position is two numbers
    assert line.split()[2:4] == ["mine-like", "starboard"]


def test_json_is_one_object_with_contacts_of_every_file(file, capsys):
    assert run(file, file, "--json", "--vehicle", "uuv-7") == 0
    lines = capsys.readouterr().out.splitlines()
    files = json.loads(lines[-1])["files"]
    assert [f["file"] for f in files] == [str(file)] * 2
    assert [f["pings"] for f in files] == [200, 200]
    assert all(f["seconds"] > 0 for f in files)
    (contact,) = files[0]["contacts"]
    assert files[1]["contacts"] == [contact]
    assert contact["vehicle_id"] == "uuv-7"
    assert contact["channel"] == "starboard"
    assert contact["ping"] == pytest.approx(120, abs=3)
    assert contact["ping_number"] == 1000 + contact["ping"]
    assert contact["time_utc"].startswith("2001-09-09T01:46:5")
    assert 1.0 <= contact["atd_confidence"] <= 2.0
    assert contact["lat_deg"] == pytest.approx(60.0, abs=0.01)
    assert contact["position_sigma_m"] == pytest.approx(7.1, abs=0.2)
    missing = set(Contact.model_fields) - set(contact)
    assert missing <= {"type", "v", "schema_version", "time_utc_s"}, missing


def test_snippets_are_written_at_both_scales(file, tmp_path):
    (tmp_path / "out").mkdir()
    assert run(file, "--snippets", tmp_path / "out") == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["line7-001-ground.png", "line7-001.png"]
    with Image.open(tmp_path / "out" / "line7-001-ground.png") as image:
        assert image.size == (100, 100)


def test_consecutive_files_are_one_line(make_survey, tmp_path, capsys):
    survey = make_survey({"ping": 99, "sample": 300}, {"ping": 40, "sample": 350})
    paths = [tmp_path / "a.xtf", tmp_path / "b.xtf"]
    for path, pings in zip(paths, (survey.pings[:100], survey.pings[100:]), strict=True):
        write_xtf(replace(survey, pings=pings), path)
    assert run(*paths, "--json") == 0
    files = json.loads(capsys.readouterr().out)["files"]
    found = [(number, c["ping"], c["sample"]) for number, f in enumerate(files) for c in f["contacts"]]
    assert len(found) == 2
    at_boundary = [100 * number + ping for number, ping, sample in found if abs(sample - 300) < 10]
    assert at_boundary == [pytest.approx(99, abs=3)]
    assert run(*paths, "--plot", tmp_path / "out.png") == 0


def test_plot_marks_contact_on_its_side(file, tmp_path):
    assert run(file, "--plot", tmp_path / "out.png") == 0
    with Image.open(tmp_path / "out.png") as image:
        pixels = np.asarray(image).astype(int)
    assert pixels.shape == (200, 1024, 3)
    rows, columns = np.nonzero((pixels[..., 0] == 255) & (pixels[..., 1] == 80) & (pixels[..., 2] == 60))
    assert columns.min() > 512 + 230
    assert abs(rows.min() - 110) < 5


def test_several_files_give_one_plot_each(file, tmp_path):
    assert run(file, file, "--plot", tmp_path / "out.png") == 0
    assert [p.name for p in tmp_path.iterdir()] == ["out-line7.png"]


def test_options_limit_number_of_contacts(file, capsys):
    assert run(file, "--threshold", "2") == 0
    assert capsys.readouterr().out.splitlines() == [f"{file}: 200 pings, 0 contacts"]
    assert run(file, "--threshold", "0.001", "--max-contacts", "3", "--json") == 0
    (found,) = json.loads(capsys.readouterr().out)["files"]
    assert len(found["contacts"]) == 3


@pytest.mark.parametrize("options", [("--threshold", "3"), ("--threshold", "nan"), ("--max-contacts", "0")])
def test_error_names_option_out_of_range(file, options):
    with pytest.raises(ConfigError, match=r"threshold|max_contacts"):
        run(file, *options)


def test_invalid_file_and_missing_folder_raise(file, tmp_path):
    (tmp_path / "bad.xtf").write_bytes(b"not a survey")
    with pytest.raises(SurveyFileError):
        run(tmp_path / "bad.xtf")
    with pytest.raises(FileNotFoundError):
        run(file, "--plot", tmp_path / "absent" / "out.png")


def test_waterfall_with_one_side_or_none(make_survey):
    assert annotated_waterfall(make_survey(sides=(Side.STARBOARD,)), ()).size == (512, 200)
    assert annotated_waterfall(make_survey(sides=()), ()).size == (1, 1)
